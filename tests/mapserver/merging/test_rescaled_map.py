"""A robot sends its map again with other lengths, while others use what has come of it so far."""

import numpy as np
import pytest

from mapweave.agent.mapping.rescaling import rescaled_edge, rescaled_node
from mapweave.agent.mapping.way_correction import WayCorrection
from mapweave.hybridmap.change import Change, ChangeBody, EdgePut, NodePut
from mapweave.mapserver.merging.merger import Merger
from mapweave.merge.pose_graph.merged_map import MergedMap
from synthetic.wrong_geometry import ODD, SCENES, FaultyFleet, OdometryFault, draw_fleet

SEED = 21
TOO_LONG = 1.05
"""The robot's wheels report so many times the way, until that is corrected."""


def worst_link(merged: MergedMap, truth: dict) -> float:
    """By how much the links miss where their nodes truly are, at most, m."""
    return max(
        (truth[link.a].inverse() @ truth[link.b]).distance(link.a_from_b.mean) for link in merged.links
    )


def worst_node(merged: MergedMap, truth: dict) -> float:
    """How far the nodes of the largest component are from where they truly are, at most, m.

    After the best rigid alignment (Umeyama 1991), in complex numbers.
    """
    nodes = max(merged.components, key=len)
    here, there = (
        np.array([complex(pose.x, pose.y) for pose in poses])
        for poses in (
            [merged.poses[node].merged_from_robot.mean for node in nodes],
            [truth[node] for node in nodes],
        )
    )
    here, there = here - here.mean(), there - there.mean()
    turn = np.vdot(here, there)
    return float(np.abs(turn / abs(turn) * here - there).max())


@pytest.fixture(scope="module")
def fleet() -> FaultyFleet:
    """Four robots in a house of two rooms; the wheels of the last report too much."""
    fleet = draw_fleet(SEED, SCENES["house"], OdometryFault.NONE, stops=1)
    nodes, edges = fleet.maps[ODD]
    longer = WayCorrection(scale=TOO_LONG)
    fleet.maps[ODD] = (
        [rescaled_node(node, longer) for node in nodes],
        [rescaled_edge(edge, TOO_LONG) for edge in edges],
    )
    return fleet


def sent_again(fleet: FaultyFleet) -> list[ChangeBody]:
    """What the robot sends when its wheels are corrected, as `KeyframeBuilder` does: nodes, then edges."""
    nodes, edges = fleet.maps[ODD]
    way = WayCorrection.about(nodes[-1].map_from_robot.mean, 1.0 / TOO_LONG)
    return [
        *(NodePut(rescaled_node(node, way)) for node in nodes),
        *(EdgePut(rescaled_edge(edge, 1.0 / TOO_LONG)) for edge in edges),
    ]


@pytest.mark.slow
def test_a_map_that_comes_again_with_other_lengths_is_whole_and_links_nothing_wrongly(fleet: FaultyFleet):
    merger = Merger()
    for change in fleet.changes():
        merger.on_change(change)
    before = merger.merged()
    bodies = sent_again(fleet)
    for number, body in enumerate(bodies):
        merger.on_change(Change(ODD, 1000 + number, 0, body))
        if number % 6 == 5:
            merged = merger.merged()
            # Of both lengths at once, nothing links what is not the same, and no map is in more pieces.
            assert worst_link(merged, fleet.truth) < 0.35
            assert len(merged.components) <= len(before.components)
            assert not merged.implausible
    after = merger.merged()
    assert len(after.components) == 1 and not after.wrong
    assert worst_link(after, fleet.truth) < 0.35
    assert worst_node(after, fleet.truth) < 0.1
    # What is decided is what another server decides that has seen the corrected map alone.
    fresh = Merger()
    fresh.read([(map_id, body) for map_id, one in merger.maps.items() for body in one.contents()])
    known = fresh.merged()
    assert known.components == after.components
    assert [link.pair for link in known.links] == [link.pair for link in after.links]
    for one, other in zip(known.links, after.links, strict=True):
        np.testing.assert_array_equal(one.a_from_b.mean.vector, other.a_from_b.mean.vector)
