"""Values that messages cannot hold are left out of answers: they must not cost the answer.

A map may have its nodes anywhere, and a camera may have its principal point anywhere. Results from such
numbers may be out of the range of messages.
"""

from collections.abc import Callable, Collection
from dataclasses import replace

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import PoseGaussian
from mapweave.hybridmap.query import NO_COMPONENT, Certainty, RelocalizeAnswer, RouteAnswer
from mapweave.wire.pose_codec import pack_pose

FARTHEST = 1e5
"""Nodes farther from the middle of their map are left out, m: float32 has steps of 8 mm there."""
LONGEST_LEG = 1e3
"""No robot drives farther from node to node, m."""
MOST_DETOURS = 8
"""Alternative routes around legs out of range that are tried."""

Pairs = tuple[tuple[NodeId, NodeId], ...]


def in_range(pose: PoseGaussian | None) -> bool:
    """Whether a pose is in the range of messages; none at all is."""
    try:
        return pose is None or bool(pack_pose(pose))
    except InvalidValue:
        return False


def within_range(answer: RelocalizeAnswer) -> RelocalizeAnswer:
    """An answer without candidates that are out of range.

    A candidate of which only the merged pose is out of range keeps the rest. The certainty stays: if the
    robot may be at a place that is left out, it is not certain to be at the other. If the robot's own place
    is out of range, the answer is that it is unknown.
    """
    fine = [in_range(candidate.node_from_robot) for candidate in answer.candidates]
    candidates = tuple(
        candidate
        if in_range(candidate.merged_from_robot)
        else replace(candidate, merged_from_robot=None, component=NO_COMPONENT)
        for candidate, good in zip(answer.candidates, fine, strict=True)
        if good
    )
    sure = answer.certainty in (Certainty.FOUND, Certainty.PLACE)
    if answer.candidates and (not candidates or (sure and not fine[0])):
        reason = f"the place is out of the range of messages: {answer.reason}"
        return RelocalizeAnswer(Certainty.UNKNOWN, (), reason, partial=answer.partial)
    return replace(answer, candidates=candidates)


def drivable(
    route: Callable[[Pairs], RouteAnswer], blocked: Collection[tuple[NodeId, NodeId]]
) -> RouteAnswer:
    """A route of which every leg is within the range of messages, and no longer than robots drive.

    Args:
        route: finds the best way that passes none of some pairs of nodes.
        blocked: pairs that are not to be passed in any case.
    """
    around = tuple(blocked)
    for _ in range(MOST_DETOURS):
        answer = route(around)
        names = [leg.node.id for leg in answer.legs]
        bad = tuple(
            (before, leg.node.id)
            for before, leg in zip(names[:1] + names[:-1], answer.legs, strict=True)
            if not in_range(leg.previous_from_node)
            or max(abs(leg.previous_from_node.mean.x), abs(leg.previous_from_node.mean.y)) > LONGEST_LEG
        )
        if not bad:
            return answer
        around += bad
    return RouteAnswer((), f"every way leads over legs longer than {LONGEST_LEG:g} m, which no robot drives")
