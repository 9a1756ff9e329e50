"""Wall time as people write it: local time, or UTC where that is said."""

import re
from collections.abc import Callable
from datetime import UTC, datetime, timedelta, tzinfo

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.limits import MAX_STAMP_NS

NANOSECONDS = 1_000_000_000
FORMS = "write 14:00, 2026-03-01 14:00 ({}), 2026-03-01 14:00 UTC, 2026-03-01T14:00+01:00, or +2h, +30min"
"""With the zone of times that name none."""
LONGEST = 64
"""Characters of a time. Of a longer text of blanks the expressions below would take hours."""
CLOCK = re.compile(r"(\d{1,2}):(\d{2})")
LATER = re.compile(r"\+(\d+(?:\.\d+)?)\s*(min|h|d)")
HOURS = {"min": 1.0 / 60.0, "h": 1.0, "d": 24.0}


def utc_words(stamp_ns: int) -> str:
    """A time in words, for example `2026-03-01 14:00 UTC`."""
    return datetime.fromtimestamp(stamp_ns // NANOSECONDS, UTC).strftime("%Y-%m-%d %H:%M UTC")


def local_words(stamp_ns: int, zone: tzinfo | None = None) -> str:
    """The same in local time with its distance from UTC, for example `2026-03-01 15:00 +0100`."""
    return datetime.fromtimestamp(stamp_ns // NANOSECONDS, UTC).astimezone(zone).strftime("%Y-%m-%d %H:%M %z")


def read_time(
    text: str, now_ns: int, zone: tzinfo | None = None, begin_ns: int = 0, *, past: bool = False
) -> int:
    """A time as ns since 1970.

    Args:
        text: see `FORMS`; without a date the next time that the clock shows this.
        now_ns: the present.
        zone: of times that name none; this machine's by default.
        begin_ns: of an end, what it is the end of: without a date it is the next time after that, too.
        past: whether a time without a date is the last that the clock showed, and not the next.

    Raises:
        InvalidValue: it is no time.
    """
    if len(text) > LONGEST:
        raise InvalidValue(f"{text[:LONGEST]!r}... is no time: {_forms(zone)}")
    words, now = text.strip(), datetime.fromtimestamp(now_ns / NANOSECONDS, UTC).astimezone(zone)
    if (later := LATER.fullmatch(words)) is not None:
        hours = float(later[1]) * HOURS[later[2]]
        return _stamp(text, zone, lambda: now + timedelta(hours=hours))
    if re.search(r"(utc|z)$", words, re.IGNORECASE):
        words, now = re.sub(r"\s*(utc|z)$", "", words, flags=re.IGNORECASE), now.astimezone(UTC)

    def in_zone(time: datetime) -> datetime:
        # Of a zone that is not named, the distance from UTC on that day, not today's.
        if zone or now.tzinfo is UTC:
            return time.replace(tzinfo=now.tzinfo)
        # By way of the stamp: a time that is left out when the clock is set forward is one behind that.
        return datetime.fromtimestamp(time.timestamp(), UTC).astimezone()

    def dated() -> datetime:
        time = datetime.fromisoformat(words)
        return time if time.tzinfo is not None else in_zone(time)

    if (clock := CLOCK.fullmatch(words)) is None:
        return _stamp(text, zone, dated)

    def shown() -> datetime:
        begin = datetime.fromtimestamp(begin_ns / NANOSECONDS, UTC)
        # Of a zone that is not named, its date on that day.
        after = max(now, begin.astimezone(now.tzinfo if zone or now.tzinfo is UTC else None))
        today = after.replace(hour=int(clock[1]), minute=int(clock[2]), second=0, microsecond=0, tzinfo=None)
        # A clock that is set back shows a time twice.
        if past:
            times = today.replace(fold=1), today, today - timedelta(days=1)
            return next(time for time in map(in_zone, times) if time <= after)
        times = today, today.replace(fold=1), today + timedelta(days=1)
        return next(time for time in map(in_zone, times) if time > after)

    return _stamp(text, zone, shown)


def _forms(zone: tzinfo | None) -> str:
    return FORMS.format("local time" if zone is None else zone)


def _stamp(text: str, zone: tzinfo | None, make: Callable[[], datetime]) -> int:
    try:
        stamp_ns = round(make().timestamp()) * NANOSECONDS
    except (ValueError, OverflowError):
        raise InvalidValue(f"{text!r} is no time: {_forms(zone)}") from None
    if not 0 <= stamp_ns <= MAX_STAMP_NS:
        raise InvalidValue(f"{text!r} is out of range")
    return stamp_ns
