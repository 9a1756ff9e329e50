"""Questions that a robot asks about the fleet's map, and their answers: plain values, no transport."""

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.constraint_subject import Ends
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.limits import (
    MAX_NUMBER,
    MAX_POSITION,
    NAME_OR_NOTHING,
    Angle,
    Coordinate,
    LandmarkCount,
    Name,
    Number,
    Probability,
    Words,
)
from mapweave.hybridmap.node import EdgeKind, Node
from mapweave.hybridmap.portal import PortalStop
from mapweave.hybridmap.pose import Pose2, PoseGaussian

MAX_CANDIDATES = 64
"""In one answer; a limit for messages, as the next two are."""
MAX_BLOCKED = 256
"""Edges in one question."""
MAX_OBSTACLES = 64
"""In one question."""
MAX_REACH = 5.0
"""Of an obstacle, m: two of the largest robots beside each other."""
MAX_LEGS = 512
"""A route through a building has tens of legs."""
MAX_WORDS_ASKED = 64
"""Places that are asked for at once. A limit for messages."""
REACH = 2.0
"""A position is the nearest node if that is no farther away, m; robots park at nodes alone."""
MAX_KNOWN = 512
"""Views in one answer: 8 kB, as much as two or three nodes."""


@dataclass(frozen=True, eq=False)
class View:
    """The features of one image, in columns.

    Attributes:
        pixels: (N, 2) float32, undistorted px.
        codes: (N, 32) uint8, compact SIFT descriptors.
        camera: the camera that took it; may be another than the mapping robot's.
        near: the robot knows that it is on the floor of this node; None if it does not.
    """

    pixels: NDArray[np.float32]
    codes: NDArray[np.uint8]
    camera: Camera
    near: NodeId | None = None

    def __len__(self) -> int:
        return len(self.pixels)


class Certainty(StrEnum):
    """Certainty of a relocalization."""

    FOUND = "found"
    PLACE = "place"
    """The place is known, but not how far from its node the view was taken: its scale was not measured."""
    AMBIGUOUS = "ambiguous"
    UNKNOWN = "unknown"


NO_COMPONENT = -1
"""Component of a node that is not in the merged map yet."""


@dataclass(frozen=True, eq=False)
class Whereabouts:
    """One place where the robot may be.

    Attributes:
        node: the node that was recognised.
        node_from_robot: the robot's pose in that node's robot frame.
        merged_from_robot: the same in the merged frame of the node's component, if it has one.
        component: number of the node's component in the merged map; `NO_COMPONENT` if it is in none.
        inliers: landmarks that agree.
        probability: that this place is the right one, 0 to 1.
        distance_known: if not, the node's scale was not measured, and the covariance includes that.
        place: the name of the place where this is; empty if it has none.
        floor: the floor of the component; empty if it is not known.
    """

    node: NodeId
    node_from_robot: PoseGaussian
    merged_from_robot: PoseGaussian | None
    component: Annotated[int, Meta(ge=-1, le=MAX_NUMBER)]
    inliers: LandmarkCount
    probability: Probability
    distance_known: bool = True
    place: Annotated[str, Meta(max_length=64)] = ""
    floor: Annotated[str, Meta(max_length=256)] = ""


@dataclass(frozen=True, slots=True)
class SimilarPlace:
    """A place that a view looks like, and what is missing to recognise it.

    Attributes:
        node: whose view it looks like.
        matches: landmarks of the node that match.
        inliers: of these, those that agree on one pose.
        needed: as many would have to agree.
        lacks: what is missing, in words.
        turn: by which the camera would look where the node's did, rad, positive to the left; None if too
            little agrees to tell.
    """

    node: NodeId
    matches: Number
    inliers: Number
    needed: Number
    lacks: Words
    turn: Angle | None = None


