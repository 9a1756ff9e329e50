"""Values of the map as they may come: hypothesis strategies and a plain sample of everything."""

import math
from collections.abc import Iterator
from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.change import Change, ChangeBody, EdgePut, EdgeRetired, NodePut, NodeRetired
from mapweave.hybridmap.descriptor import quantise
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Landmarks, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.ranges import Ranges
from mapweave.hybridmap.trajectory_segment import FURTHEST, LONGEST, MOST, TrajectorySegment
from synthetic.world import random_vectors
from tests.wire.fleets import Fleet, MemoryFleet, Routers, ZenohFleet

# Examples run on machines that are busy with other things.
settings.register_profile("mapweave", deadline=None)
settings.load_profile("mapweave")

names = st.from_regex(r"[a-z0-9][a-z0-9_-]{0,31}", fullmatch=True)
numbers = st.integers(0, 2**53)
node_ids = st.builds(NodeId, names, numbers, numbers)
coordinates = st.floats(-1e4, 1e4)
seeds = st.integers(0, 2**32 - 1)


@st.composite
def poses(draw: st.DrawFn) -> PoseGaussian:
    """Poses whose covariance may be singular and may mix large and small variances."""
    random = np.random.default_rng(draw(seeds))
    scales = 10.0 ** np.array([draw(st.floats(-6, 1)) for _ in range(3)])
    root = random.normal(size=(3, draw(st.integers(0, 4)))) * scales[:, None]
    heading = draw(st.floats(-math.pi, math.pi))
    return PoseGaussian(Pose2(draw(coordinates), draw(coordinates), heading), root @ root.T)


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    width, height = draw(st.integers(16, 2047)), draw(st.integers(16, 2047))
    positive = st.floats(1.0, 1e4)
    return Camera(
        width, height, draw(positive), draw(positive), draw(st.floats(0, width)), draw(st.floats(0, height)),
        draw(st.floats(0, 2)), draw(st.floats(-1, 1)),
    )  # fmt: skip


@st.composite
def landmarks(draw: st.DrawFn, camera: Camera, most: int = 40) -> Landmarks:
    random = np.random.default_rng(draw(seeds))
    n = draw(st.integers(0, most))
    depths = np.exp(random.uniform(math.log(0.011), math.log(9.9e3), n))
    depths[random.random(n) < draw(st.floats(0, 1))] = np.nan
    sigmas = depths * np.exp(random.uniform(math.log(0.002), math.log(4.5), n))
    sigmas[np.isnan(depths)] = np.nan
    pixels = random.uniform(-0.45, 1.45, (n, 2)) * [camera.width, camera.height]
    codes = random.integers(0, 64, (n, 32)).astype(np.uint8)
    return Landmarks(pixels.astype(np.float32), codes, depths.astype(np.float32), sigmas.astype(np.float32))


@st.composite
def ranges(draw: st.DrawFn) -> Ranges:
    count = draw(st.integers(0, 20))
    random = np.random.default_rng(draw(seeds))
    reach = draw(st.integers(100, 10_000)) / 1000.0
    distances = np.where(random.random(count) < 0.5, reach, random.uniform(0, reach, count))
    return Ranges(random.uniform(-3.1, 3.1, count), distances, reach) if count else Ranges()


@st.composite
def segments(draw: st.DrawFn, ranges: Ranges) -> TrajectorySegment:
    count = draw(st.integers(0, MOST))
    random = np.random.default_rng(draw(seeds))
    poses = random.uniform([-FURTHEST, -FURTHEST, -3.1], [FURTHEST, FURTHEST, 3.1], (count, 3))
    distances = np.minimum(random.uniform(0, 2 * ranges.reach, (count, len(ranges))), ranges.reach)
    ages = np.sort(random.uniform(-LONGEST, LONGEST, count))
    return TrajectorySegment(ages, poses, distances) if count else TrajectorySegment()


@st.composite
def nodes(draw: st.DrawFn) -> Node:
    camera = draw(cameras())
    stamp_ns = draw(st.integers(0, 2**63 - 1))
    radius = draw(st.integers(0, 5000)) / 1000.0
    clock = draw(st.sampled_from(["", "utc", "sim-office-7"]))
    seen = draw(ranges())
    element, pose, marks, segment = (
        draw(one) for one in (node_ids, poses(), landmarks(camera), segments(seen))
    )
    return Node(element, stamp_ns, pose, camera, marks, clock, radius, seen, segment)


