"""Goals, and places on the way, in a person's words: a node, a named place, a position, home."""

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.mapserver.places import PlaceResolver, position_of

HOME = "home"
FORMS = "give a node (r0.1.17), a named place, a position in the merged map (3.1,-2.0) or home"


def node_of_goal(goal: str, map_id: MapId, places: PlaceResolver, name: str = "goal") -> NodeId:
    """The node where a robot shall park, or which it shall pass.

    Args:
        goal: in a person's words.
        map_id: the map that the robot makes.
        places: of the merged map.
        name: what errors call it.

    Raises:
        InvalidValue: there is no such goal, or the robot's map is not joined with it.
    """
    router = places.router
    merged = router.merged
    own = [node for node in merged.poses if node.map == map_id]
    if goal == HOME:
        if not own:
            first = min(merged.maps[map_id].nodes, default=None) if map_id in merged.maps else None
            if why := merged.why_left_out(first or NodeId(*map_id, 0)):
                raise InvalidValue(f"{map_id.agent} has no home: {why}")
            raise InvalidValue(f"the map {map_id} of {map_id.agent} has no node yet: it has no home")
        return min(own)
    named = places.annotations.last("place", goal) is not None
    if not named and position_of(goal) is None:
        try:
            node = NodeId.parse(goal)
        except InvalidValue:
            raise InvalidValue(
                f"{name} {goal!r} is no place of this map{places.alike(goal)}: {FORMS}"
            ) from None
        if node.map == map_id and not router.closed_goal(node, name):
            return node  # the robot knows best
    else:
        node = places.resolve(goal, (merged.component_of(own[0]) or 0) if own else 0).node
    # A robot that has mapped nothing yet may find itself on the map of another.
    if missing := router.missing(min(own, default=node), node, ("start" if own else name, name)):
        raise InvalidValue(f"{name} {goal}: {missing}" if named else missing)
    return node
