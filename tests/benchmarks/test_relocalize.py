"""The parts of the relocalization benchmark against plain arithmetic and known truth."""

import math
import time
from collections import Counter

import numpy as np
import pytest

from benchmarks.fit_belief.benchmark import fit, reliability
from benchmarks.relocalize import pictures as relocalize_pictures
from benchmarks.relocalize.distractors import Differences, Distractors
from benchmarks.relocalize.exhaustive import Exhaustive, asked_of, lost
from benchmarks.relocalize.peer import Vocabulary, WordIndex
from benchmarks.relocalize.pictures import Photographer, RenderedPicture, ViewDisturbance, Wish, taken
from benchmarks.relocalize.places import TruePlace, placed, spread_out, twin_lookouts
from benchmarks.relocalize.queries import Query, beside
from benchmarks.relocalize.score import ScoredAnswer, ask, figures, judged, spent
from mapweave import MapId, Node, NodeId, Pose2, PoseGaussian, Relocalizer
from mapweave.hybridmap.descriptor import decode, root_sift
from mapweave.hybridmap.query import Certainty, RelocalizeAnswer, View, Whereabouts
from mapweave.mapserver.relocalization.calibration import HypothesisSupport
from mapweave.mapserver.retrieval.place_index import PlaceIndex
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.registration.matching import MatchSettings, match_vectors
from mapweave.sim.worlds.catalog import make_world
from synthetic.world import CAMERA, room, take_map, take_view


def picture_of(sift: np.ndarray) -> RenderedPicture:
    n = len(sift)
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0, 240, (n, 2)).astype(np.float32)
    return RenderedPicture(Pose2(), CAMERA, pixels, sift, rng.uniform(1, 4, n).astype(np.float32))


def nodes_of(seed: int, count: int) -> list[Node]:
    rng = np.random.default_rng(seed)
    tour = [Pose2(2.5, 2.0, 0.7 * k) for k in range(count)]
    return take_map(room(0, 0, 5, 4, 400, rng), MapId("a", 1), tour, rng)[0]


def test_the_quick_count_of_the_ceiling_never_leaves_out_a_match(monkeypatch):
    rng = np.random.default_rng(1)
    own = rng.integers(0, 255, (60, 128))
    places = []
    for k in range(6):
        seen = np.clip(own[rng.permutation(60)[:40]] + rng.normal(0, 8 * (k + 1), (40, 128)), 0, 255)
        places.append(placed(picture_of(seen.astype(np.uint8)), NodeId("m", 1, k + 1), 0, rng))
    asked = picture_of(np.clip(own + rng.normal(0, 8, own.shape), 0, 255).astype(np.uint8))
    judge = Relocalizer(PlaceIndex(), lambda _: None, MergedMap.empty())
    empty = picture_of(np.zeros((1, 128), np.uint8))
    views = [root_sift(one.sift) for one in (empty, asked)]
    monkeypatch.setattr("benchmarks.relocalize.exhaustive.NODES_AT_ONCE", 4)
    counts = Exhaustive(places.__getitem__, len(places), judge).may_match(views)[1]
    matches = [len(match_vectors(root_sift(p.sift), root_sift(asked.sift), MatchSettings())) for p in places]
    assert max(matches) > 20 and min(matches) < max(matches)
    assert (counts >= matches).all()


def test_the_bag_of_words_is_tf_idf_and_cosine():
    nodes = nodes_of(2, 8)
    vocabulary = Vocabulary(np.concatenate([decode(node.landmarks.codes) for node in nodes]), 3)
    bags = [Counter(vocabulary.words(decode(node.landmarks.codes)).tolist()) for node in nodes]
    idf = {word: math.log(len(nodes) / sum(word in bag for bag in bags)) for bag in bags for word in bag}
    view, _ = take_view(
        room(0, 0, 5, 4, 400, np.random.default_rng(2)), Pose2(2.5, 2, 0.7), np.random.default_rng(4)
    )
    asked = Counter(vocabulary.words(decode(view.codes)).tolist())
    expected = {}
    for node, bag in zip(nodes, bags, strict=True):
        norm = math.sqrt(sum((n * idf[word]) ** 2 for word, n in bag.items()))
        expected[node.id] = (
            sum(n * idf.get(w, 0.0) * bag[w] * idf.get(w, 0.0) for w, n in asked.items()) / norm
        )
    nearest = WordIndex(nodes, vocabulary).query(view, 5)
    best = sorted(expected.items(), key=lambda item: -item[1])[:5]
    assert [node for node, _ in nearest] == [node for node, _ in best]
    assert [score for _, score in nearest] == pytest.approx([score for _, score in best])


def test_distractors_are_halves_of_real_nodes_and_always_the_same():
    rng = np.random.default_rng(5)
    donors = [
        TruePlace(node, Pose2(), 0, rng.integers(0, 256, (len(node.landmarks), 128)).astype(np.uint8))
        for node in nodes_of(5, 6)
    ]
    none = Differences(np.zeros((1, 32), np.float32), np.full((1, 128), 3, np.int16))
    made = Distractors(donors, none, 7)
    a, again, b = made.place(3), made.place(3), made.place(4)
    codes = a.node.landmarks.codes
    assert np.array_equal(codes, again.node.landmarks.codes) and np.array_equal(a.sift, again.sift)
    assert a.node.id == NodeId("d", 1, 3) and not np.array_equal(codes, b.node.landmarks.codes)
    owners = []
    for code, sift in zip(codes, a.sift, strict=True):
        (owner,) = [k for k, d in enumerate(donors) if (d.node.landmarks.codes == code).all(axis=1).any()]
        landmark = int((donors[owner].node.landmarks.codes == code).all(axis=1).argmax())
        # The whole descriptor is of the same landmark, changed by its own difference.
        assert np.array_equal(sift, np.minimum(donors[owner].sift[landmark].astype(int) + 3, 255))
        owners.append(owner)
    assert 1 <= len(set(owners)) <= 2


