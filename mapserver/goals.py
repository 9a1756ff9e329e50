"""Goals in a person's words: a node, a position in the merged map, home."""

from __future__ import annotations

import math

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.node import MapId, NodeId
from mapweave.mapserver.routes import Router

REACH = 2.0
"""A position goes to the nearest node if that is no farther away, m; robots park at nodes alone."""
HOME = "home"
FORMS = "give a node (r0.1.17), a position in the merged map (3.1,-2.0) or home"


def node_of_goal(goal: str, map_id: MapId, router: Router) -> NodeId:
    """The node where a robot shall park.

    Args:
        goal: in a person's words.
        map_id: the map that the robot makes.
        router: of the merged map.

    Raises:
        InvalidValue: there is no such goal, or the robot's map is not joined with it.
    """
    merged = router.merged
    own = [node for node in merged.poses if node.map == map_id]
    if goal == HOME:
        if not own:
            raise InvalidValue(f"the map {map_id} of {map_id.agent} has no node yet: it has no home")
        return min(own)
    position = _position(goal)
    if position is not None:
        return _nearest(position, own, router)
    try:
        node = NodeId.parse(goal)
    except InvalidValue:
        raise InvalidValue(f"goal {goal!r}: {FORMS}") from None
    if node.map == map_id:
        return node  # the robot knows best
    # A robot that has mapped nothing yet may find itself on the map of another.
    if missing := router.missing(min(own, default=node), node):
        raise InvalidValue(missing)
    return node


def _position(goal: str) -> tuple[float, float] | None:
    words = goal.split(",")
    try:
        x, y = map(float, words)
    except ValueError:
        return None
    if not (math.isfinite(x) and math.isfinite(y)):
        raise InvalidValue(f"goal {goal!r}: {FORMS}")
    return x, y


def _nearest(position: tuple[float, float], own: list[NodeId], router: Router) -> NodeId:
    merged, poses = router.merged, router.roads.active_poses
    component = merged.component_of(own[0]) if own else 0
    members = [node for node in poses if merged.component_of(node) == component]
    if not members:
        raise InvalidValue("the merged map has no nodes yet")
    x, y = position
    distance, node = min((math.hypot(poses[n].x - x, poses[n].y - y), n) for n in members)
    if distance > REACH:
        raise InvalidValue(
            f"nothing is mapped within {REACH:g} m of {x:g},{y:g}: the nearest node is {node}, "
            f"{distance:.1f} m away at {poses[node].x:.1f},{poses[node].y:.1f}"
        )
    return node
