"""Questions for explanations in the query of a request.

/explain                       each two maps of the fleet
/explain?a=r0.1&b=r1.1         two maps, or two nodes, places or positions
/route?a=r0.1.17&b=kitchen     a route; with &via=PLACE, also several times, over these in order
/route?a=1,2&b=3,4&near=r1.1.5 positions in the part of the map of this node or place, not in the largest one
"""

from itertools import pairwise

from starlette.datastructures import QueryParams

from mapweave.hybridmap.constraint_subject import EXAMPLE, read_ends
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.mission_order import MAX_VIA
from mapweave.hybridmap.named_nodes import Resolve, ids_of
from mapweave.hybridmap.query import ExplainRequest


def read_questions(path: str, query: QueryParams, resolve: Resolve) -> list[ExplainRequest]:
    """What is asked: one question, of a route one for each stretch between two stops.

    Args:
        path: `/explain` or `/route`.
        query: of the request.
        resolve: returns nodes for words.

    Raises:
        InvalidValue: something is missing, too much, or is not there.
    """
    route = path == "/route"
    if not query and not route:
        return [ExplainRequest()]
    via = query.getlist("via") if route else []
    if query.keys() - ({"via", "near"} if route else set()) != {"a", "b"}:
        more = "; for a route also &via=PLACE and &near=PLACE" if route else ""
        raise InvalidValue(f"write {path}?a=r0.1.17&b=r1.1.5: {EXAMPLE}{more}")
    if len(via) > MAX_VIA:
        raise InvalidValue(f"a route passes at most {MAX_VIA} places, not {len(via)}")
    stops = ids_of([query["a"], *via, query["b"]], resolve, query.get("near", ""))
    return [ExplainRequest(read_ends(a, b), route) for a, b in pairwise(stops)]
