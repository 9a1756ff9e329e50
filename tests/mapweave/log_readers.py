"""Readers of the logs that agents, replays and trials write for Foxglove and for Rerun."""

from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader

Rows = dict[str, list[tuple[int, Any]]]


def rows_of(path: Path) -> Rows:
    """By `entity:component`, the stamps and the values of a recording."""
    from rerun.chunk import RrdReader

    reader = RrdReader(path)
    (recording,) = reader.recordings()
    assert recording.application_id == "mapweave"
    found: Rows = {}
    for chunk in reader.store().stream():
        table = chunk.to_record_batch().to_pydict()
        stamps = table.get("stamp", [None] * chunk.num_rows)
        for name, column in table.items():
            if name not in ("stamp", "rerun.controls.RowId"):
                for stamp, value in zip(stamps, column, strict=True):
                    if value is not None:
                        at = 0 if stamp is None else stamp.value if hasattr(stamp, "value") else int(stamp)
                        found.setdefault(f"{chunk.entity_path}:{name.split(':')[-1]}", []).append((at, value))
    return {name: sorted(column, key=lambda row: row[0]) for name, column in found.items()}


def read(folder: Path) -> dict[str, list[tuple[int, Any]]]:
    """Stamps and messages by topic."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([folder]) as reader:
        for connection, stamp, data in reader.messages():
            found.setdefault(connection.topic, []).append(
                (stamp, reader.deserialize(data, connection.msgtype))
            )
    return found
