"""Links by their nodes: only the last links count."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.map_maintenance.adjacency import Adjacency
from mapweave.merge.pose_graph.links import Link

NODES = [NodeId(agent, 1, number) for agent in ("r0", "r1") for number in range(4)]
Ends = tuple[NodeId, NodeId]
PAIRS = [(a, b) for k, a in enumerate(NODES) for b in NODES[k + 1 :]]


def link(pair: Ends) -> Link:
    return Link(*pair, PoseGaussian(Pose2(), np.eye(3)))


@given(st.lists(st.dictionaries(st.sampled_from(PAIRS), st.integers(0, 1), max_size=12), max_size=6))
def test_the_last_links_are_returned_and_only_new_pairs_are_fresh(rounds: list[dict[Ends, int]]):
    # Two links of each pair: it may be measured again.
    links = [{pair: link(pair) for pair in PAIRS} for _ in range(2)]
    known, before = Adjacency(), set[Ends]()
    for chosen in rounds:
        now = [links[which][pair] for pair, which in chosen.items()]
        assert {item.pair for item in known.follow(now)} == set(chosen) - before
        before = set(chosen)
        for node in NODES:
            assert {id(item) for item in known.at(node)} == {id(item) for item in now if node in item.pair}
        for a, b in PAIRS:
            there = next((item for item in now if item.pair == (a, b)), None)
            assert known.between(a, b) is there and known.between(b, a) is there
