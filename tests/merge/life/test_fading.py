"""Landmarks that fade: against enumeration of everything that may have happened, and with moved furniture."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import pytest

from benchmarks.synthetic import CAMERA, Sensing, World, random_vectors, room, take_map, take_node
from hybridmap.change import Change, ChangeBody, EdgePut, NodePut
from hybridmap.hybrid_map import HybridMap
from hybridmap.node import MapId, NodeId
from hybridmap.pose import Pose2, PoseGaussian
from mapserver.living import without_faded
from mapserver.merging.merger import Merger, MergerSettings
from merge.graph.links import Link
from merge.life.fading import Fader, FadingSettings, Look, expected, presence
from merge.life.renewal import RenewalSettings

S = FadingSettings()
SHARP = Sensing(unknown_depth=0.0, clutter=5, most=150)


def look(shown: list[bool], found: list[bool]) -> Look:
    """A view that finds half of what it should show; the first landmarks are those in question."""
    rest = [True] * 20
    half = [True, False] * 10
    link = Link(NodeId("a", 1, 1), NodeId("b", 1, 1), PoseGaussian(Pose2(), np.eye(3)))
    return Look(link, Pose2(), np.array(shown + rest), np.array(found + half))


@pytest.mark.parametrize("story", list(product([None, False, True], repeat=4)))
def test_presence_is_that_of_all_stories_together(story: tuple[bool | None, ...]) -> None:
    """Every sequence of there and gone, weighed with its probability and that of what was seen."""
    looks = [look([seen is not None], [bool(seen)]) for seen in story]
    weights = {True: 0.0, False: 0.0}
    told = [seen for seen in story if seen is not None]
    rates = [(one.found & one.expected).sum() / one.expected.sum() for one in looks]
    rates = [rate for rate, seen in zip(rates, story, strict=True) if seen is not None]
    for states in product([True, False], repeat=len(told) + 1):
        weight = S.at_first if states[0] else 1 - S.at_first
        for (before, now), seen, rate in zip(pairwise(states), told, rates, strict=True):
            stays = 1 - S.goes if before else 1 - S.comes
            weight *= stays if now == before else 1 - stays
            likely = rate if now else S.mistaken
            weight *= likely if seen else 1 - likely
        weights[states[-1]] += weight
    there = presence(21, looks, S)[0]
    assert there == pytest.approx(weights[True] / sum(weights.values()), abs=1e-12)


def test_it_takes_many_views_to_fade_and_one_to_come_back() -> None:
    missed, hit = look([True], [False]), look([True], [True])
    course = [presence(21, [missed] * k, S)[0] for k in range(20)]
    assert all(later < earlier for earlier, later in pairwise(course))
    first = next(k for k, there in enumerate(course) if there < S.faint)
    assert 3 <= first <= 10
    assert presence(21, [*[missed] * 19, hit], S)[0] > 0.5 > S.faint
    assert presence(21, [look([False], [False])] * 20, S)[0] == S.at_first, "nobody could have seen it"


def test_expected_is_what_is_in_view_near_enough_and_not_hidden() -> None:
    """One landmark after the other, from the definition."""
    rng = np.random.default_rng(5)
    world = room(0, 0, 6, 4, 1200, rng)
    here, there = Pose2(1.5, 2.0, 0.1), Pose2(2.1, 1.8, 0.2)
    nothing = PoseGaussian(Pose2(), np.zeros((3, 3)))
    old, new = (
        take_node(world, NodeId("r", k, 1), pose, nothing, rng, SHARP) for k, pose in ((1, here), (2, there))
    )
    shown = expected(old, new, here.inverse() @ there, S)
    points = here.apply(old.points_in_robot)
    known = there.apply(new.points_in_robot)
    seen = 0
    for k, point in enumerate(points):
        pixel = CAMERA.project(there.inverse().apply(point[None]))[0]
        inside = bool(CAMERA.contains(pixel, S.margin_px))
        eyes = [pose.apply(np.array([[CAMERA.mount_forward, 0.0, 0.0]]))[0, :2] for pose in (here, there)]
        rays = [point[:2] - eye for eye in eyes]
        far = [float(np.hypot(*ray)) for ray in rays]
        angle = np.arccos(np.clip(rays[0] @ rays[1] / far[0] / far[1], -1, 1))
        fits = inside and max(far) / min(far) < S.scale and angle < S.aside
        depth = there.inverse().apply(point[None])[0, 0] - CAMERA.mount_forward
        hidden = any(
            np.hypot(*(new.landmarks.pixels[j] - pixel)) < S.before_px
            and there.inverse().apply(other[None])[0, 0] - CAMERA.mount_forward < S.before * depth
            for j, other in enumerate(known)
        )
        assert shown[k] == (fits and not hidden)
        seen += int(shown[k])
    assert 20 < seen < len(points)


def test_furniture_that_is_moved_fades_and_comes_back() -> None:
    """Landmarks of a thing that stands elsewhere from the second drive on; it returns before the last."""
    rng = np.random.default_rng(2)
    world = room(0, 0, 6, 4, 700, rng)
    thing = np.flatnonzero((world.normals[:, 0] < -0.5) & (world.points[:, 1] > 2.2))
    other = replace(world, vectors=world.vectors.copy())
    other.vectors[thing] = random_vectors(len(thing), rng)
    # Nothing is superseded: what has been is linked with no later view.
    merger = Merger(settings=MergerSettings(renewal=RenewalSettings(found=10_000)))
    epochs = [world, *[other] * 8, *[world] * 3]
    told: dict[int, np.ndarray] = {}
    first: np.ndarray | None = None
    for epoch, now in enumerate(epochs, start=1):
        tour = [Pose2(2.6 + 0.5 * k, 2.0 + rng.normal(0, 0.04), 0.05 * k) for k in range(2)]
        _drive(merger, now, MapId(f"r{epoch}", 1), tour, rng)
        merged = Fader().fade(merger.merged())
        node = merged.maps[MapId("r1", 1)].nodes[NodeId("r1", 1, 1)]
        if first is None:
            first = _behind(world, tour[0], node.points_in_robot, thing)
        told[epoch] = merged.faded.get(node.id, np.zeros(len(node.landmarks), np.bool_))
        assert len(without_faded(node, merged).landmarks) == (~told[epoch]).sum()
    assert first is not None and first.sum() >= 10 and (~first).sum() >= 20
    assert not told[2].any(), "one view is not enough"
    assert told[9][first].mean() > 0.6, "what has gone has faded"
    assert told[9][~first].mean() < 0.25, "what is there has not, most of it"
    assert told[12][first].mean() < 0.5 * told[9][first].mean(), "what is back is used again"


def _drive(
    merger: Merger, world: World, map_id: MapId, tour: list[Pose2], rng: np.random.Generator
) -> HybridMap:
    nodes, edges = take_map(world, map_id, tour, rng, SHARP, sigma_xy=0.01, sigma_heading=0.005)
    bodies: list[ChangeBody] = [*map(NodePut, nodes), *map(EdgePut, edges)]
    for number, body in enumerate(bodies, start=1):
        stamp = int(map_id.agent[1:]) * 10**12
        if isinstance(body, NodePut):
            body = NodePut(replace(body.node, stamp_ns=stamp + body.node.stamp_ns, clock="wall"))
        merger.on_change(Change(map_id, number, 0, body))
    return merger.maps[map_id]


def _behind(world: World, world_from_robot: Pose2, points: np.ndarray, thing: np.ndarray) -> np.ndarray:
    """(N,) which of a node's landmarks are of the thing: its points are the nearest."""
    there = world_from_robot.apply(points)
    nearest = np.linalg.norm(there[:, None] - world.points[None], axis=2).argmin(axis=1)
    return np.isin(nearest, thing)
