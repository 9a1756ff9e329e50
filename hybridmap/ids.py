"""Ids of maps, nodes and edges. Nothing here needs numpy: who only passes messages on starts without it."""

from __future__ import annotations

import re
from typing import NamedTuple

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.limits import MAX_NUMBER, Name, Number

NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,31}")
"""See mapweave.hybridmap.limits.Name."""
DIGITS = re.compile(r"[0-9]{1,20}")
"""Digits of other scripts, and superscripts, are none."""


def read_number(text: str) -> int | None:
    """The number of a map or a node; None if the text is none, or a larger one than any of these."""
    number = int(text) if DIGITS.fullmatch(text) else None
    return None if number is None or number > MAX_NUMBER else number


def check_name(name: str) -> str:
    """Return the name, or raise InvalidValue if it cannot be part of a key."""
    if not NAME.fullmatch(name):
        raise InvalidValue(f"name {name!r}: use 1 to 32 of a-z, 0-9, '-' and '_'")
    return name


class MapId(NamedTuple):
    """Whose map, and which: a fresh epoch starts when a robot starts a map from nothing."""

    agent: Name
    epoch: Number

    def __str__(self) -> str:
        """The id in text, for example `r0.1`."""
        return f"{self.agent}.{self.epoch}"


class NodeId(NamedTuple):
    """(agent, epoch, number), never reused. Edges have ids of the same form from the same counter."""

    agent: Name
    epoch: Number
    number: Number

    @property
    def map(self) -> MapId:
        """The map that the element belongs to."""
        return MapId(self.agent, self.epoch)

    def __str__(self) -> str:
        """The id in text, for example `r0.1.17`."""
        return f"{self.agent}.{self.epoch}.{self.number}"

    @staticmethod
    def parse(text: str) -> NodeId:
        """Read `agent.epoch.number`.

        Raises:
            InvalidValue: the text is of another form.
        """
        agent, *numbers = text.split(".")
        match [read_number(number) for number in numbers]:
            case [int(epoch), int(number)]:
                return NodeId(check_name(agent), epoch, number)
        raise InvalidValue(f"{text!r} is no node id; they look like r0.1.17")


EdgeId = NodeId
MERGE_AUTHOR = "merge"
"""Takes the agent's place in the ids of edges that the merge makes."""
