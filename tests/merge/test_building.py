"""A large building whose links are all true becomes one map, at once and without a link refused."""

import numpy as np
import pytest

from mapweave.mapserver.merging.merger import Merger
from synthetic.building import Building


@pytest.mark.scenario
def test_ten_thousand_nodes_with_true_links_become_one_map():
    """What was left of strain between rounds once made two true ways of joining contradict each other."""
    building = Building.draw(100, 100, seed=3)
    result = np.ones(building.rooms.shape, np.bool_)
    merger = Merger()
    merger.read((part for robot in range(100) for part in building.log(robot)), *building.knowledge(result))
    merged = merger.merged()
    assert len(merged.components) == 1 and len(merged.poses) == 10_000
    # One in ten thousand strains too much by chance.
    assert len(merged.refused) <= 4 and len(merged.links) > 22_000
