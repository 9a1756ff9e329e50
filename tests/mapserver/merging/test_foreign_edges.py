"""A robot's edges between nodes of others do not change how these are merged."""

import numpy as np
import pytest

from mapweave.hybridmap.change import ChangeBody, EdgePut, EdgeRetired, NodePut
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.mapserver.merging.merger import Merger
from mapweave.merge.pose_graph.merged_map import MergedMap
from synthetic.maps import map_tours
from synthetic.world import room

Log = list[tuple[MapId, ChangeBody]]
LIAR = MapId("liar", 1)


@pytest.fixture(scope="module")
def sound() -> Log:
    """Two robots that have mapped one room, and the beginning of another one's map, in another room."""
    rng = np.random.default_rng(1)
    world = room(0, 0, 5, 4, 600, rng)
    tour = [Pose2(2.2 + 0.1 * k, 1.8, 0.9 * k) for k in range(4)]
    logs = map_tours(world, {MapId(agent, 1): tour for agent in ("r0", "r1")}, rng)
    logs |= map_tours(
        room(20, 0, 5, 4, 600, rng), {LIAR: [Pose2(22.2 + 0.1 * k, 1.8) for k in range(2)]}, rng
    )
    return [(map_id, change) for map_id, log in logs.items() for change in log]


def said(merged: MergedMap) -> tuple[object, ...]:
    """All that a merge has decided of the sound robots."""
    links = [(link.pair, link.weight) for link in merged.links]
    return links, [(r.pair, r.reason) for r in merged.refused if r.edge is None], [
        (node, merged.pose(node)) for node in sorted(merged.poses)
    ]  # fmt: skip


def claims(log: Log, kind: EdgeKind, landmarks: int) -> Log:
    """Edges of another robot between all of their nodes, entirely wrong."""
    nodes = [body.node for map_id, body in log if isinstance(body, NodePut) and map_id != LIAR]
    pairs = [(a, b) for k, a in enumerate(nodes) for b in nodes[:k]]
    shared = np.repeat(np.arange(landmarks)[:, None], 2, axis=1)
    far = PoseGaussian.from_sigmas(Pose2(40.0, 0.0, 1.0), 0.01, 0.01)
    return [
        (LIAR, EdgePut(Edge(NodeId(*LIAR, 1000 + k), a.id, b.id, far, kind, shared)))
        for k, (a, b) in enumerate(pairs)
    ]


@pytest.mark.parametrize("kind", list(EdgeKind))
@pytest.mark.parametrize("when", ["before", "after", "taken back"])
def test_edges_between_the_nodes_of_others_change_nothing(sound: Log, kind: EdgeKind, when: str):
    merger = Merger()
    merger.read(sound)
    alone = merger.merged()
    assert len(alone.links) > 2
    lies = claims(sound, kind, 50)
    merger = Merger()
    merger.read([*lies, *sound] if when == "before" else [*sound, *lies])
    if when == "taken back":
        merger.read([(LIAR, EdgeRetired(NodeId(*LIAR, 1000 + k))) for k in range(len(lies))])
    merged = merger.merged()
    assert said(merged) == said(alone)
    assert merged.union().edges.keys() == alone.union().edges.keys()
