"""No robot decides by its own maps which links of others are beyond chance."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.merge.merging import merge_maps
from mapweave.merge.pose_graph.links import Link
from synthetic.fleet import FleetSettings, SyntheticFleet, draw_fleet, link_between, map_of
from tests.quick import first_quick

MAPS, STRETCHES, LONG = 12, 3, 3
"""Maps of the robot, stretches of its way in each of these, and nodes of each stretch."""


def with_wrong_maps(
    fleet: SyntheticFleet, rng: np.random.Generator
) -> tuple[dict[MapId, HybridMap], list[Link]]:
    """Stretches of the way of one robot in wrong arrangements: links that are right one by one."""
    maps, links = dict(fleet.maps), list(fleet.links)
    shown = [node for node in sorted(fleet.truth) if node.agent == "r0"][: STRETCHES * LONG]
    for epoch in range(1, MAPS + 1):
        moved = [Pose2.from_vector(rng.uniform(0.0, 12.0, 3)) for _ in range(STRETCHES)]
        walk = [moved[k // LONG] @ fleet.truth[node] for k, node in enumerate(shown)]
        map_id = MapId("r9", epoch)
        maps[map_id] = map_of(map_id, walk, rng)
        seen = [k for k in range(len(shown)) if rng.random() < 0.2]
        links += [link_between(shown[k], NodeId("r9", epoch, k), Pose2(), rng) for k in seen]
    for one, other in combinations(range(1, MAPS + 1), 2):
        for k in range(len(shown)):
            if rng.random() < 0.5:
                links.append(link_between(NodeId("r9", one, k), NodeId("r9", other, k), Pose2(), rng))
    return maps, links


def of_one_place(
    fleet: SyntheticFleet, a: str, b: str, rng: np.random.Generator, moved: Pose2 | None = None
) -> list[Link]:
    """Three links between neighbouring nodes; false ones if the second robot is moved."""
    first = 5 if moved is None else 15
    ends = [(NodeId(a, 1, k), NodeId(b, 1, k)) for k in range(first, first + 3)]
    moved = moved or Pose2()
    return [link_between(x, y, fleet.truth[x].inverse() @ moved @ fleet.truth[y], rng) for x, y in ends]


@pytest.mark.parametrize("seed", first_quick(range(4), 2))
def test_wrong_maps_of_one_robot_part_no_others(seed: int):
    rng = np.random.default_rng(seed)
    fleet = draw_fleet(0.0, rng, FleetSettings(robots=3, nodes=30, true_links=0))
    between = of_one_place(fleet, "r1", "r2", rng)
    fleet = replace(fleet, links=(*of_one_place(fleet, "r0", "r1", rng), *between))
    assert len(merge_maps(fleet.maps, fleet.links).components) == 1
    maps, links = with_wrong_maps(fleet, rng)
    merged = merge_maps(maps, links)
    assert {link.key for link in fleet.links} <= {link.key for link in merged.links}
    # Where two others contradict each other as well, chance is what it is in the whole fleet.
    false = of_one_place(fleet, "r0", "r1", rng, Pose2(6.0, 0.0, 2.0))
    merged = merge_maps(maps, [*links, *false])
    assert {link.key for link in between}.isdisjoint(link.key for link in merged.links)
