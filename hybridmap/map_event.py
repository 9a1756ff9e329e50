"""What has happened to a merged map, with dates: plain values, no transport."""

from dataclasses import dataclass
from enum import StrEnum

from mapweave.hybridmap.limits import Stamp, Words


class MapEventKind(StrEnum):
    """What sort of thing has happened."""

    JOINED = "joined"
    PARTED = "parted"
    """A component has split; the words say what removed its links."""
    KEPT_APART = "kept apart"
    """Links between two maps were found, and refused: they put two robots in one place."""
    SET_APART = "set apart"
    """The merge fails with a map, or it is a copy, and is made without it; or it is taken in again."""
    IMPLAUSIBLE = "implausible"
    """In a map is what no robot can have measured."""
    CONSTRAINED = "constrained"
    """A person has decided."""
    ANNOTATED = "annotated"
    """A person has said something about the map."""
    COMMANDED = "commanded"
    """A person has sent, stopped or driven a robot."""
    FRAME = "frame"
    """A pin yields to an older one, or holds its component's frame again."""
    CONTRADICTED = "contradicted"
    """What robots have measured contradicts a link by hand, which stays."""
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class MapEvent:
    """Something that happened.

    Attributes:
        stamp_ns: when it was noticed, wall time since 1970.
        kind: what sort of thing.
        words: what, and why; one printable line.
    """

    stamp_ns: Stamp
    kind: MapEventKind
    words: Words


@dataclass(frozen=True, slots=True)
class History:
    """What has happened, in order."""

    history: tuple[MapEvent, ...]
