"""The store of a large fleet: real places of simulated buildings, and as many more as are wanted.

Robots `m0`, `m1` ... mapped a building each; robots `d0`, `d1` ... have mapped what is made of others' views
(benchmarks.relocalize.distractors). Each robot's nodes hang together by edges, as the ways of a real one do.
"""

import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from benchmarks.relocalize.distractors import Distractors
from benchmarks.relocalize.places import TruePlace
from mapweave.hybridmap.change import ChangeBody, EdgePut, NodePut
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.quantization import snap
from mapweave.mapserver.log.entry import ReceivedChange
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.wire.codec import encode_change
from synthetic.maps import fill_store, numbered

ROBOT_NODES = 500
"""Nodes of each robot that is made up."""
STEP, TURN = 1.0, 0.9
"""m, and most rad, from one of them to the next."""
SIGMA = (0.01, 0.01)
"""Of a way from node to node, m and rad."""


def fill(
    path: Path,
    places: Sequence[TruePlace],
    distractors: Distractors,
    total: int,
    progress: Callable[[int], None],
) -> None:
    """Make the store, by as many processes as there are cores: a node takes about 3 ms to encode.

    Args:
        path: of the store; it must not be there yet.
        places: real nodes.
        distractors: make the others.
        total: nodes wanted.
        progress: called with the number of new nodes.
    """
    store = SqliteStore(path)
    for number in sorted({place.site for place in places}):
        here = [place for place in places if place.site == number]
        fill_store(store, {MapId(f"m{number}", 1): _surveyed([place.node for place in here])})
        progress(len(here))
    left = max(total - len(places), 0)
    robots = [range(k, min(k + ROBOT_NODES, left)) for k in range(0, left, ROBOT_NODES)]
    work = partial(_robot, distractors)
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        for number, messages in enumerate(pool.map(work, robots)):
            map_id = MapId(f"d{number}", 1)
            entries = [ReceivedChange.read(map_id, k + 1, message) for k, message in enumerate(messages)]
            store.apply(map_id, 1, entries)
            progress(len(robots[number]))
    store.close()


def _robot(distractors: Distractors, numbers: range) -> list[bytes]:
    """The log of one robot that is made up: nodes along a way, and the way."""
    map_id = MapId(f"d{numbers.start // ROBOT_NODES}", 1)
    rng = np.random.default_rng([distractors.seed, 0xD1, numbers.start])
    at, nodes = Pose2(), []
    for k, number in enumerate(numbers):
        node = distractors.node(number)
        pose = PoseGaussian.from_sigmas(at, *SIGMA)
        landmarks = snap(node.landmarks, node.camera)
        nodes.append(replace(node, id=NodeId(*map_id, k + 1), map_from_robot=pose, landmarks=landmarks))
        at = at @ Pose2(STEP, 0.0, float(rng.uniform(-TURN, TURN)))
    return [encode_change(change) for change in numbered(map_id, _surveyed(nodes))]


def _surveyed(nodes: Sequence[Node]) -> Iterator[ChangeBody]:
    """The nodes of one robot, and an edge from each to the nearest of those before."""
    yield from map(NodePut, nodes)
    free = max(node.id.number for node in nodes) + 1
    at = np.array([node.map_from_robot.mean.vector[:2] for node in nodes])
    for k in range(1, len(nodes)):
        before = nodes[int(np.linalg.norm(at[:k] - at[k], axis=1).argmin())]
        between = before.map_from_robot.mean.inverse() @ nodes[k].map_from_robot.mean
        kind = EdgeKind.MAPPED if math.hypot(between.x, between.y) > 0.05 else EdgeKind.TURNED
        way = PoseGaussian.from_sigmas(between, *SIGMA)
        yield EdgePut(Edge(NodeId(*nodes[k].id.map, free + k), before.id, nodes[k].id, way, kind))
