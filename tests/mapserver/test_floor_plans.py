"""Floor plans under a merged map: known transforms are found, and doubtful pairs are named."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.floor_plan import IDENTITY, FloorPlan, PlanImage, PlanPair
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pin import Pin
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.floor_plans import CLICK, check_plan, placed_plan
from mapweave.mapserver.merging.merger import Merger
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.registration.similarity import Similarity
from synthetic.maps import map_tours, merger_of
from synthetic.world import room

A = MapId("a", 1)
IMAGE = PlanImage("0" * 64, 800, 500, "office.png")
ORIGIN = Pose2(-10.0, -5.5, 0.25)
MERGED_FROM_PIXELS = Similarity(-3.0, -9.0, 0.6, 0.05)
"""Of pixels that are counted up from the lower left corner."""


@pytest.fixture(scope="module")
def merger() -> Merger:
    rng = np.random.default_rng(4)
    stops = [Pose2(1.0 + 1.5 * k, 1.0 + 2.0 * (k % 2) + 3.0 * (k % 3), 0.4 * k) for k in range(8)]
    return merger_of(map_tours(room(0, 0, 14, 12, 600, rng), {A: stops}, rng))


@pytest.fixture(scope="module")
def merged(merger: Merger) -> MergedMap:
    return merger.merged()


def pairs_of(
    merged: MergedMap,
    truth: Similarity = MERGED_FROM_PIXELS,
    seed: int = 0,
    count: int = 6,
    off: float = 0.05,
) -> list[PlanPair]:
    """Pairs beside nodes, clicked with an error, m."""
    rng = np.random.default_rng(seed)
    out = []
    for node in sorted(merged.poses)[:count]:
        beside = rng.uniform(-0.5, 0.5, 2)
        point = merged.pose(node).apply(beside) + rng.normal(0.0, off, 2)
        u, up = Pose2(truth.x, truth.y, truth.heading).inverse().apply(point) / truth.scale
        out.append(PlanPair(node, float(beside[0]), float(beside[1]), float(u), IMAGE.height - float(up)))
    return out


def plan_of(pairs: Sequence[PlanPair], scale: float | None = None, origin: Pose2 = IDENTITY) -> FloorPlan:
    return FloorPlan(tuple(pairs), IMAGE, scale, origin)


@pytest.mark.parametrize("scale", [None, 0.05])
@pytest.mark.parametrize("origin", [IDENTITY, ORIGIN])
def test_exact_pairs_give_the_transform(merged: MergedMap, scale: float | None, origin: Pose2):
    placed = check_plan(plan_of(pairs_of(merged, off=0.0), scale, origin), merged)
    (part,) = placed.parts
    assert part.component == 0 and part.metres_per_pixel == pytest.approx(0.05, rel=1e-6)
    assert part.rms < 1e-6 and part.doubts == () and placed.reason == ""
    # A pixel, by two ways: through the image's matrix, and through the plan's own frame.
    u, v = 123.0, 77.0
    a, b, c, d, e, f = part.merged_from_image
    point = np.array([a * u + c * v + e, b * u + d * v + f])
    assert np.allclose(point, MERGED_FROM_PIXELS.apply(np.array([u, IMAGE.height - v])), atol=1e-5)
    in_plan = origin.apply(0.05 * np.array([u, IMAGE.height - v]))
    assert np.allclose(part.plan_from_merged.apply(point), in_plan, atol=1e-5)


def test_clicks_are_off_as_expected_and_the_plan_by_less(merged: MergedMap):
    """Over many plans the true position of a pixel amid the pairs is off by the sigma that is given."""
    offs, sigmas, rms = [], [], []
    middle = np.array([400.0, 250.0])
    for seed in range(60):
        plan = plan_of(pairs_of(merged, seed=seed, off=CLICK), 0.05)
        part = placed_plan("office", plan, merged).part()
        middle = plan.pixels.mean(axis=0)
        a, b, c, d, e, f = part.merged_from_image
        u, v = middle[0], IMAGE.height - middle[1]
        off = np.array([a * u + c * v + e, b * u + d * v + f]) - MERGED_FROM_PIXELS.apply(middle)
        offs.append(off / part.sigma)
        sigmas.append(part.sigma)
        rms.append(part.rms)
    # The map itself is the truth here, so its own covariance is in the sigma and not in the errors.
    assert 0.5 < math.sqrt(float(np.mean(np.square(offs)))) < 1.2
    assert 0.03 < np.mean(sigmas) < 0.2 and 0.05 < np.mean(rms) < 0.2


def test_a_wrong_pair_and_a_wrong_scale_are_named(merged: MergedMap):
    pairs = pairs_of(merged, count=7)
    wrong = [*pairs[:3], replace(pairs[3], u=pairs[3].u + 60.0), *pairs[4:]]
    part = placed_plan("office", plan_of(wrong, 0.05), merged).part()
    assert part.doubts[0].startswith(f"pair 4 ({pairs[3].node}, ")
    assert part.pairs[3].off_others == pytest.approx(3.0, abs=0.5) and part.pairs[3].chance < 1e-3
    stretched = pairs_of(merged, replace(MERGED_FROM_PIXELS, scale=0.054), off=0.02)
    part = placed_plan("office", plan_of(stretched, 0.05), merged).part()
    (doubt,) = [words for words in part.doubts if "stretched" in words]
    assert doubt.startswith("the pairs say 0.05") and "the plan says 0.05: +" in doubt
    assert part.metres_per_pixel == 0.05 and part.fitted_scale == pytest.approx(0.054, rel=0.01)
    free = placed_plan("office", plan_of(stretched), merged).part()
    assert free.doubts == () and free.metres_per_pixel == pytest.approx(0.054, rel=0.01)


def test_a_plan_that_cannot_be_placed_is_refused(merged: MergedMap):
    pairs = pairs_of(merged)
    with pytest.raises(InvalidValue, match="component 0 has 2 pairs, and 3 are needed"):
        check_plan(plan_of(pairs[:2]), merged)
    mirrored = [replace(pair, v=500.0 - pair.v) for pair in pairs]
    with pytest.raises(InvalidValue, match="a mirror image of the plan fits better"):
        check_plan(plan_of(mirrored), merged)
    gone = [replace(pair, node=NodeId("c", 1, k)) for k, pair in enumerate(pairs)]
    with pytest.raises(
        InvalidValue, match=r"6 pairs of nodes that are not in the merged map: c\.1\.0, c\.1\.1"
    ):
        check_plan(plan_of(gone), merged)
    # The others are enough.
    placed = check_plan(plan_of([*pairs[:4], *gone[4:]]), merged)
    assert [pair.number for pair in placed.part().pairs] == [1, 2, 3, 4]
    assert "2 pairs of nodes that are not" in placed.reason
    with pytest.raises(InvalidValue, match="does not lie under component 3, but under 0"):
        placed.part(3)
    with pytest.raises(InvalidValue, match="the same pixel"):
        plan_of([*pairs, pairs[0]])


def test_the_plan_does_not_depend_on_the_frame_of_the_map(merger: Merger, merged: MergedMap):
    """The frame of the map can be any: what the plan says of the building does not depend on it."""
    plan = plan_of(pairs_of(merged), 0.05, ORIGIN)
    free = placed_plan("office", plan, merged).part()
    pin = Pin(sorted(merged.poses)[-1], Pose2(200.0, -30.0, 2.0))
    merger.pin([pin])
    held = placed_plan("office", plan, merger.merged()).part()
    merger.pin([])
    for node in merged.poses:
        before = free.plan_from_merged @ merged.pose(node)
        motion = pin.merged_from_node @ merged.pose(pin.node).inverse()
        after = held.plan_from_merged @ (motion @ merged.pose(node))
        assert np.allclose(before.vector, after.vector, atol=2e-4)
    assert held.rms == pytest.approx(free.rms, rel=1e-2)
    assert [pair.chance for pair in held.pairs] == pytest.approx(
        [pair.chance for pair in free.pairs], rel=0.05
    )
