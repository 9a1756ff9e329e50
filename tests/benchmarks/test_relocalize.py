"""The parts of the relocalization benchmark against plain arithmetic and known truth."""

import math
import time
from pathlib import Path

import numpy as np
import pytest

from benchmarks.fit_belief.benchmark import fit, reliability
from benchmarks.relocalize import pictures as relocalize_pictures
from benchmarks.relocalize.distractors import Distractors
from benchmarks.relocalize.pictures import Disturbance, Photographer, Picture, Wish, taken
from benchmarks.relocalize.places import Place, spread_out, twin_lookouts
from benchmarks.relocalize.queries import Query, beside
from benchmarks.relocalize.score import ask, figures, judged, spent
from mapweave.hybridmap.node import MapId, Node, NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import Certainty, RelocalizeAnswer, View, Whereabouts
from mapweave.mapserver.relocalization.calibration import HypothesisSupport
from mapweave.sim.worlds.catalog import make_world
from synthetic.world import CAMERA, room, take_map


def nodes_of(seed: int, count: int) -> list[Node]:
    rng = np.random.default_rng(seed)
    tour = [Pose2(2.5, 2.0, 0.7 * k) for k in range(count)]
    return take_map(room(0, 0, 5, 4, 400, rng), MapId("a", 1), tour, rng)[0]


def test_distractors_are_halves_of_real_nodes_and_always_the_same() -> None:
    donors = [Place(node, Pose2(), 0) for node in nodes_of(5, 6)]
    made = Distractors(donors, np.zeros((1, 32), np.float32), 7)
    a, again, b = made.node(3), made.node(3), made.node(4)
    codes = a.landmarks.codes
    assert np.array_equal(codes, again.landmarks.codes)
    assert a.id == NodeId("d", 1, 3) and not np.array_equal(codes, b.landmarks.codes)
    owners = []
    for code in codes:
        (owner,) = [k for k, d in enumerate(donors) if (d.node.landmarks.codes == code).all(axis=1).any()]
        owners.append(owner)
    assert 1 <= len(set(owners)) <= 2


def test_pictures_are_taken_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(relocalize_pictures, "FOLDER", tmp_path)
    world = make_world("arena", 3)
    wishes = [Wish(Pose2(2.0, 2.0, heading)) for heading in (0.0, 1.0)]
    first = taken("arena", lambda: Photographer(world, (1,)), wishes)

    def never() -> Photographer:
        raise AssertionError("they are there")

    second = taken("arena", never, wishes)
    for a, b in zip(first, second, strict=True):
        assert len(a) > 10 and a.camera == b.camera and a.world_from_robot == b.world_from_robot
        assert np.array_equal(a.codes, b.codes) and np.array_equal(a.pixels, b.pixels)
        assert np.array_equal(a.depths, b.depths, equal_nan=True)
    (kept,) = tmp_path.iterdir()
    kept.write_bytes(kept.read_bytes()[:100])
    third = taken("arena", lambda: Photographer(world, (1,)), wishes)
    assert np.array_equal(first[1].codes, third[1].codes)


def test_a_person_hides_about_a_third() -> None:
    world = make_world("arena", 3)
    shares = []
    artist = Photographer(world, (1,))
    for number in range(4):
        plain = artist.image(Wish(Pose2(2.0, 2.0, 0.4), number=number)).astype(int)
        hidden = artist.image(Wish(Pose2(2.0, 2.0, 0.4), Disturbance(person=True), number)).astype(int)
        shares.append(float((np.abs(plain - hidden).mean(axis=0) > 12).mean()))
    assert 0.2 < np.mean(shares) < 0.4


def test_twins_are_visited_in_the_same_way() -> None:
    world = make_world("twins", 5)
    east = world.plan.room("room 1").x - world.plan.room("room 0").x
    poses = twin_lookouts(world, 12, np.random.default_rng(6))
    for a, b in zip(poses[::2], poses[1::2], strict=True):
        assert Pose2(a.x + east, a.y, a.heading).distance(b) < 0.3
        assert abs(a.heading - b.heading) < 0.25


