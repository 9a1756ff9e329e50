"""The log as one JSON object a line, for programs that collect logs. The standard library alone."""

import json
import logging
from datetime import UTC, datetime
from typing import Any

EVENTS = "mapweave"
"""Logger of events that are printed."""
USUAL = {*vars(logging.makeLogRecord({})), "message", "asctime"}
"""Attributes that every record has."""


class JsonFormatter(logging.Formatter):
    """Time (UTC), level, logger and message; the map, robot and node of a message, and its `extra`."""

    def __init__(self, **fields: str) -> None:
        """Take fields that every line has, for example the robot's name."""
        super().__init__()
        self._fields = fields

    def format(self, record: logging.LogRecord) -> str:
        """One line."""
        when = datetime.fromtimestamp(record.created, UTC)
        line: dict[str, Any] = {
            "time": when.isoformat(timespec="milliseconds").replace("+00:00", "Z"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": one_line(record.getMessage()),
            **self._fields,
            **_named(record.args),
            **{name: value for name, value in vars(record).items() if name not in USUAL},
        }
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return escaped(json.dumps(line, ensure_ascii=False, default=str))


def one_line(text: str) -> str:
    """Text of others as a log or a terminal shows it: nothing in it controls the terminal."""
    return escaped(" ".join(text.split()))


def escaped(text: str) -> str:
    """The text with all that is not printable as in JSON: escape sequences, marks that turn the direction."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else json.dumps(c)[1:-1] for c in text)


def _named(arguments: object) -> dict[str, str]:
    """The map, robot and node that a message names as values; the first of each kind."""
    from mapweave.hybridmap.ids import MapId, NodeId

    found: dict[str, str] = {}
    for value in arguments if isinstance(arguments, tuple) else ():
        if isinstance(value, NodeId):
            found.setdefault("node", str(value))
        if isinstance(value, MapId | NodeId):
            found.setdefault("map", str(MapId(*value[:2])))
            found.setdefault("robot", value.agent)
    return found


def json_line(line: str, level: int = logging.INFO) -> str | None:
    """An event as a line of the log if the log is JSON; else None."""
    for handler in logging.getLogger().handlers:
        if isinstance(handler.formatter, JsonFormatter):
            record = {"name": EVENTS, "levelno": level, "levelname": logging.getLevelName(level), "msg": line}
            return handler.formatter.format(logging.makeLogRecord(record))
    return None