@st.composite
def edges(draw: st.DrawFn) -> Edge:
    own = draw(node_ids)
    ends = st.one_of(node_ids, st.builds(NodeId, st.just(own.agent), st.just(own.epoch), numbers))
    a = draw(ends)
    b = draw(ends.filter(lambda end: end != a))
    index = st.integers(0, draw(st.sampled_from([3, 255, 256, 1999])))
    pairs = draw(st.lists(st.tuples(index, index), max_size=20))
    return Edge(
        own, a, b, draw(poses()), draw(st.sampled_from(EdgeKind)),
        np.array(pairs, np.int64).reshape(-1, 2),
        draw(st.dictionaries(names, st.floats(0.0, 2000.0), max_size=6)),
    )  # fmt: skip


def bodies() -> st.SearchStrategy[ChangeBody]:
    puts = st.builds(NodePut, nodes()), st.builds(EdgePut, edges())
    return st.one_of(*puts, st.builds(NodeRetired, node_ids), st.builds(EdgeRetired, node_ids))


CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.25, 0.05)
MAP = MapId("robot-0", 3)


def sample_node(count: int = 150, number: int = 17, map_id: MapId = MAP, seed: int = 0) -> Node:
    """A node as a robot makes it."""
    random = np.random.default_rng(seed)
    depths = random.uniform(0.3, 8.0, count).astype(np.float32)
    depths[::5] = np.nan
    pixels = (random.uniform(0, 1, (count, 2)) * [319, 239]).astype(np.float32)
    codes = quantise(random_vectors(count, random))
    pose = PoseGaussian.from_sigmas(Pose2(1.2345, -2.0, 0.3), 0.02, 0.01)
    stamp_ns = 1_700_000_000_000_000_000
    return Node(NodeId(*map_id, number), stamp_ns, pose, CAMERA, Landmarks(pixels, codes, depths, depths / 8))


def sample_edge(count: int = 60, map_id: MapId = MAP) -> Edge:
    """An edge as a robot makes it."""
    random = np.random.default_rng(1)
    shared = np.stack([random.permutation(150)[:count], random.permutation(150)[:count]], axis=1)
    evidence = {"inliers": 43.0, "rms_px": 0.613}
    pose = PoseGaussian.from_sigmas(Pose2(0.5, 0.1, 0.2), 0.01, 0.01)
    a, b = NodeId(*map_id, 16), NodeId(*map_id, 17)
    return Edge(NodeId(*map_id, 18), a, b, pose, EdgeKind.MAPPED, shared, evidence)


def sample_changes() -> list[Change]:
    stamp_ns = 1_700_000_000_123_456_789
    changes: list[ChangeBody] = [
        NodePut(sample_node()),
        NodePut(sample_node(0, 16)),
        EdgePut(sample_edge()),
        EdgeRetired(NodeId(*MAP, 18)),
        NodeRetired(NodeId(*MAP, 17)),
    ]
    return [Change(MAP, 1000 + k, stamp_ns + k, body) for k, body in enumerate(changes)]


@pytest.fixture(scope="session")
def some() -> SimpleNamespace:
    """Strategies and samples, by name."""
    return SimpleNamespace(
        bodies=bodies(), nodes=nodes(), edges=edges(), poses=poses(), node_ids=node_ids, names=names,
        cameras=cameras(), landmarks=landmarks, node=sample_node, edge=sample_edge, changes=sample_changes,
        map=MAP, camera=CAMERA,
    )  # fmt: skip


@pytest.fixture(params=[MemoryFleet, ZenohFleet])
def fleet(request: pytest.FixtureRequest) -> Iterator[Fleet]:
    """Of either kind."""
    with closing(request.param()) as fleet:
        yield fleet


@pytest.fixture
def zenoh_fleet() -> Iterator[ZenohFleet]:
    with closing(ZenohFleet()) as fleet:
        yield fleet


@pytest.fixture
def routers() -> Iterator[Routers]:
    with closing(Routers()) as routers:
        yield routers
