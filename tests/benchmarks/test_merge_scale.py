"""The merge at scale: the building is as specified, and a small fleet is merged completely."""

import numpy as np
import pytest
from rich.progress import Progress

from benchmarks.merge.scale import at_size, scale
from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.errors import InvalidValue
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.verification import verify
from synthetic.building import Building


def test_links_that_are_drawn_are_those_that_would_be_found():
    """Verification confirms most pairs that are specified to show the same, with their relative poses."""
    building = Building.draw(3, 24, 5)
    result = np.ones(building.rooms.shape, np.bool_)
    nodes = {b.node.id: b.node for r in range(3) for _, b in building.log(r) if isinstance(b, NodePut)}
    overlaps, links = building.knowledge(result)
    assert overlaps.keys() == links.keys() and len(links) > 10
    outcome = [verify(nodes[a], nodes[b]) for a, b in list(links)[:12]]
    good = [item for item in outcome if isinstance(item, Link)]
    assert len(good) >= 8
    for item in good:
        true = building.world_from(item.a).inverse() @ building.world_from(item.b)
        assert item.a_from_b.mean.distance(true) < 0.4


@pytest.mark.slow
def test_a_small_fleet_becomes_one_map():
    figures = at_size(200, 0, Progress(disable=True), measured=6)
    assert figures["false_links"] == 0.0 and figures["links"] > 50.0
    assert figures["components"] == 1.0 and figures["error_m_median"] < 0.5
    assert figures["ms_per_node_p95"] >= figures["ms_per_node_median"] > 0.0
    with pytest.raises(InvalidValue, match="hundreds"):
        scale([250], 0, Progress(disable=True))
