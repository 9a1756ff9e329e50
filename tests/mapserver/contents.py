"""Maps that a robot may legally send, however little sense they make: drawn up to the limits and beyond."""

from itertools import pairwise

import numpy as np

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.change import ChangeBody, EdgePut, EdgeRetired, NodePut, NodeRetired
from mapweave.hybridmap.descriptor import quantise
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Landmarks, Node
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.hybridmap.ranges import Ranges
from mapweave.hybridmap.trajectory_segment import TrajectorySegment
from mapweave.wire.codec import decode_body, encode_body
from synthetic.world import CAMERA, random_vectors

EVIDENCE = ("inliers", "aliased", "matches", "share", "there", "back", "sigma_xy", "log_evidence")


def pose(rng: np.random.Generator) -> PoseGaussian:
    """Near or at the end of the world; its covariance nothing, of any rank, or enormous."""
    far = 10.0 ** rng.uniform(-2, 5, 2) * rng.choice([-1, 1], 2)
    near = rng.uniform(-3, 3, 2)
    x, y = near if rng.random() < 0.6 else far
    heading = rng.uniform(-3.2, 3.2) if rng.random() < 0.9 else rng.uniform(-1e6, 1e6)
    return PoseGaussian(Pose2(float(x), float(y), float(heading)), covariance(rng))


def covariance(rng: np.random.Generator) -> Array:
    """(3, 3) of rank 0 to 3, standard deviations from a micrometre to a thousand kilometres."""
    if rng.random() < 0.3:
        return np.diag([0.03, 0.03, 0.02]) ** 2
    most = rng.choice([0, 2, 6])
    scale = 10.0 ** rng.uniform(-6, most, 3) if rng.random() < 0.5 else 10.0 ** rng.uniform(-6, most)
    root = rng.normal(size=(3, rng.integers(0, 4)))
    root = scale * root.T if root.size else root.T
    result: Array = root.T @ root
    return result


def camera(rng: np.random.Generator) -> Camera:
    """The usual one, or any that a message can hold."""
    if rng.random() < 0.7:
        return CAMERA
    focal = 10.0 ** rng.uniform(-3, 6, 2)
    centre = rng.uniform(-1e6, 1e6, 2) if rng.random() < 0.3 else rng.uniform(0, 100, 2)
    mount = rng.uniform(-1e6, 1e6, 2) if rng.random() < 0.3 else rng.uniform(0, 1, 2)
    width, height = (int(10.0 ** rng.uniform(1.21, 3.3)) for _ in range(2))
    return Camera(width, height, *map(float, (*focal, *centre, *mount)))


def landmarks(rng: np.random.Generator, of: Camera, most: int = 100) -> Landmarks:
    """None, some, or many that look all the same; with depths, without, or at their limits."""
    n = int(rng.choice([0, 1, 7, rng.integers(0, most)]))
    vectors = (
        random_vectors(n, rng) if rng.random() < 0.8 or not n else np.repeat(random_vectors(1, rng), n, 0)
    )
    depths = rng.uniform(0.5, 6.0, n) if rng.random() < 0.7 else 0.0101 * np.exp(rng.uniform(0, 13.9, n))
    depths[rng.random(n) < rng.choice([0.0, 0.2, 1.0])] = np.nan
    pixels = rng.uniform(-0.45, 1.45, (n, 2)) if rng.random() < 0.3 else rng.uniform(0, 1, (n, 2))
    if rng.random() < 0.2:
        pixels[:] = 0.5
    pixels = pixels * [of.width, of.height]
    sigmas = depths * (0.05 if rng.random() < 0.7 else 10.0 ** rng.uniform(-2.5, 0.6, n))
    single = (np.asarray(item, np.float32) for item in (depths, sigmas))
    return Landmarks(pixels.astype(np.float32), quantise(vectors), *single)


