"""Moved furniture in images of the simulator: which landmarks are on it, by the floor plan, not by rays."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.life_sim.benchmark import Fleet
from mapweave.hybridmap.node import MapId
from mapweave.sim.floorplan import distances_to


@pytest.fixture(scope="module")
def fleet() -> Fleet:
    made = Fleet(5, 1, 2)
    made.drive(1)
    return made


@pytest.mark.slow
def test_landmarks_of_moved_furniture_are_on_its_outline(fleet: Fleet) -> None:
    pairs = zip(fleet.before.plan.furniture, fleet.after.plan.furniture, strict=True)
    moved = [old for old, new in pairs if old != new]
    on_it = 0
    for node in fleet.merger.maps[MapId("r0", 1)].nodes.values():
        known = np.flatnonzero(node.landmarks.has_depth)
        points = fleet.truth[node.id].apply(node.points_in_robot[known])
        near = distances_to(moved, points[:, :2])
        # Depths are off by some centimetres, more far away.
        off = 4.0 * node.landmarks.depth_sigmas[known]
        on = fleet.on_moved(node)[known]
        assert (near[on] < 0.05 + off[on]).all()
        on_it += int(on.sum())
    assert moved and on_it >= 20


def test_nothing_has_been_shown_since_before_there_is_a_later_drive(fleet: Fleet) -> None:
    nodes = list(fleet.merger.maps[MapId("r0", 1)].nodes.values())
    assert not any(fleet.shown_since(node).any() for node in nodes)
    last = fleet.faded(fleet.merger.merged())
    assert last.seen == last.moved_faded == last.others_faded == 0 < last.moved
