"""Wall time in people's words."""

import time
from datetime import UTC, datetime, timedelta, timezone

import pytest

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.wall_time import local_words, read_time, utc_words

NOW = datetime(2026, 3, 1, 13, 30, tzinfo=UTC)
NOW_NS = round(NOW.timestamp()) * 10**9
EAST = timezone(timedelta(hours=2))


@pytest.mark.parametrize(
    ("text", "zone", "expected"),
    [
        ("14:00", UTC, datetime(2026, 3, 1, 14, 0, tzinfo=UTC)),
        ("13:30", UTC, datetime(2026, 3, 2, 13, 30, tzinfo=UTC)),
        ("14:00", EAST, datetime(2026, 3, 2, 12, 0, tzinfo=UTC)),
        ("16:00", EAST, datetime(2026, 3, 1, 14, 0, tzinfo=UTC)),
        ("14:00 UTC", EAST, datetime(2026, 3, 1, 14, 0, tzinfo=UTC)),
        ("14:00z", EAST, datetime(2026, 3, 1, 14, 0, tzinfo=UTC)),
        ("2026-07-01 08:15", EAST, datetime(2026, 7, 1, 6, 15, tzinfo=UTC)),
        ("2026-07-01 08:15 utc", EAST, datetime(2026, 7, 1, 8, 15, tzinfo=UTC)),
        ("2026-07-01T08:15:30+01:00", EAST, datetime(2026, 7, 1, 7, 15, 30, tzinfo=UTC)),
        ("2026-07-01", UTC, datetime(2026, 7, 1, tzinfo=UTC)),
        ("+2h", EAST, datetime(2026, 3, 1, 15, 30, tzinfo=UTC)),
        ("+30min", UTC, datetime(2026, 3, 1, 14, 0, tzinfo=UTC)),
        ("+1.5d", UTC, datetime(2026, 3, 3, 1, 30, tzinfo=UTC)),
    ],
)
def test_times_are_read(text, zone, expected):
    assert read_time(text, NOW_NS, zone) == round(expected.timestamp()) * 10**9


@pytest.mark.parametrize(
    ("text", "zone", "expected"),
    [
        ("14:00", UTC, datetime(2026, 2, 28, 14, 0, tzinfo=UTC)),
        ("13:30", UTC, datetime(2026, 3, 1, 13, 30, tzinfo=UTC)),
        ("15:00", EAST, datetime(2026, 3, 1, 13, 0, tzinfo=UTC)),
        ("2026-07-01 08:15", UTC, datetime(2026, 7, 1, 8, 15, tzinfo=UTC)),
    ],
)
def test_times_of_the_past_are_read(text: str, zone: timezone, expected: datetime):
    assert read_time(text, NOW_NS, zone, past=True) == round(expected.timestamp()) * 10**9


@pytest.mark.parametrize(
    ("begin", "end", "expected"),
    [
        ("22:00", "06:00", datetime(2026, 3, 2, 6, 0, tzinfo=UTC)),
        ("13:00", "13:40", datetime(2026, 3, 2, 13, 40, tzinfo=UTC)),
        ("2026-03-05 22:00", "06:00", datetime(2026, 3, 6, 6, 0, tzinfo=UTC)),
        ("2026-03-05 22:00", "+2h", datetime(2026, 3, 1, 15, 30, tzinfo=UTC)),
        ("1999-01-01", "14:00", datetime(2026, 3, 1, 14, 0, tzinfo=UTC)),
    ],
)
def test_an_end_without_a_date_is_behind_its_begin(begin: str, end: str, expected: datetime):
    """A closure over midnight could be made before 06:00 and after 22:00 with dates alone."""
    begin_ns = read_time(begin, NOW_NS, UTC)
    assert read_time(end, NOW_NS, UTC, begin_ns) == round(expected.timestamp()) * 10**9


@pytest.mark.parametrize(
    "text",
    ["", "soon", "25:00", "14:61", "2026-13-01", "1960-01-01", "+h", "9999-12-31 23:59", "14"],
)
def test_what_is_no_time_is_refused(text):
    with pytest.raises(InvalidValue):
        read_time(text, NOW_NS, UTC)


def test_a_time_is_written_in_both_zones():
    assert utc_words(NOW_NS) == "2026-03-01 13:30 UTC"
    assert local_words(NOW_NS, EAST) == "2026-03-01 15:30 +0200"


def test_a_clock_is_set_forward_or_back_until_then(monkeypatch):
    """In the evening before, 14:00 was the 14:00 of a clock that was not changed."""
    try:
        with monkeypatch.context() as patch:
            patch.setenv("TZ", "CET-1CEST,M3.5.0,M10.5.0/3")
            time.tzset()
            for evening, afternoon in (("2026-03-28 22:00", 12), ("2026-10-24 22:00", 13)):
                now = datetime.fromisoformat(evening).astimezone()
                expected = datetime.combine(now.date() + timedelta(1), datetime.min.time(), UTC)
                read = read_time("14:00", round(now.timestamp()) * 10**9)
                assert read == round((expected + timedelta(hours=afternoon)).timestamp()) * 10**9
    finally:
        time.tzset()


def test_a_clock_that_is_set_back_shows_a_time_twice(monkeypatch):
    """Of the second 02:30 a quarter of an hour before it, it was that of the next day."""
    try:
        with monkeypatch.context() as patch:
            patch.setenv("TZ", "CET-1CEST,M3.5.0,M10.5.0/3")
            time.tzset()
            first, second = (datetime(2026, 10, 25, hour, 30, tzinfo=UTC) for hour in (0, 1))
            for now, shown in (
                (first - timedelta(minutes=15), first),
                (first, second),
                (second - timedelta(minutes=15), second),
                (second, second + timedelta(days=1)),
            ):
                now_ns = round(now.timestamp()) * 10**9
                assert read_time("02:30", now_ns) == round(shown.timestamp()) * 10**9
            # The night in which it is set forward has no 02:30; that was 01:30.
            night = datetime(2026, 3, 28, 23, 0, tzinfo=UTC)
            read = read_time("02:30", round(night.timestamp()) * 10**9)
            assert read == round(datetime(2026, 3, 29, 1, 30, tzinfo=UTC).timestamp()) * 10**9
    finally:
        time.tzset()


def test_a_long_text_is_refused_at_once():
    """It may come over HTTP, with megabytes of blanks."""
    with pytest.raises(InvalidValue, match=r"is no time") as refused:
        read_time("a" + 500_000 * " " + "az", 0)
    assert len(str(refused.value)) < 300
