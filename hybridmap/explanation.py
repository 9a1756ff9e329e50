"""Why two nodes, or two maps, are linked or are not: plain values with every number behind the verdict."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.limits import (
    MAX_POSITION,
    Amount,
    Angle,
    Cost,
    Distance,
    Key,
    Number,
    Probability,
    Words,
)
from mapweave.hybridmap.manual_constraint import ManualConstraint
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Array, PoseGaussian


class Standing(StrEnum):
    """What has become of two nodes."""

    LINKED = "linked"
    OWN = "own"
    """Joined by an edge of their robot's own map: it drove or turned there, or recognised the place."""
    REFUSED = "refused"
    """Compared, and not linked."""
    UNDONE = "undone"
    """A manual constraint."""
    UNCOMPARED = "not compared"
    """Other pairs are more similar; the numbers come from a comparison made for the explanation."""


ALIASED = "aliased"
"""Name among a link's evidence: of its inliers, landmarks that are found at other places too; absent if none
is known (see mapweave.merge.outlier_rejection.distinctness)."""
MARGINAL = "marginal"
"""Likewise, of a link that is left of nodes that have left the map (see
mapweave.merge.pose_graph.marginalization)."""


MAX_MAPS_LISTED = 256
"""Pairs of maps in one answer."""


@dataclass(frozen=True, slots=True)
class LinkAgreement:
    """Another link between the same two pieces of map.

    Attributes:
        a: its end in the piece of the explained pair's a.
        b: its other end.
        distance2: how far the loop through both links is from closing, chi-square with 3 degrees of freedom.
        agrees: whether that is within the gate of the merge.
        kept: whether the merge keeps it.
    """

    a: NodeId
    b: NodeId
    distance2: Amount
    agrees: bool
    kept: bool


@dataclass(frozen=True, eq=False)
class Misfit:
    """How far a link is from where the merged map has put its nodes.

    Attributes:
        merged_a_from_b: pose of b in a in the merged map.
        off: (3,) m, m, rad: from the link's b to the merged one, in the link's b.
        strain2: `off` in the link's own uncertainty, chi-square with 3 degrees of freedom.
        alone: whether only this link connects the two.
    """

    merged_a_from_b: PoseGaussian
    off: Array
    strain2: Amount
    alone: bool

    def __post_init__(self) -> None:
        """Refuse what is no difference of poses (InvalidValue)."""
        if self.off.shape != (3,) or not (np.abs(self.off) <= 2 * MAX_POSITION).all():
            raise InvalidValue("a misfit must be three numbers of a pose")


@dataclass(frozen=True, eq=False)
class PairExplanation:
    """Why two nodes are linked, or are not.

    Attributes:
        a: the smaller id.
        b: the greater id.
        standing: what has become of them.
        reason: in words.
        matches: (M, 2) int64, mutually best matches of the landmarks of a and of b.
        shared: (K, 2) int64, of these, those that agree on one pose.
        residuals_px: (K,) px, how far these are from where the pose predicts them (NaN: behind the image).
        a_from_b: the pose that the landmarks give; None if they agree on none.
        evidence: numbers of mapweave.registration.recognition, empty without a pose.
        probability: that the link is right, see mapweave.merge.outlier_rejection.link_probability; None
            without a pose, or where nothing joins the two.
        misfit: against the merged map; None if nothing joins the two.
        other_links: other links between the same two pieces of map.
        claims: what the robots' own edges say about the two, whether the servo could drive them, and which of
            the two is superseded; one sentence each.
        constraints: manual constraints on these two or their maps, in order.
    """

    a: Node
    b: Node
    standing: Standing
    reason: Words
    matches: NDArray[np.int64]
    shared: NDArray[np.int64]
    residuals_px: Array
    a_from_b: PoseGaussian | None = None
    evidence: Annotated[dict[Key, float], Meta(max_length=64)] = field(default_factory=dict)
    probability: Probability | None = None
    misfit: Misfit | None = None
    other_links: tuple[LinkAgreement, ...] = ()
    claims: tuple[Words, ...] = ()
    constraints: tuple[ManualConstraint, ...] = ()

    def __post_init__(self) -> None:
        """Refuse pairs of landmarks that the nodes do not have, and residuals of others (InvalidValue)."""
        counts = [len(self.a.landmarks), len(self.b.landmarks)]
        for pairs in (self.matches, self.shared):
            if pairs.shape != (len(pairs), 2) or not ((pairs >= 0) & (pairs < counts)).all():
                raise InvalidValue("a landmark is named that the node does not have")
        if self.residuals_px.shape != (len(self.shared),) or (self.residuals_px < 0.0).any():
            raise InvalidValue(f"residuals {self.residuals_px.shape} of {len(self.shared)} landmarks")


