"""Maps whose lengths are all too long, or too short, in words."""

from __future__ import annotations

import math

from mapweave.hybridmap.ids import MapId
from mapweave.merge.outlier_rejection.segmentation import fragments_of
from mapweave.merge.pose_graph.map_scales import MapScales
from mapweave.merge.pose_graph.marginalization import is_marginal
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.settings import ConsistencySettings

MOST_NAMED = 3
"""Other maps that are named."""


def length_words(merged: MergedMap, settings: ConsistencySettings | None = None) -> dict[MapId, str]:
    """What is said of maps whose lengths are all too long or too short; found again, which takes time.

    Args:
        merged: the merged map.
        settings: as in the merge.
    """
    links = [link for link in merged.links if len(link.shared) and not is_marginal(link)]
    links += [r.link for r in merged.refused if r.link is not None and r.edge is None]
    maps = {which: one for which, one in merged.maps.items() if which not in merged.constraints.retired}
    links = [link for link in links if all(which in maps for which in link.maps)]
    pieces = fragments_of(maps, settings or ConsistencySettings())
    out = {}
    for which, scale in MapScales().of(maps, pieces, links).items():
        if not scale.undone:
            continue
        off = 100.0 * math.expm1(scale.log)
        some = ", ".join(map(str, scale.others[:MOST_NAMED]))
        more = f" and {len(scale.others) - MOST_NAMED} more" if len(scale.others) > MOST_NAMED else ""
        alone = "" if len(scale.others) > 1 else "; which of the two is wrong, nothing shows"
        out[which] = (
            f"all lengths of map {which} are {abs(off):.1f} % too {'long' if off > 0 else 'short'} "
            f"(sigma {100.0 * scale.sigma:.1f} %) beside {some}{more}{alone}: "
            f"calibrate the wheels of {which.agent} (mapweave calibrate drive)"
        )
    return out
