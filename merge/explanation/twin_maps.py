"""Twin maps: two that show the same places and cannot be one. No server can tell which of them is right."""

from collections.abc import Iterable

from mapweave.hybridmap.ids import MapId
from mapweave.merge.mutual_exclusion.collision import is_exclusion
from mapweave.merge.outlier_rejection.pairwise_consistency import ALIASED
from mapweave.merge.pose_graph.links import RefusedLink

TWINS = (
    "one of them may be of a second building that looks the same, have a wrong clock, or be a copy; "
    "if you know which is wrong, retire it"
)
"""What a person can do. The shell adds by which command; the page has a form."""
LEAST_NODES = 4
"""Of each map that show the same places: one or two look alike in many buildings."""


def is_twin_reason(reason: str) -> bool:
    """Whether a link was refused since its views are also found elsewhere, or robots exclude each other."""
    return ALIASED in reason or is_exclusion(reason)


def are_twins(refused: Iterable[RefusedLink]) -> bool:
    """Whether two maps show several of the same places and cannot be one."""
    pairs = [r.pair for r in refused if r.link is not None and is_twin_reason(r.reason)]
    return min((len({pair[k] for pair in pairs}) for k in (0, 1)), default=0) >= LEAST_NODES


def twin_words(first: MapId, second: MapId) -> str:
    """What is said of two such maps, in one line."""
    one, other = sorted((first, second))
    return f"{one} and {other} show the same places and cannot be one map: {TWINS}"
