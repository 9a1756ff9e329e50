"""Maps whose lengths are all too long, or too short, in words."""

import math
from collections import Counter

from mapweave.hybridmap.ids import MapId
from mapweave.merge.pose_graph.map_scales import undone_in
from mapweave.merge.pose_graph.merged_map import MergedMap

MOST_NAMED = 3
"""Other maps that are named."""


def length_words(merged: MergedMap) -> dict[MapId, str]:
    """What is said of maps whose lengths the merge has corrected."""
    refused = [r.link for r in merged.refused if r.link is not None and r.edge is None]
    links = [link for link in (*merged.links, *refused) if not link.within]
    out = {}
    for which, log in undone_in(links).items():
        beside = Counter(one for link in links if which in link.maps for one in link.maps if one != which)
        others = [one for one, _ in sorted(beside.items(), key=lambda item: (-item[1], item[0]))]
        some = ", ".join(map(str, sorted(others[:MOST_NAMED])))
        more = f" and {len(others) - MOST_NAMED} more" if len(others) > MOST_NAMED else ""
        alone = "" if len(others) > 1 else "; which of the two is wrong, nothing shows"
        off, way = 100.0 * abs(math.expm1(log)), "long" if log > 0.0 else "short"
        out[which] = (
            f"all lengths of map {which} are about {off:.1f} % too {way} beside "
            f"those of {some}{more}, and are corrected{alone}: calibrate the wheels of {which.agent} "
            "(mapweave calibrate drive)"
        )
    return out
