"""Joining many maps at once, in steps."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from hybridmap.hybrid_map import HybridMap
from hybridmap.node import MapId, Node, NodeId
from hybridmap.pose import Pose2, PoseGaussian
from hybridmap.ruling import Rulings
from merge.belief.agglomeration import joined
from merge.belief.consistency import Sorted
from merge.graph.links import Link
from merge.incremental.islands import Islands
from merge.incremental.judgement import Judge
from merge.incremental.pools import Pools
from merge.incremental.settings import StepSettings
from merge.incremental.verdicts import Verdicts
from merge.merging import merge_maps
from synthetic.building import Building
from synthetic.fleet import BARE, CAMERA
from tests.merge.lives import DENSE, Life, polished


def test_a_first_merge_in_steps_is_the_merge_made_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten maps of a building, all at once: pools that are ranked by what was found before, and few rounds."""
    building = Building.draw(8, 50, 3)
    monkeypatch.setattr("synthetic.building.take_node", bare_node)
    maps = {MapId(f"r{k}", 1): HybridMap(body for _, body in building.log(k)) for k in range(8)}
    verdicts = Verdicts()
    _, links = building.knowledge(np.ones(building.rooms.shape, np.bool_))
    for pair, link in links.items():
        if pair[0].map != pair[1].map or abs(pair[0].number - pair[1].number) > 8:
            verdicts.put(pair, link)
    every = [v for maps_ in sorted(verdicts.at(set(maps))) for v in verdicts.between(maps_).values()]
    rounds: list[int] = []
    real = Judge.round
    monkeypatch.setattr(Judge, "round", lambda *a: (rounds.append(1), real(*a))[1])
    merged = Islands(steps=StepSettings(anew_up_to=0)).merge(maps, verdicts, set(maps), Rulings())
    anew = merge_maps(maps, [v for v in every if isinstance(v, Link)])
    assert len(merged.components) == len(anew.components) == 1 and len(anew.links) > 100
    assert [link.pair for link in merged.links] == [link.pair for link in anew.links]
    for node, pose in polished(merged, anew).items():
        assert merged.pose(node).distance(pose) < 1e-6
    assert len(rounds) <= 10


def bare_node(
    world: object, node_id: NodeId, truth: Pose2, here: PoseGaussian, rng: object, sensing: object
) -> Node:
    """A node of which only the posture counts."""
    return Node(node_id, node_id.number, here, CAMERA, BARE)


def test_joined_pieces_have_nothing_else_to_say() -> None:
    """Each is the other's best, or the other's better ones are not tied to it by any link."""
    weights = {(0, 1): 9.0, (0, 2): 8.0, (0, 3): 7.0, (2, 3): 1.0, (4, 5): 2.0, (3, 4): 1.5}
    # 2 and 1 are tied by links that do not suffice: what 1 says of 2 is heard first.
    assert joined(weights, {*weights, (1, 2)}) == [(0, 1), (4, 5)]
    # 3 waits for what 2 says of it.
    assert joined(weights, weights) == [(0, 1), (0, 2), (4, 5)]
    # The weights of nobody's best join nothing.
    assert joined({(0, 1): 3.0, (1, 2): 2.0, (2, 3): 3.0}, ()) == [(0, 1), (2, 3)]


@pytest.mark.parametrize("seed", range(4))
def test_a_pool_weighs_no_more_than_its_parts(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is drawn: what was found of sets apart is at least what is found of them together."""
    life = Life(seed, 0.3, DENSE)
    for _ in range(60):
        life.step(quiet=True)
    found: list[tuple[float, float]] = []
    real = Pools._sorted

    def checked(
        self: Pools, whole: object, labels: object, some: NDArray[np.int64], graphs: object
    ) -> Sorted:
        bound = self._at_most(some)
        out: Sorted = real(self, whole, labels, some, graphs)  # type: ignore[arg-type]
        found.append((bound, out.weight))
        return out

    monkeypatch.setattr(Pools, "_sorted", checked)
    how = StepSettings(anew_up_to=0, whole_share=-1.0)
    Islands(steps=how).merge(life.maps, life.verdicts, life.touched, life.rulings)
    assert found and all(weight <= bound + 1e-9 for bound, weight in found)
