"""A robot chooses the ids of its nodes, and these seed the random numbers by which nodes are compared."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.verification import verify
from synthetic.wrong_geometry import SCENES, OdometryFault, draw_fleet
from tests.quick import first_quick

FALSE = (0.0, 0.45, 0.6)
"""Share of the landmarks of one node that are elsewhere in the image: beyond 0.65 no link is left."""


@pytest.mark.parametrize("seed", first_quick([33001, 33002, 33003], 1))
def test_ids_do_not_decide_whether_two_nodes_are_linked_or_where(seed: int):
    found = 0
    for a, b in _alike(seed):
        for share in FALSE:
            shown = _spoiled(b, share, seed)
            verdicts = [verify(a, replace(shown, id=NodeId("zz", 1, 10**6 + k))) for k in range(8)]
            links = [verdict for verdict in verdicts if isinstance(verdict, Link)]
            assert len(links) in (0, len(verdicts)), (a.id, b.id, share)
            found += bool(links)
            for link in links:
                between = links[0].a_from_b.mean.inverse() @ link.a_from_b.mean
                assert np.hypot(between.x, between.y) < 0.03 and abs(between.heading) < 0.02
    assert found >= 8, "else nothing is shown"


def _alike(seed: int) -> Iterator[tuple[Node, Node]]:
    """Six pairs of nodes that are linked."""
    fleet = draw_fleet(seed, SCENES["room"], OdometryFault.NONE, stops=2)
    nodes = [node for nodes, _ in fleet.maps.values() for node in nodes]
    pairs = list(combinations(nodes, 2))
    count = 0
    for k in np.random.default_rng(seed).permutation(len(pairs)):
        if count < 6 and isinstance(verify(*pairs[k]), Link):
            count += 1
            yield pairs[k]


def _spoiled(node: Node, share: float, seed: int) -> Node:
    """With so many landmarks at other pixels."""
    rng, pixels = np.random.default_rng([seed, 1]), node.landmarks.pixels.copy()
    chosen = rng.random(len(pixels)) < share
    size = (node.camera.width - 1, node.camera.height - 1)
    pixels[chosen] = (rng.random((int(chosen.sum()), 2)) * size).astype(pixels.dtype)
    return replace(node, landmarks=replace(node.landmarks, pixels=pixels))
