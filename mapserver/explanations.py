"""Any explanation of a merged map, as it is asked for: of two nodes, of maps, of a route."""

from collections.abc import Collection

from mapweave.hybridmap.explanation import MAX_MAPS_LISTED, Explanation, FleetExplanation
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.query import ExplainRequest
from mapweave.mapserver.route_explaining import explain_route
from mapweave.mapserver.routes import Router
from mapweave.merge.explanation.map_explanation import explain_fleet, explain_maps
from mapweave.merge.explanation.map_lengths import length_words
from mapweave.merge.explanation.node_explanation import explain_nodes
from mapweave.merge.settings import ConsistencySettings


def explained(
    request: ExplainRequest,
    router: Router,
    consistency: ConsistencySettings,
    wary: Collection[tuple[NodeId, NodeId]] = (),
) -> Explanation:
    """Why nodes or maps are linked, or are not, or why a route leads this way. Takes its time.

    Args:
        request: what is asked.
        router: of the merged map.
        consistency: as in the merge.
        wary: pairs of nodes between which robots of late did not get through.

    Raises:
        InvalidValue: they are not there.
    """
    merged = router.merged
    if request.ends is None:
        accusations = (*merged.accusations().values(), *length_words(merged).values())[:MAX_MAPS_LISTED]
        return FleetExplanation(explain_fleet(merged, MAX_MAPS_LISTED), accusations)
    first, second = request.ends
    if isinstance(first, NodeId) and isinstance(second, NodeId):
        if request.route:
            return explain_route(router, first, second, request.blocked, wary)
        return explain_nodes(merged, first, second, None, consistency)
    pair = MapId(*first[:2]), MapId(*second[:2])
    lengths = length_words(merged)
    return FleetExplanation(
        (explain_maps(merged, *pair),), tuple(lengths[which] for which in pair if which in lengths)
    )