def ranges(rng: np.random.Generator) -> Ranges:
    """What proximity sensors saw: anything."""
    n, reach = int(rng.integers(1, 9)), float(rng.choice([0.1, 2.0, 10.0]))
    return Ranges(rng.uniform(-3.1, 3.1, n), rng.uniform(0, reach, n), reach)


def segment(rng: np.random.Generator, seen: Ranges) -> TrajectorySegment:
    """Where the robot was before and after: anywhere."""
    n = int(rng.integers(1, 20))
    where = rng.uniform(-1, 1, (n, 3)) * [*([float(rng.choice([0.5, 20.0]))] * 2), 3.1]
    return TrajectorySegment(
        np.sort(rng.uniform(-60, 60, n)), where, rng.uniform(0, seen.reach, (n, len(seen)))
    )


def node(rng: np.random.Generator, node_id: NodeId) -> Node:
    """Any."""
    of = camera(rng)
    seen = ranges(rng) if rng.random() < 0.4 else Ranges()
    stamp = int(rng.choice([0, 2**63 - 1])) if rng.random() < 0.2 else int(rng.integers(1, 10**12))
    return Node(
        node_id, stamp, pose(rng), of, landmarks(rng, of), str(rng.choice(["", "utc"])),
        float(rng.choice([0.0, 0.2, 100.0])), seen,
        segment(rng, seen) if len(seen) and rng.random() < 0.6 else TrajectorySegment(),
    )  # fmt: skip


def edge(rng: np.random.Generator, edge_id: NodeId, ends: list[NodeId], counts: dict[NodeId, int]) -> Edge:
    """Between any two of these nodes, sharing landmarks that both have."""
    a, b = (ends[k] for k in rng.choice(len(ends), 2, replace=False))
    most = min(counts.get(a, 5), counts.get(b, 5))
    shared = rng.integers(0, max(most, 1), (int(rng.integers(0, most + 1)), 2))
    names = rng.choice(EVIDENCE, int(rng.integers(0, 5)), replace=False)
    evidence = {str(name): float(10.0 ** rng.uniform(-3, rng.choice([3, 29]))) for name in names}
    return Edge(edge_id, a, b, pose(rng), EdgeKind(rng.choice(list(EdgeKind))), shared, evidence)


def content(rng: np.random.Generator, map_id: MapId, others: list[NodeId]) -> list[ChangeBody]:
    """A log of a map; encoders bring within their bounds what is beyond.

    Args:
        rng: draws it.
        map_id: whose.
        others: nodes of other robots: edges may lead to them, or from one of them to another.
    """
    own = [NodeId(*map_id, 2 * k) for k in range(int(rng.integers(1, 7)))]
    changes: list[ChangeBody] = [NodePut(node(rng, item)) for item in own]
    counts = {change.node.id: len(change.node.landmarks) for change in changes if isinstance(change, NodePut)}
    ends = [*own, NodeId(*map_id, 1000)]
    if rng.random() < 0.4:
        ends += [*others, NodeId("unknown", 0, 1)]
    if len(own) > 1 and rng.random() < 0.7:
        # Most robots' nodes hang together.
        pairs = pairwise(own)
        changes += [
            EdgePut(edge(rng, NodeId(*map_id, 2 * k + 1), list(pair), counts)) for k, pair in enumerate(pairs)
        ]
    for k in range(int(rng.integers(0, 8))):
        changes.append(EdgePut(edge(rng, NodeId(*map_id, 101 + 2 * k), ends, counts)))
    for _ in range(int(rng.integers(0, 3))):
        changes.append(NodePut(node(rng, own[rng.integers(len(own))])))
    if rng.random() < 0.2:
        changes.append(NodeRetired(own[rng.integers(len(own))]))
    if rng.random() < 0.2:
        changes.append(EdgeRetired(NodeId(*map_id, 1)))
    if rng.random() < 0.2:
        changes = [changes[k] for k in rng.permutation(len(changes))]
    out = []
    for change in changes:
        try:
            out.append(decode_body(encode_body(change)))
        except InvalidValue:
            continue
    return out
