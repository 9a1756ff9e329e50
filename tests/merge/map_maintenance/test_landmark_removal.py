"""Landmarks that fade: against enumeration of everything that may have happened, and with moved furniture."""

from dataclasses import replace
from itertools import pairwise, product
from typing import Any

import numpy as np
import pytest

from mapweave.hybridmap import superseding
from mapweave.hybridmap.change import Change, NodePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.mapserver.active_nodes import without_faded
from mapweave.mapserver.merging.merger import Merger
from mapweave.merge.map_maintenance import landmark_observations as observations
from mapweave.merge.map_maintenance import landmark_removal as removal
from mapweave.merge.map_maintenance.landmark_observations import LandmarkObservations, expected
from mapweave.merge.map_maintenance.landmark_removal import LandmarkRemover, detection_rate, presence, things
from mapweave.merge.pose_graph.links import Link
from synthetic.maps import changes_of
from synthetic.world import CAMERA, Sensing, World, random_vectors, room, take_map, take_node

SHARP = Sensing(unknown_depth=0.0, clutter=5, most=150)


ALONE = np.eye(21, dtype=np.bool_)
"""Each landmark is a thing of its own."""
WORLD = room(0, 0, 6, 4, 40, np.random.default_rng(0))
NODE = take_node(
    WORLD, NodeId("a", 1, 1), Pose2(2, 2, 0), PoseGaussian(Pose2(), np.eye(3)), np.random.default_rng(0)
)


def look(shown: list[bool], result: list[bool], visit: int = 0) -> LandmarkObservations:
    """A view that finds half of what it should show besides; the first landmarks are those in question."""
    rest = [True] * 20
    half = [True, False] * 10
    link = Link(NodeId("a", 1, 1), NodeId("b", 1, 1), PoseGaussian(Pose2(), np.eye(3)))
    view = replace(NODE, stamp_ns=visit * 10**12)
    return LandmarkObservations(NODE, view, link, Pose2(), np.array(shown + rest), np.array(result + half))


@pytest.mark.parametrize("sequence", list(product([None, False, True], repeat=4)))
def test_presence_is_that_of_all_sequences_together(sequence: tuple[bool | None, ...]):
    """Every sequence of there and gone, hidden and not, weighed with it and with what was seen."""
    views = [look([seen is not None], [bool(seen)], visit) for visit, seen in enumerate(sequence)]
    weights = {True: 0.0, False: 0.0}
    collected = [(seen, detection_rate(ALONE, one)) for seen, one in zip(sequence, views, strict=True)]
    collected = [(seen, rate) for seen, rate in collected if seen is not None]
    for states in product([True, False], repeat=len(collected) + 1):
        for veils in product([True, False], repeat=len(collected)):
            weight = removal.AT_FIRST if states[0] else 1 - removal.AT_FIRST
            for (before, now), veil, (seen, rate) in zip(pairwise(states), veils, collected, strict=True):
                stays = 1 - removal.GOES if before else 1 - removal.COMES
                weight *= stays if now == before else 1 - stays
                weight *= removal.HIDDEN if veil else 1 - removal.HIDDEN
                # A false detection does not depend on what is there.
                likely = (0.0 if veil else rate) if now else removal.MISTAKEN
                weight *= likely if seen else 1 - likely
            weights[states[-1]] += weight
    there = presence(ALONE, views)[0]
    assert there == pytest.approx(weights[True] / sum(weights.values()), abs=1e-12)


