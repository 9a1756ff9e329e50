"""Nodes that are compared, registered with all rules of recognition, and without each.

Nothing is rendered: landmarks are those of `synthetic.world`. What is drawn is what the rules are against:
poor cameras in rooms and halls where things were moved, a picture that hangs in two rooms, a larger copy of a
place, a flat thing that is seen from aside.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.verification import verify
from synthetic.world import Sensing, World, random_vectors, room, take_node

HERE = PoseGaussian.from_sigmas(Pose2(), 0.01, 0.01)
WIDTH, DEPTH = 5.0, 4.0
"""Of a room, m."""
SENSING = Sensing(unknown_depth=0.2, most=150)
OFF, TURNED = 0.15, math.radians(3.0)
"""A link that is off by more, m or rad, is wrong."""

Pair = tuple[Node, Node, Pose2 | None]
"""Two nodes, and `a_from_b`; None if they are of different places."""


def _room(rng: np.random.Generator, landmarks: int = 1200) -> World:
    return room(0.0, 0.0, WIDTH, DEPTH, landmarks, rng)


def _taken(world: World, where: Pose2, rng: np.random.Generator, number: int, s: Sensing = SENSING) -> Node:
    return take_node(world, NodeId("r0", 1, number), where, HERE, rng, s)


def _without_depths(node: Node) -> Node:
    unknown = np.full(len(node.landmarks), np.nan, np.float32)
    return replace(node, landmarks=replace(node.landmarks, depths=unknown, depth_sigmas=unknown))


def poor_camera(rng: np.random.Generator) -> Pair:
    """Few features of 0.5 to 5 px, rough depths or none, in a room or a hall; things were moved by 6 cm."""
    scale = float(rng.choice([1.0, 1.0, 3.0, 8.0]))
    here = _room(rng, int(rng.integers(40, 700)))
    here = replace(here, points=here.points * [scale, scale, 1.0 + 0.3 * (scale - 1.0)])
    later = here
    if rng.random() < 0.5:
        later = replace(here, points=here.points + rng.normal(0.0, 0.06, here.points.shape))
    x, y, heading = rng.uniform([1.5, 1.2, -math.pi], [3.5, 2.8, math.pi])
    a, reach = Pose2(scale * x, scale * y, heading), float(rng.choice([0.3, 1.0])) * math.sqrt(scale)
    b = a @ Pose2(*rng.uniform([-reach, -reach, -0.4], [reach, reach, 0.4]))
    s = Sensing(
        pixel_sigma=float(rng.uniform(0.5, 5.0)),
        depth_share=float(rng.choice([0.03, 0.1, 0.3])),
        code_sigma=float(rng.uniform(0.03, 0.07)),
        most=int(rng.integers(20, 150)),
        clutter=int(rng.integers(5, 60)),
        reach=7.0 * scale,
        unknown_depth=float(rng.choice([0.1, 0.5, 0.85])),
    )
    return _taken(here, a, rng, 1, s), _taken(later, b, rng, 2, s), a.inverse() @ b


def picture(rng: np.random.Generator) -> Pair:
    """A picture of 0.5 to 3 m that hangs in two rooms."""
    size, count = float(rng.uniform(0.5, 3.0)), int(rng.integers(10, 50))
    across, up = rng.uniform(-0.5, 0.5, count), rng.uniform(0.05, min(size, 2.0), count)
    points = np.column_stack([np.full(count, WIDTH), DEPTH / 2 + size * across, up])
    shown = World(points, np.tile([-1.0, 0.0], (count, 1)), random_vectors(count, rng))
    a = Pose2(WIDTH - float(rng.uniform(1.5, 3.0)), DEPTH / 2, 0.0)
    b = a @ Pose2(*rng.uniform([-0.5, -0.4, -0.25], [0.5, 0.4, 0.25]))
    return _taken(_room(rng) + shown, a, rng, 1), _taken(_room(rng) + shown, b, rng, 2), None


def larger_copy(rng: np.random.Generator) -> Pair:
    """What looks the same at 1.3 to 2.5 times the size, from so many times as far."""
    world, a = _room(rng), Pose2(*rng.uniform([1.5, 1.2, -math.pi], [3.5, 2.8, math.pi]))
    one, other, times = _taken(world, a, rng, 1), _taken(world, a, rng, 2), np.float32(rng.uniform(1.3, 2.5))
    seen = other.landmarks
    seen = replace(seen, depths=times * seen.depths, depth_sigmas=times * seen.depth_sigmas)
    return one, replace(other, landmarks=seen), None


def flat_thing(rng: np.random.Generator) -> Pair:
    """A flat thing of 0.6 to 2.5 m in a bare room, from two sides of it."""
    size, count = float(rng.uniform(0.6, 2.5)), 60
    across, up = size * rng.uniform(-0.5, 0.5, count), rng.uniform(0.0, min(size, 1.5), count)
    points = np.column_stack([np.zeros(count), across, up])
    world = World(points, np.tile([-1.0, 0.0], (count, 1)), random_vectors(count, rng))
    s = replace(SENSING, clutter=5, pixel_sigma=float(rng.uniform(0.5, 2.0)))
    away, side = float(rng.uniform(1.5, 5.0)), float(rng.choice([-1.0, 1.0]))
    ways = (
        (float(rng.uniform(-0.3, 0.3)), away),
        (side * float(rng.uniform(0.2, 1.0)), away * float(rng.uniform(0.8, 1.2))),
    )
    a, b = (Pose2(-far * math.cos(angle), far * math.sin(angle), -angle) for angle, far in ways)
    return _taken(world, a, rng, 1, s), _without_depths(_taken(world, b, rng, 2, s)), a.inverse() @ b


PAIRS: Mapping[str, Callable[[np.random.Generator], Pair]] = {
    "poor camera": poor_camera,
    "picture": picture,
    "larger copy": larger_copy,
    "flat thing": flat_thing,
}
"""By what is drawn."""


def look_alikes(seed: int, count: int) -> dict[str, dict[str, int]]:
    """How many of so many pairs of each kind are linked, and how many of these links are wrong."""
    out = {}
    for kind, draw in PAIRS.items():
        links = wrong = 0
        for run in range(count):
            one, other, truth = draw(np.random.default_rng([seed, run, *kind.encode()]))
            found = verify(one, other)
            if isinstance(found, Link):
                links += 1
                off = None if truth is None else truth.inverse() @ found.a_from_b.mean
                wrong += off is None or bool(math.hypot(off.x, off.y) > OFF or abs(off.heading) > TURNED)
        out[kind] = {"pairs": count, "links": links, "wrong": wrong}
    return out