def test_places_far_from_each_other() -> None:
    grid = np.stack(np.meshgrid(np.arange(10.0), np.arange(10.0)), axis=-1).reshape(-1, 2)
    chosen = spread_out(grid, 5, np.random.default_rng(8))
    apart = np.linalg.norm(chosen[:, None] - chosen[None], axis=2) + 99 * np.eye(5)
    assert apart.min() > 4.0


def test_far_is_exactly_half_a_metre_and_twenty_degrees() -> None:
    world, rng = make_world("arena", 3), np.random.default_rng(9)
    place = Pose2(2.0, 2.0, 0.5)
    spots = [spot for _ in range(30) if (spot := beside(place, world, True, rng)) is not None]
    assert len(spots) > 5
    for spot in spots:
        assert place.distance(spot) == pytest.approx(0.5)
        assert abs(math.degrees((place.inverse() @ spot).heading)) == pytest.approx(20.0)


def test_answers_are_judged_by_the_truth() -> None:
    node = nodes_of(10, 1)[0]
    place = Place(node, Pose2(1.0, 2.0, 0.3), 0)
    truth = {node.id: place}
    here = place.world_from_node @ Pose2(0.2, 0.1, 0.1)
    codes = np.zeros((0, 32), np.uint8)
    picture = Picture(here, CAMERA, np.zeros((0, 2), np.float32), codes, np.zeros(0, np.float32))

    def scored(pose: Pose2, site: int, kind: str = "near") -> dict[str, float]:
        estimated = PoseGaussian.from_sigmas(pose, 0.1, 0.05)
        answer = RelocalizeAnswer(
            Certainty.FOUND, (Whereabouts(node.id, estimated, None, -1, 20, 0.9),), "because"
        )
        return figures([judged(Query(kind, picture, site), answer, truth)])

    right = scored(Pose2(0.3, 0.1, 0.1), 0)
    assert right["recall_at_1"] == 1 and right["error_m_median"] == pytest.approx(0.1, abs=1e-3)
    assert right["nees"] == pytest.approx(1.0, abs=0.01)
    assert scored(Pose2(0.5, 0.1, 0.1), 0)["recall_at_1"] == 0
    assert scored(Pose2(0.2, 0.1, 0.3), 0)["wrong_place"] == 1
    assert scored(Pose2(0.2, 0.1, 0.1), 1)["recall_at_1"] == 0
    assert scored(Pose2(0.2, 0.1, 0.1), 0, "twins")["false_accept"] == 1


@pytest.mark.slow
def test_the_fit_finds_the_weights_that_made_the_data() -> None:
    rng = np.random.default_rng(11)
    weights = np.array([-2.0, 1.2, 1.0, 1.5, 0.4, -2.5])
    supports = [
        HypothesisSupport(
            int(rng.integers(10, 90)), rng.random(), rng.random(), int(rng.integers(1, 4)), 2 * rng.random()
        )
        for _ in range(8_000)
    ]
    numbers = np.array([support.numbers for support in supports])
    right = rng.random(len(numbers)) < 1 / (1 + np.exp(-numbers @ weights))
    seen = [([support], [bool(there)]) for support, there in zip(supports, right, strict=True)]
    result = fit(seen)
    assert np.allclose(result, weights, atol=0.5)
    for row in reliability(seen, result):
        if row["places"] > 200:
            assert row["right"] == pytest.approx(row["predicted"], abs=0.05)


def test_the_benchmarks_own_work_is_not_timed() -> None:
    codes = np.zeros((0, 32), np.uint8)
    picture = Picture(Pose2(), CAMERA, np.zeros((0, 2), np.float32), codes, np.zeros(0, np.float32))
    making = np.zeros(2)

    def answer(_: View) -> RelocalizeAnswer:
        nonlocal making
        for seconds, counted in ((0.05, True), (0.1, False)):
            began = spent()
            while time.process_time() - began[1] < seconds:
                pass
            making = making if counted else making + spent() - began
        return RelocalizeAnswer(Certainty.UNKNOWN, (), "because")

    (reply,) = ask(answer, [Query("near", picture, 0)], {}, lambda: None, lambda: making)
    assert 49 < reply.cpu_ms < 90 and reply.ms > 49
    assert figures([reply])["cpu_p50_ms"] == pytest.approx(reply.cpu_ms, abs=0.01)
