"""Counters of an ingest."""

from dataclasses import dataclass


@dataclass(slots=True)
class IngestCounters:
    """Counters since the start.

    Attributes:
        messages: changes that were published to this server.
        message_bytes: in these, as they came.
        applied: changes that were new and taken.
        doubled: published changes that were already there.
        damaged: published changes that did not decode.
        refused: changes that were refused for good.
        pulls: pieces of logs that were asked for.
        pulled: changes that came with them.
        restored: changes that took the place of ones damaged on the disk.
        failures: commits that the disk did not take.
    """

    messages: int = 0
    message_bytes: int = 0
    applied: int = 0
    doubled: int = 0
    damaged: int = 0
    refused: int = 0
    pulls: int = 0
    pulled: int = 0
    restored: int = 0
    failures: int = 0

    def add(self, **more: int) -> None:
        """Raise some of them."""
        for name, by in more.items():
            setattr(self, name, getattr(self, name) + by)
