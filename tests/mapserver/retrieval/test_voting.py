"""What nodes get, against plain loops."""

import numpy as np
import pytest

from mapweave.hybridmap.descriptor import decode
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.mapserver.retrieval import voting
from synthetic.world import room, take_node
from tests.merge.pose_graph.all_pairs import overlap


def test_votes_against_plain_loops():
    rng = np.random.default_rng(1)
    squared = np.sort(rng.uniform(0, 0.6, (40, 7)), axis=1).astype(np.float32)
    slots = rng.integers(-1, 9, (40, 7))
    expected = dict.fromkeys(range(9), 0.0)
    for distances, whose in zip(squared, slots, strict=True):
        best: dict[int, float] = {}
        for d, slot in zip(distances.tolist(), whose.tolist(), strict=True):
            if slot >= 0 and d < 0.5**2:
                best[slot] = max(best.get(slot, 0.0), 1 - d / 0.5**2)
        for slot, weight in best.items():
            expected[slot] += weight / np.sqrt(len(best))
    votes, scores = voting.votes(squared, slots, 0.5)
    assert dict(zip(votes.tolist(), scores.tolist(), strict=True)) == pytest.approx(
        {slot: score for slot, score in expected.items() if score > 0}
    )


def test_distant_descriptors_get_no_votes():
    votes, scores = voting.votes(np.full((3, 2), 1.0, np.float32), np.array([[1, 2]] * 3), 0.5)
    assert len(votes) == len(scores) == 0


@pytest.mark.parametrize("seed", range(5))
def test_overlaps_agree_with_one_node_at_a_time(seed: int):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(0, 400))
    rows, columns = rng.integers(0, 30, n), rng.integers(0, 150, n)
    slots, squared = rng.integers(0, 12, n) ** 2, rng.uniform(0, 0.25, n).astype(np.float32)
    expected = {
        int(slot): overlap(rows[slots == slot], columns[slots == slot], squared[slots == slot], 0.5)
        for slot in set(slots.tolist())
    }
    overlaps, values = voting.overlaps(rows, columns, squared, slots, 0.5, 3.0)
    assert dict(zip(overlaps.tolist(), values.tolist(), strict=True)) == pytest.approx(
        {slot: value for slot, value in expected.items() if value >= 3.0}
    )


@pytest.mark.parametrize("seed", range(5))
def test_overlaps_of_pairs_do_not_depend_on_what_is_compared_at_once(seed: int):
    rng = np.random.default_rng(seed)
    codes = rng.integers(24, 40, (60, 32)).astype(np.uint8)
    others = [
        np.clip(codes[: int(rng.integers(0, 60))] + rng.integers(-4, 5, 32), 0, 63).astype(np.uint8)
        for _ in range(90)
    ]
    one_by_one = []
    for other in others:
        differences = decode(codes)[:, None].astype(np.float64) - decode(other)[None]
        squared = (differences**2).sum(axis=2)
        rows, columns = np.nonzero(squared < 0.5**2)
        one_by_one.append(overlap(rows, columns, squared[rows, columns], 0.5))
    values = voting.pair_overlaps(codes, others, 0.5, 3.0)
    assert values == [voting.pair_overlaps(codes, [other], 0.5, 3.0)[0] for other in others]
    assert values == pytest.approx([value if value >= 3.0 else 0.0 for value in one_by_one], rel=1e-6)
    assert sum(value > 0 for value in values) > 10


def test_overlap_against_a_double_loop():
    rng = np.random.default_rng(1)
    world = room(0, 0, 5, 4, 600, rng)
    here = PoseGaussian.from_sigmas(Pose2(), 0.01, 0.01)
    a = take_node(world, NodeId("a", 1, 1), Pose2(2, 2, 0), here, rng).landmarks.codes
    b = take_node(world, NodeId("b", 1, 1), Pose2(2.3, 2, 0.1), here, rng).landmarks.codes
    first, second = decode(a), decode(b)
    best_a, best_b = np.zeros(len(first)), np.zeros(len(second))
    for i in range(len(first)):
        for j in range(len(second)):
            weight = 1 - float(((first[i] - second[j]) ** 2).sum()) / 0.25
            best_a[i], best_b[j] = max(best_a[i], weight), max(best_b[j], weight)
    expected = min(best_a.sum(), best_b.sum())
    assert expected > 10
    assert voting.pair_overlaps(a, [b, b[:0]], 0.5, 3.0) == pytest.approx([expected, 0.0], rel=1e-4)
    assert voting.pair_overlaps(a, [], 0.5, 3.0) == voting.pair_overlaps(a[:0], [], 0.5, 3.0) == []
