"""Types with ranges, for the fields of values that come in messages and files.

In a program they are plain types. Messages and files with a field out of range are refused
(`mapweave.wire.typed`). Text is one printable line and numbers are finite in all of them.
"""

from typing import Annotated

from msgspec import Meta

MAX_NUMBER = 2**53
"""Largest node number, sequence number and the like: exact in every language's numbers."""

MAX_STAMP_NS = 2**63 - 1

MAX_POSITION = 1e6
"""Largest coordinate in messages, m: merged poses are sums of what robots measured."""

MAX_FLOAT = 1e300
"""Replaces an infinite number in messages."""

MAX_LANDMARKS = 2000
"""Of a node."""

NAME_OR_NOTHING = r"^([a-z0-9][a-z0-9_-]{0,31})?\Z"

Name = Annotated[str, Meta(pattern=r"^[a-z0-9][a-z0-9_-]{0,31}\Z")]
"""What an agent, server or fleet may be called: it becomes a chunk of a key expression."""

Key = Annotated[str, Meta(max_length=32)]
"""Of a table of numbers."""

MAX_WORDS = 4096
"""Characters of a text."""
Words = Annotated[str, Meta(max_length=MAX_WORDS)]
"""For people."""

Number = Annotated[int, Meta(ge=0, le=MAX_NUMBER)]
Stamp = Annotated[int, Meta(ge=0, le=MAX_STAMP_NS)]
"""ns."""

Coordinate = Annotated[float, Meta(ge=-MAX_POSITION, le=MAX_POSITION)]
"""m, or rad of a heading that is not wrapped."""

Amount = Annotated[float, Meta(ge=0.0)]
Distance = Annotated[float, Meta(ge=0.0, le=4 * MAX_POSITION)]
"""m."""

Cost = Annotated[float, Meta(ge=0.0, le=1e9)]
Angle = Annotated[float, Meta(ge=-7.0, le=7.0)]
"""rad, a turn or less to either side."""

Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Probability = Share
LandmarkCount = Annotated[int, Meta(ge=0, le=MAX_LANDMARKS)]