def test_the_loss_of_the_index_is_measured_on_the_same_views():
    picture = picture_of(np.zeros((0, 128), np.uint8))
    query = Query("near", picture, 0)

    def replies(recalled: str) -> list[ScoredAnswer]:
        return [
            ScoredAnswer(query, Certainty.FOUND if one == "y" else Certainty.UNKNOWN, 0, 0, 1)
            for one in recalled
        ]

    result = lost(replies("yyyyyynnnn"), replies("yyyyynyynn"))
    assert result["only_exhaustive"] == 2 and result["only_index"] == 1 and result["recall_lost"] == 0.1
    assert result["recall_lost_low"] < 0 < 0.1 < result["recall_lost_high"]
    many = lost(replies("y" * 400), replies("y" * 400))
    assert -0.02 < many["recall_lost_low"] < 0 < many["recall_lost_high"] < 0.02
    asked = asked_of([query] * 200, 10_000)
    assert len(asked_of([query] * 200, 1000)) == 200 and 20 < len(asked) < 100


def test_pictures_are_taken_once(tmp_path, monkeypatch):
    monkeypatch.setattr(relocalize_pictures, "FOLDER", tmp_path)
    world = make_world("arena", 3)
    wishes = [Wish(Pose2(2.0, 2.0, heading)) for heading in (0.0, 1.0)]
    first = taken("arena", lambda: Photographer(world, (1,)), wishes)

    def never() -> Photographer:
        raise AssertionError("they are there")

    second = taken("arena", never, wishes)
    for a, b in zip(first, second, strict=True):
        assert len(a) > 10 and a.camera == b.camera and a.world_from_robot == b.world_from_robot
        assert np.array_equal(a.sift, b.sift) and np.array_equal(a.pixels, b.pixels)
        assert np.array_equal(a.depths, b.depths, equal_nan=True)
    (kept,) = tmp_path.iterdir()
    kept.write_bytes(kept.read_bytes()[:100])
    third = taken("arena", lambda: Photographer(world, (1,)), wishes)
    assert np.array_equal(first[1].sift, third[1].sift)


def test_a_person_hides_about_a_third():
    world = make_world("arena", 3)
    shares = []
    artist = Photographer(world, (1,))
    for number in range(4):
        plain = artist.image(Wish(Pose2(2.0, 2.0, 0.4), number=number)).astype(int)
        hidden = artist.image(Wish(Pose2(2.0, 2.0, 0.4), ViewDisturbance(person=True), number)).astype(int)
        shares.append(float((np.abs(plain - hidden).mean(axis=0) > 12).mean()))
    assert 0.2 < np.mean(shares) < 0.4


def test_twins_are_visited_in_the_same_way():
    world = make_world("twins", 5)
    east = world.plan.room("room 1").x - world.plan.room("room 0").x
    poses = twin_lookouts(world, 12, np.random.default_rng(6))
    for a, b in zip(poses[::2], poses[1::2], strict=True):
        assert Pose2(a.x + east, a.y, a.heading).distance(b) < 0.3
        assert abs(a.heading - b.heading) < 0.25


def test_places_far_from_each_other():
    grid = np.stack(np.meshgrid(np.arange(10.0), np.arange(10.0)), axis=-1).reshape(-1, 2)
    chosen = spread_out(grid, 5, np.random.default_rng(8))
    apart = np.linalg.norm(chosen[:, None] - chosen[None], axis=2) + 99 * np.eye(5)
    assert apart.min() > 4.0


def test_far_is_exactly_half_a_metre_and_twenty_degrees():
    world, rng = make_world("arena", 3), np.random.default_rng(9)
    place = Pose2(2.0, 2.0, 0.5)
    spots = [spot for _ in range(30) if (spot := beside(place, world, True, rng)) is not None]
    assert len(spots) > 5
    for spot in spots:
        assert place.distance(spot) == pytest.approx(0.5)
        assert abs(math.degrees((place.inverse() @ spot).heading)) == pytest.approx(20.0)


def test_answers_are_judged_by_the_truth():
    node = nodes_of(10, 1)[0]
    place = TruePlace(node, Pose2(1.0, 2.0, 0.3), 0, np.zeros((0, 128), np.uint8))
    truth = {node.id: place}
    here = place.world_from_node @ Pose2(0.2, 0.1, 0.1)
    sift = np.zeros((0, 128), np.uint8)
    picture = RenderedPicture(here, CAMERA, np.zeros((0, 2), np.float32), sift, np.zeros(0, np.float32))

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
def test_the_fit_finds_the_weights_that_made_the_data():
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


def test_the_benchmarks_own_work_is_not_timed():
    sift = np.zeros((0, 128), np.uint8)
    picture = RenderedPicture(Pose2(), CAMERA, np.zeros((0, 2), np.float32), sift, np.zeros(0, np.float32))
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