def test_a_thing_fades_after_two_views_and_a_landmark_alone_after_many():
    """Six landmarks of one thing that all are missed; and one of which nothing is around."""
    together = np.eye(26, dtype=np.bool_)
    together[:6, :6] = True
    # Detected neighbours measure this view's detection rate.
    together[6:, 6:] = True

    def after(misses: int, hits: int = 0, things: np.ndarray = together) -> np.ndarray:
        sequence = [look([True] * 6, [False] * 6, k) for k in range(misses)]
        sequence += [look([True] * 6, [True] + [False] * 5, misses + k) for k in range(hits)]
        return presence(things, sequence)

    course = [after(k)[0] for k in range(12)]
    assert all(later < earlier for earlier, later in pairwise(course))
    assert course[1] > removal.FAINT > course[3]
    assert after(11, 1)[0] > removal.FAINT, "it is back"
    assert (after(0, 4) > removal.FAINT)[:6].all(), "what is missed beside what is found is not gone"
    one_visit = [look([True] * 6, [False] * 6, 0)] * 9
    assert presence(together, one_visit)[0] > removal.FAINT, "a person may have stood before it all the while"
    lonely = np.eye(26, dtype=np.bool_)
    lonely[6:, 6:] = True
    alone = [after(k, things=lonely)[0] for k in range(14)]
    assert 4 <= next(k for k, there in enumerate(alone) if there < removal.FAINT) <= 12
    unseen = [look([False] * 6, [False] * 6, k) for k in range(20)]
    assert presence(together, unseen)[0] == removal.AT_FIRST, "no view could show it"


def test_landmarks_of_a_place_that_a_visit_sees_a_hundred_times_have_a_presence():
    """Before, all likelihoods of a long visit became 0, and what was found half of the time never faded."""
    rng = np.random.default_rng(0)
    together = np.ones((60, 60), np.bool_)
    found = [(rng.random(40) < 0.5).tolist() for _ in range(100)]
    there = presence(together, [look([True] * 40, some) for some in found])
    assert (there > 0.9).all(), "what is missed beside what is found is not gone"


def test_near_landmarks_may_be_of_one_thing():
    together = things(NODE, 0.5)
    points = NODE.points_in_robot
    for i, j in product(range(len(points)), repeat=2):
        near = i == j or bool(np.linalg.norm(points[i] - points[j]) < 0.5)
        assert together[i, j] == near
    assert together.any(axis=1).all() and not together.all()


def test_expected_landmarks_are_visible_near_and_unoccluded():
    """One landmark after the other, from the definition."""
    rng = np.random.default_rng(5)
    world = room(0, 0, 6, 4, 1200, rng)
    here, there = Pose2(1.5, 2.0, 0.1), Pose2(2.1, 1.8, 0.2)
    nothing = PoseGaussian(Pose2(), np.zeros((3, 3)))
    old, new = (
        take_node(world, NodeId("r", k, 1), pose, nothing, rng, SHARP) for k, pose in ((1, here), (2, there))
    )
    shown = expected(old, new, here.inverse() @ there)
    points = here.apply(old.points_in_robot)
    known = there.apply(new.points_in_robot)
    seen = 0
    for k, point in enumerate(points):
        pixel = CAMERA.project(there.inverse().apply(point[None]))[0]
        inside = bool(CAMERA.contains(pixel, observations.MARGIN_PX))
        eyes = [pose.apply(np.array([[CAMERA.mount_forward, 0.0, 0.0]]))[0, :2] for pose in (here, there)]
        rays = [point[:2] - eye for eye in eyes]
        far = [float(np.hypot(*ray)) for ray in rays]
        angle = np.arccos(np.clip(rays[0] @ rays[1] / far[0] / far[1], -1, 1))
        fits = inside and max(far) / min(far) < observations.SCALE and angle < observations.ASIDE
        depth = there.inverse().apply(point[None])[0, 0] - CAMERA.mount_forward
        hidden = any(
            np.hypot(*(new.landmarks.pixels[j] - pixel)) < observations.BEFORE_PX
            and there.inverse().apply(other[None])[0, 0] - CAMERA.mount_forward < observations.BEFORE * depth
            for j, other in enumerate(known)
        )
        assert shown[k] == (fits and not hidden)
        seen += int(shown[k])
    assert 20 < seen < len(points)


def thing_in(world: World) -> np.ndarray:
    """(K,) points of the eastern wall beyond y = 2.2 m, as of one thing."""
    return np.flatnonzero((world.normals[:, 0] < -0.5) & (world.points[:, 1] > 2.2))