@dataclass(frozen=True, slots=True)
class NearMiss:
    """Two nodes of two maps that came near to being linked, or are and might as well not be.

    Attributes:
        a: node of the first map.
        b: node of the second.
        matches: matched landmarks.
        inliers: of these, those that agree on the best pose.
        lacks: what it lacks, in words; of an accepted link, whether routes may use it.
    """

    a: NodeId
    b: NodeId
    matches: Number
    inliers: Number
    lacks: Words


@dataclass(frozen=True, slots=True)
class MapsExplanation:
    """Why two maps are one, or are not.

    Attributes:
        first: the smaller id.
        second: the greater id.
        joined: whether any node of one is in one component with any of the other.
        reason: in words.
        links: between the two.
        landmarks: behind these.
        refused: links that were found and refused.
        unverified: candidate pairs without a common pose.
        nearest: pairs that came nearest to a link, best first; of links that were refused, then of others. Of
            two maps that are one the links with the fewest landmarks behind them, weakest first.
        constraints: manual constraints on the two maps, in order.
        over: maps, in order, over which links join two that are one and that no link joins directly. Empty
            also where other pieces of the two themselves do.
    """

    first: MapId
    second: MapId
    joined: bool
    reason: Words
    links: Number
    landmarks: Number
    refused: Number
    unverified: Number
    nearest: tuple[NearMiss, ...] = ()
    constraints: tuple[ManualConstraint, ...] = ()
    over: tuple[MapId, ...] = ()


@dataclass(frozen=True, slots=True)
class FleetExplanation:
    """Why each pair of some maps is joined or is not.

    Attributes:
        maps: two each.
        accusations: what is held against maps, the ones that are set apart among them.
    """

    maps: Annotated[tuple[MapsExplanation, ...], Meta(max_length=MAX_MAPS_LISTED)]
    accusations: Annotated[tuple[Words, ...], Meta(max_length=MAX_MAPS_LISTED)] = ()


@dataclass(frozen=True, slots=True)
class Hop:
    """A step from one node to another on a way, or what keeps robots from driving there.

    Attributes:
        a: from here.
        b: to there.
        kind: of the edge, see mapweave.hybridmap.node.EdgeKind; `near` if the two are at one place,
            `superseded` if one is superseded by the other; lift, ramp or door of a portal.
        distance: m, between the two.
        turn: rad, between their headings, signed.
        cost: what it adds to the cost of a route, m.
        words: why it can be driven, or why it is not.
    """

    a: NodeId
    b: NodeId
    kind: Key
    distance: Distance
    turn: Angle
    cost: Cost
    words: Words


@dataclass(frozen=True, slots=True)
class RouteExplanation:
    """Why a route leads the way it does, or why there is none.

    Attributes:
        start: where it begins.
        goal: where it shall end.
        found: whether there is a way.
        reason: in words.
        hops: of the way, in order.
        gaps: what robots cannot, or should not, drive. Of a route: on the cheapest way if all could be
            driven; without a route: on the way that lacks least. Empty if there is no better way, or if
            nothing connects the two.
        apart: of two maps that would have to be one first; of several, those that came nearest to it.
    """

    start: NodeId
    goal: NodeId
    found: bool
    reason: Words
    hops: tuple[Hop, ...] = ()
    gaps: tuple[Hop, ...] = ()
    apart: MapsExplanation | None = None


def route_over(legs: Sequence[RouteExplanation]) -> RouteExplanation:
    """One route of those from stop to stop: all of their steps, or what is missing.

    Args:
        legs: one or more; each begins where the one before ends.
    """
    missing = [leg for leg in legs if not leg.found]
    listed = missing or legs
    if len(legs) == 1:
        return legs[0]
    reason = ". ".join(f"{leg.start} to {leg.goal}: {leg.reason}" for leg in listed)
    hops = () if missing else tuple(hop for leg in legs for hop in leg.hops)
    gaps = tuple(gap for leg in listed for gap in leg.gaps)
    apart = next((leg.apart for leg in missing if leg.apart is not None), None)
    return RouteExplanation(legs[0].start, legs[-1].goal, not missing, reason, hops, gaps, apart)


Explanation = PairExplanation | FleetExplanation | RouteExplanation
"""Of two nodes, of some two maps each, or of a route."""
