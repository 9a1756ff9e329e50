"""Portals: lifts, ramps and doors through which a robot asks to be taken."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, ClassVar

from msgspec import Meta

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.limits import Name, Number

MOST_NOTE = 120
"""Characters of a note."""
MAX_FLOOR_WORDS = 256
"""Characters of a floor's labels. A limit for messages; longer ones are cut."""


class PortalMeans(StrEnum):
    """What takes a robot from one side to the other."""

    LIFT = "lift"
    RAMP = "ramp"
    DOOR = "door"
    """Of which both sides are on one floor."""


@dataclass(frozen=True, slots=True)
class Portal:
    """A way that no robot drives by itself, in both directions: a person, or a command, takes it through.

    Attributes:
        a: node at one side; a robot parks there and asks.
        b: node at the other side.
        means: what it is.
        note: for who takes a robot through, such as where the key is; may be empty.
    """

    TAG: ClassVar[str] = "portal"
    a: NodeId
    b: NodeId
    means: PortalMeans
    note: Annotated[str, Meta(max_length=MOST_NOTE)] = ""

    def __post_init__(self) -> None:
        """Refuse one node at both sides, and notes that are no printable line (InvalidValue)."""
        if self.a == self.b:
            raise InvalidValue(f"a portal leads from one node to another, not from {self.a} to itself")
        if len(self.note) > MOST_NOTE or not self.note.isprintable():
            raise InvalidValue(f"the note is one printable line, at most {MOST_NOTE} characters")

    @property
    def anchor(self) -> NodeId:
        """The node by which its position is known."""
        return self.a

    @property
    def words(self) -> str:
        """The portal in words."""
        return f"a {self.means} between {self.a} and {self.b}" + (f" ({self.note})" if self.note else "")


@dataclass(frozen=True, slots=True)
class PortalStop:
    """A portal on a robot's way, in the direction in which the robot is to be taken through it.

    Attributes:
        name: of the portal.
        means: what it is.
        entry: the node at which the robot stands and asks.
        exit: the node at the other side.
        floor: the label of the floor there; empty if it has none.
        note: see Portal.
    """

    name: Annotated[str, Meta(max_length=64)]
    means: PortalMeans
    entry: NodeId
    exit: NodeId
    floor: Annotated[str, Meta(max_length=MAX_FLOOR_WORDS)] = ""
    note: Annotated[str, Meta(max_length=MOST_NOTE)] = ""

    @property
    def title(self) -> str:
        """Its kind and name, for example `lift 'east lift'`."""
        return f"{self.means} '{self.name}'"

    @property
    def beyond(self) -> str:
        """Where it leads, for example `floor 2`."""
        if self.floor and self.means is not PortalMeans.DOOR:
            return f"floor {self.floor}"
        return f"the other side, node {self.exit}"


@dataclass(frozen=True, slots=True)
class PortalWait:
    """What has become of a robot at a portal.

    Attributes:
        portal: at which it has parked.
        asked: how often it has asked.
        done: whether a person says that it was taken through; it then looks where it is.
    """

    portal: PortalStop
    asked: Number = 1
    done: bool = False


@dataclass(frozen=True, slots=True)
class PortalDone:
    """A robot that waits at a portal has been taken through.

    Attributes:
        robot: its name.
        by: who says so.
    """

    robot: Name
    by: Annotated[str, Meta(max_length=64)] = ""