@dataclass(frozen=True, eq=False)
class RelocalizeAnswer:
    """Where a view was taken: candidates best first, and the reason of the outcome, in words.

    An unknown place may have one candidate: then too few landmarks agree for this view to be certain alone,
    and another view that gives the same place is enough.

    Attributes:
        certainty: of the outcome.
        candidates: where the robot may be.
        reason: of the outcome.
        similar: if the place is unknown, what came nearest to being recognised, best first.
        partial: in words, what of the map could not be searched; empty if all of it was. A partial answer is
            never certain.
    """

    certainty: Certainty
    candidates: Annotated[tuple[Whereabouts, ...], Meta(max_length=MAX_CANDIDATES)]
    reason: Words
    similar: Annotated[tuple[SimilarPlace, ...], Meta(max_length=MAX_CANDIDATES)] = ()
    partial: Words = ""


@dataclass(frozen=True, eq=False)
class RouteLeg:
    """One hop of a route: how to get from the node before to this node.

    Attributes:
        node: the node to reach, with its landmarks.
        previous_from_node: its pose in the robot frame of the node before; identity for the first.
        kind: of the edge that is driven; None for the first node, where the route starts.
    """

    node: Node
    previous_from_node: PoseGaussian
    kind: EdgeKind | None


@dataclass(frozen=True, eq=False)
class RouteAnswer:
    """A way through the merged map.

    Attributes:
        legs: the first is the node where the robot is; empty if there is no way.
        reason: in words.
        portal: where the legs end if that is not the goal: from its other side on the robot asks again.
        detour: which robots stand on a shorter way, in words; empty without one.
    """

    legs: Annotated[tuple[RouteLeg, ...], Meta(max_length=MAX_LEGS)]
    reason: Words
    portal: PortalStop | None = None
    detour: Words = ""


@dataclass(frozen=True, eq=False)
class KnownAnswer:
    """What others have mapped around a position of a robot's own map.

    Attributes:
        views: (N, 4) [x m, y m, heading rad, horizontal semi-aperture rad], in the map of the question: the
            other robots' nodes and their fields of view, nearest first.
        reason: of the outcome, in words.
    """

    views: NDArray[np.float32]
    reason: Words

    def __post_init__(self) -> None:
        """Refuse more views than a message holds, and a number out of range (InvalidValue)."""
        if self.views.shape != (len(self.views), 4) or len(self.views) > MAX_KNOWN:
            raise InvalidValue(f"views of shape {self.views.shape}; at most ({MAX_KNOWN}, 4) are sent")
        # A comparison with what is no number is false.
        bounded = (np.abs(self.views) <= [MAX_POSITION, MAX_POSITION, 4.0, 4.0]).all()
        if not bounded or (self.views[:, 3] < 0.0).any():
            raise InvalidValue("a view's pose or aperture is out of range")
        object.__setattr__(self, "views", self.views.astype(np.float32))


Blocked = Annotated[tuple[tuple[NodeId, NodeId], ...], Meta(max_length=MAX_BLOCKED)]
"""Pairs of nodes between which a robot could not drive."""


@dataclass(frozen=True, slots=True)
class Obstacle:
    """A place where a robot could not drive: no way that passes within `reach` of it is of use to it.

    Attributes:
        node: by which the place is known.
        x: m, in the robot frame of that node.
        y: m, likewise.
        reach: m, from the place to the middle of a robot that touches what is there.
        robot: that stands there; empty if it is none. Once the server knows it elsewhere, the place is free.
    """

    node: NodeId
    x: Coordinate
    y: Coordinate
    reach: Annotated[float, Meta(ge=0.0, le=MAX_REACH)]
    robot: Annotated[str, Meta(pattern=NAME_OR_NOTHING)] = ""


@dataclass(frozen=True, slots=True)
class RouteRequest:
    """How does one get from node to node?

    Attributes:
        start: node that the robot knows itself by.
        goal: node where it wants to be.
        blocked: pairs of nodes between which it could not drive.
        start_from_robot: where it is exactly.
        obstacles: places where it could not drive.
    """

    start: NodeId
    goal: NodeId
    blocked: Blocked = ()
    start_from_robot: Pose2 = field(default_factory=Pose2)
    obstacles: Annotated[tuple[Obstacle, ...], Meta(max_length=MAX_OBSTACLES)] = ()


