"""What one robot could not drive is dear for the others, for a while, and never out of the question."""

import math
from itertools import pairwise

import numpy as np
import pytest

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.blockages import Blockages
from mapweave.mapserver.routes import Router
from synthetic.maps import changes_of, merger_of
from synthetic.world import room, take_map

A, B, C = (NodeId("a", 1, number) for number in (1, 3, 5))
ME = MapId("a", 1)


def test_a_blockage_is_forgotten_after_its_last_report():
    blockages = Blockages(forget=100.0)
    blockages.report([(B, A)], 0.0)
    blockages.report([(A, B), (B, C)], 50.0)
    assert set(blockages.known(149.0)) == {(A, B), (B, C)}
    assert blockages.known(150.0) == []
    assert blockages.known(0.0) == [], "what was forgotten does not come back"


def test_without_a_clock_nothing_is_forgotten_but_the_oldest():
    blockages = Blockages(forget=math.inf, most=2)
    for pair in ((A, B), (B, C), (A, B), (A, C)):
        blockages.report([pair], 0.0)
    assert blockages.known(1e9) == [(A, B), (A, C)]


def test_no_robot_displaces_what_others_have_reported():
    """One that says that all is blocked displaced the reports of all others."""
    blockages = Blockages(most=8)
    blockages.report([(A, B), (B, C)], 0.0, "r0")
    blockages.report([(A, C)], 0.0, "r1")
    ends = [NodeId("z", 1, number) for number in range(100)]
    for now in range(3):
        blockages.report([*pairwise(ends)], float(now), "r9")
    known = blockages.known(3.0)
    assert len(known) == 8 and {(A, B), (B, C), (A, C)} < {*known}
    assert known[3:] == [*pairwise(ends)][-5:], "of its own the last ones are kept"
    blockages.report([(A, B)], 100.0, "r9")
    assert blockages.known(122.5) == [(A, B)], "it counts from the last report of any robot"


@pytest.fixture(scope="module")
def ring() -> tuple[Router, list[NodeId]]:
    """Nine nodes on a circle of 0.8 m radius; the chain's ends stand close together, and so are joined."""
    rng = np.random.default_rng(0)
    angles = np.linspace(0.0, 1.95 * math.pi, 9)
    tour = [Pose2(3 + 0.8 * math.cos(a), 3 + 0.8 * math.sin(a), a) for a in angles]
    nodes, edges = take_map(room(0, 0, 6, 6, 900, rng), ME, tour, rng, sigma_xy=0.005, sigma_heading=0.005)
    return Router(merger_of({ME: changes_of(nodes, edges)}).merged()), [node.id for node in nodes]


def test_others_are_led_around_a_blockage_and_through_it_where_there_is_no_other_way(
    ring: tuple[Router, list[NodeId]],
):
    router, nodes = ring

    def way(**arguments: object) -> list[NodeId]:
        answer = router.route(nodes[0], nodes[2], **arguments)  # type: ignore[arg-type]
        return [leg.node.id for leg in answer.legs]

    hop = (nodes[2], nodes[1])
    assert way() == nodes[:3]
    around = way(wary=[hop])
    assert around[0] == nodes[0] and around[-1] == nodes[2]
    assert all({a, b} != set(hop) for a, b in pairwise(around)) and len(around) > 3
    # Dear on both sides is still a way; barred on both sides is none.
    other = (nodes[5], nodes[6])
    assert way(wary=[hop, other]) == nodes[:3]
    assert way(blocked=[hop, other]) == []
