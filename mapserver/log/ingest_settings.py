"""Times of an ingest."""

from dataclasses import dataclass, field

from mapweave.mapserver.log.agent_log import PullSettings


@dataclass(frozen=True, slots=True)
class IngestSettings:
    """How changes are taken in.

    Attributes:
        pull: when missing changes are pulled.
        ask_timeout: for a piece of a log, s.
        retry_interval: after a failed commit (disk full), s.
    """

    pull: PullSettings = field(default_factory=PullSettings)
    ask_timeout: float = 2.0
    retry_interval: float = 1.0