def changed(world: World, thing: np.ndarray, rng: np.random.Generator) -> World:
    """The same world where these points look differently."""
    other = replace(world, vectors=world.vectors.copy())
    other.vectors[thing] = random_vectors(len(thing), rng)
    return other


@pytest.fixture
def kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is superseded: what has been is linked with no later view."""
    monkeypatch.setattr(superseding, "FOUND", 10_000)


def with_thing(seed: int) -> tuple[World, World, np.ndarray, np.random.Generator]:
    """A room, the same with other furniture, its points that are of that, and what both were drawn with."""
    rng = np.random.default_rng(seed)
    world = room(0, 0, 6, 4, 700, rng)
    thing = thing_in(world)
    return world, changed(world, thing, rng), thing, rng


@pytest.mark.slow
@pytest.mark.usefixtures("kept")
def test_furniture_that_is_moved_fades_and_comes_back():
    """Landmarks of a thing that stands elsewhere from the second drive on; it returns before the last."""
    world, other, thing, rng = with_thing(2)
    merger = Merger()
    epochs = [world, *[other] * 8, *[world] * 3]
    collected: dict[int, np.ndarray] = {}
    first: np.ndarray | None = None
    for epoch, now in enumerate(epochs, start=1):
        tour = [Pose2(2.6 + 0.5 * k, 2.0 + rng.normal(0, 0.04), 0.05 * k) for k in range(2)]
        _drive(merger, now, MapId(f"r{epoch}", 1), tour, rng)
        merged = merger.merged()
        node = merged.maps[MapId("r1", 1)].nodes[NodeId("r1", 1, 1)]
        if first is None:
            first = _behind(world, tour[0], node.points_in_robot, thing)
        collected[epoch] = merged.faded.get(node.id, np.zeros(len(node.landmarks), np.bool_))
        assert len(without_faded(node, merged).landmarks) == (~collected[epoch]).sum()
    assert first is not None and first.sum() >= 10 and (~first).sum() >= 20
    assert not collected[2].any(), "one view is not enough"
    assert collected[9][first].mean() > 0.6, "what has gone has faded"
    assert collected[9][~first].mean() < 0.25, "what is there has not, most of it"
    assert collected[12][first].mean() < 0.5 * collected[9][first].mean(), "what is back is used again"


@pytest.mark.usefixtures("kept")
def test_a_wall_that_is_changed_altogether_fades_though_no_later_view_is_linked_with_it(monkeypatch):
    """The wall behind has stayed, and localizes the robot; half of what is there is found."""
    rng = np.random.default_rng(3)
    world = room(0, 0, 6, 4, 1200, rng)
    wall = np.flatnonzero(world.normals[:, 0] < -0.5)
    other = changed(world, wall, rng)
    monkeypatch.setattr(removal, "USUAL", 0.5)
    merger = Merger()
    shares = []
    for epoch, now in enumerate([world, *[other] * 4], start=1):
        x, y = rng.normal([3.2, 2.0], 0.05)
        tour = [Pose2(x, y, turn + rng.normal(0, 0.02)) for turn in (np.pi, 0.0)]
        _drive(merger, now, MapId(f"r{epoch}", 1), tour, rng)
        merged = merger.merged()
        assert len(merged.components) == 1
        behind, before = (merged.maps[MapId("r1", 1)].nodes[NodeId("r1", 1, k)] for k in (1, 3))
        if epoch == 1:
            gone = _behind(world, tour[1], before.points_in_robot, wall)
        assert not any(before.id in link.pair for link in merged.links)
        shares.append(
            [merged.faded.get(n.id, np.zeros(len(n.landmarks), np.bool_)) for n in (behind, before)]
        )
    assert gone.sum() >= 30
    assert not shares[1][1].any(), "one visit is not enough"
    assert shares[-1][1][gone].mean() > 0.6
    assert shares[-1][0].mean() < 0.2


@pytest.mark.slow
@pytest.mark.usefixtures("kept")
def test_views_of_implausible_maps_fade_no_landmarks_of_others():
    """From when they are found to be so, and until they are not."""
    world, other, _, rng = with_thing(2)
    merger = Merger()
    for epoch, now in enumerate([world, *[other] * 6], start=1):
        tour = [Pose2(2.6 + 0.5 * k, 2.0 + rng.normal(0, 0.04), 0.05 * k) for k in range(2)]
        _drive(merger, now, MapId(f"r{epoch}", 1), tour, rng)
    merged = merger.merged()
    assert NodeId("r1", 1, 1) in merged.faded
    odd = replace(merged, implausible=dict.fromkeys(merged.maps, "it contradicts itself"))
    remover = LandmarkRemover()
    for given, fades in ((merged, True), (odd, False), (merged, True), (odd, False)):
        for before in (remover, LandmarkRemover()):
            faded = before.fade(given).faded
            assert faded.keys() == (merged.faded.keys() if fades else set())
            assert all(np.array_equal(mask, merged.faded[node]) for node, mask in faded.items())


@pytest.mark.slow
def test_only_changes_are_evaluated_with_the_same_result(monkeypatch):
    """From drive to drive, superseded nodes included, as a remover that sees only the last map."""
    rng = np.random.default_rng(4)
    world = room(0, 0, 8, 4, 950, rng)
    other = changed(world, thing_in(world), rng)
    monkeypatch.setattr(removal, "MOVED", 0.01)
    merger = Merger()
    judged: list[int] = []

    def counted(*args: Any) -> Array:
        judged.append(1)
        return presence(*args)

    monkeypatch.setattr("mapweave.merge.map_maintenance.landmark_removal.presence", counted)
    counts, faded, agree = [], 0, []
    for epoch, now in enumerate([world, *[other] * 6], start=1):
        # The first drives go through all of the room, the last ones through its western end.
        xs = np.arange(1.0, 7.0 if epoch < 5 else 2.5, 0.5)
        tour = [Pose2(x, 2.0 + rng.normal(0, 0.04), rng.normal(0, 0.03)) for x in xs]
        _drive(merger, now, MapId(f"r{epoch}", 1), tour, rng)
        judged.clear()
        merged = merger.merged()
        counts.append(len(judged))
        fresh = LandmarkRemover().fade(replace(merged, faded={})).faded
        for a in set(fresh) | set(merged.faded):
            none = np.zeros(len(merged.maps[a.map].nodes[a].landmarks), np.bool_)
            agree.append((fresh.get(a, none) == merged.faded.get(a, none)).mean())
        faded += sum(gone.sum() for gone in merged.faded.values())
    assert faded > 10 and np.mean(agree) > 0.98
    assert len(merged.superseded) > 5
    assert max(counts[5:]) < 0.7 * counts[3], "the eastern end is left alone"


def _drive(
    merger: Merger, world: World, map_id: MapId, tour: list[Pose2], rng: np.random.Generator
) -> HybridMap:
    nodes, edges = take_map(world, map_id, tour, rng, SHARP, sigma_xy=0.01, sigma_heading=0.005)
    for number, change in enumerate(changes_of(nodes, edges), start=1):
        stamp = int(map_id.agent[1:]) * 10**12
        if isinstance(change, NodePut):
            change = NodePut(replace(change.node, stamp_ns=stamp + change.node.stamp_ns, clock="wall"))
        merger.on_change(Change(map_id, number, 0, change))
    return merger.maps[map_id]


def _behind(world: World, world_from_robot: Pose2, points: np.ndarray, thing: np.ndarray) -> np.ndarray:
    """(N,) which of a node's landmarks are of the thing: its points are the nearest."""
    there = world_from_robot.apply(points)
    nearest = np.linalg.norm(there[:, None] - world.points[None], axis=2).argmin(axis=1)
    return np.isin(nearest, thing)