@dataclass(frozen=True, slots=True)
class ReserveRequest:
    """May a robot drive on? It asks again every second, so that it keeps what it has.

    Attributes:
        robot: its name.
        start: node that the robot knows itself by.
        start_from_robot: where it is exactly.
        route: the nodes ahead of it, in order; none releases what it holds.
    """

    robot: Name
    start: NodeId
    start_from_robot: Pose2
    route: Annotated[tuple[NodeId, ...], Meta(max_length=MAX_LEGS)]


@dataclass(frozen=True, slots=True)
class ReserveAnswer:
    """How far a robot may drive.

    Attributes:
        granted: so many nodes of its route, from the first.
        holder: the robot that holds what comes then; empty if none does.
        aside: both wait for each other: this robot steps aside, to this node; None if it only waits.
        reason: in words.
        closed: whether a person has closed the way ahead; the robot asks for another one.
        occupied: whether the holder stands at the end of the route, without a way of its own.
    """

    granted: Annotated[int, Meta(ge=0, le=MAX_LEGS)]
    holder: Annotated[str, Meta(max_length=32)]
    aside: NodeId | None
    reason: Words
    closed: bool = False
    occupied: bool = False


@dataclass(frozen=True, slots=True)
class KnownRequest:
    """What have others mapped around a position?

    Attributes:
        map: the asking robot's own.
        x: m, in that map.
        y: m, in that map.
        reach: how far around, m.
    """

    map: MapId
    x: Coordinate
    y: Coordinate
    reach: Annotated[float, Meta(ge=0.0, le=MAX_POSITION)]


@dataclass(frozen=True, slots=True)
class ResolveRequest:
    """Which nodes are these words?

    Attributes:
        words: nodes (r0.1.17), names of places, or positions in the merged map (3.1,-2.0).
        near: a node, or a place: positions are in the frame of its component; empty: of the largest one.
        reach: a position is refused if no node is nearer than this, m.
    """

    words: Annotated[tuple[Annotated[str, Meta(max_length=64)], ...], Meta(max_length=MAX_WORDS_ASKED)]
    near: Annotated[str, Meta(max_length=64)] = ""
    reach: Annotated[float, Meta(ge=0.0, le=MAX_POSITION)] = REACH


@dataclass(frozen=True, slots=True)
class Resolved:
    """A node for a word.

    Attributes:
        node: an active one, unless the word is a node itself.
        merged_from_node: its pose in the frame of its component.
        component: number of the component.
        place: the name of the place, if the word is one; else empty.
        note: what is to be said about it, such as that another node was taken; may be empty.
    """

    node: NodeId
    merged_from_node: Pose2
    component: Annotated[int, Meta(ge=0, le=MAX_NUMBER)]
    place: Annotated[str, Meta(max_length=64)] = ""
    note: Words = ""


@dataclass(frozen=True, slots=True)
class ResolveAnswer:
    """One for each word."""

    found: Annotated[tuple[Resolved, ...], Meta(max_length=MAX_WORDS_ASKED)]


@dataclass(frozen=True, slots=True)
class ExplainRequest:
    """Why are these linked, or are not? Or why does a route lead this way, and why is there none?

    Attributes:
        ends: two nodes or two maps, for a route start and goal; None for each two maps of the fleet.
        route: whether it is about the route between two nodes.
        blocked: for a route, pairs of nodes between which the robot cannot drive.
    """

    ends: Ends | None = None
    route: bool = False
    blocked: Blocked = ()

    def __post_init__(self) -> None:
        """Refuse routes from what is no node (InvalidValue)."""
        if self.route and (self.ends is None or not all(isinstance(end, NodeId) for end in self.ends)):
            raise InvalidValue("a route leads from node to node: r0.1.17 r1.1.5")
