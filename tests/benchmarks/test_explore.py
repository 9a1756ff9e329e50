"""The judge of exploration: which floor nodes show, against looking along every line step by step."""

import json
import math

import numpy as np
import pytest

from benchmarks.explore.area import REACH, SQUARE, Look, MappedFloor, floor_squares, mapped_floor, shows
from benchmarks.explore.benchmark import STRATEGIES, Exploration, figures, measure, table
from benchmarks.explore.start import APART, NEAR, gathered, office
from mapweave.evaluation.map_score import crossed
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Pose2
from mapweave.sim.floorplan import BuildingPlan, Rectangle
from mapweave.sim.worlds.catalog import make_world

PLAN = BuildingPlan(
    rooms=(Rectangle.spanning(0, 0, 8, 4, "hall"),),
    walls=(
        Rectangle.spanning(-0.1, -0.1, 8.1, 0), Rectangle.spanning(-0.1, 4, 8.1, 4.1),
        Rectangle.spanning(-0.1, 0, 0, 4), Rectangle.spanning(8, 0, 8.1, 4),
        Rectangle.spanning(4, 1.5, 4.1, 4),
    ),
    furniture=(Rectangle(2.5, 1.0, 0.6, 0.4, 0.4, "desk"),),
)  # fmt: skip
"""A hall with a wall that leaves a passage, and a desk."""


@pytest.mark.parametrize("pose", [Pose2(1.0, 2.0, 0.0), Pose2(3.0, 0.8, 2.9), Pose2(6.0, 1.0, -3.0)])
def test_a_node_shows_what_is_visible_in_its_field_of_view(pose: Pose2):
    squares = floor_squares(PLAN)
    shown = shows(Look(0.0, pose, 0.5), squares, PLAN)
    steps = np.linspace(0.0, 1.0, 400)[:, None]
    for square, outcome in zip(squares, shown, strict=True):
        line = np.array([pose.x, pose.y]) + steps * (square - [pose.x, pose.y])
        off = math.atan2(square[1] - pose.y, square[0] - pose.x) - pose.heading
        seen = (
            np.hypot(*(square - [pose.x, pose.y])) <= REACH
            and abs(math.remainder(off, math.tau)) <= 0.5
            and PLAN.clearances(line).min() > 0.0
        )
        # Lines that only just miss a corner may differ.
        if PLAN.clearances(line).min() > 0.01 or PLAN.clearances(line).min() == 0.0:
            assert outcome == seen
    assert 0.01 < shown.mean() < 0.5


def test_floor_is_mapped_from_the_first_view_on():
    west, east = Pose2(1.0, 2.0, 0.0), Pose2(7.0, 2.0, math.pi)
    views = {"r0": [Look(5.0, west, 0.5), Look(9.0, west, 0.5)], "r1": [Look(7.0, east, 0.5)], "r2": []}
    floor = mapped_floor(PLAN, views)
    squares = floor_squares(PLAN)
    first, second = (shows(Look(0.0, pose, 0.5), squares, PLAN) for pose in (west, east))
    assert not (first & second).any()
    assert floor.area(4.9) == 0.0
    assert floor.area(5.0) == pytest.approx(first.sum() * SQUARE**2)
    assert floor.area(100.0) == pytest.approx((first | second).sum() * SQUARE**2)
    assert floor.overlap(100.0) == 0.0
    assert floor.whole == pytest.approx(len(squares) * SQUARE**2)
    assert 0.7 * 32.0 < floor.whole < 32.0
    views["r1"].append(Look(8.0, west, 0.5))
    both = mapped_floor(PLAN, views)
    assert both.overlap(7.9) == 0.0
    assert both.overlap(8.0) == pytest.approx(first.sum() / (first | second).sum())


def test_time_to_a_share():
    floor = MappedFloor(np.array([[3.0, 9.0], [1.0, 0.5], [np.inf, np.inf], [7.0, 2.0]]))
    assert floor.time_to(0.25) == 0.5
    assert floor.time_to(0.5) == 2.0
    assert floor.time_to(0.51) == 3.0
    assert floor.time_to(0.76) is None


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_fleet_starts_at_one_place(seed: int):
    plan = make_world("office", seed, rooms=4).plan
    poses = gathered(plan, 3, seed)
    assert [p.vector.tolist() for p in poses] == [p.vector.tolist() for p in gathered(plan, 3, seed)]
    assert poses[0].distance(gathered(plan, 3, seed + 1)[0]) > 0.0
    gaps = [a.distance(b) for k, a in enumerate(poses) for b in poses[:k]]
    assert min(gaps) >= APART
    for pose in poses:
        assert plan.is_free(pose.x, pose.y, 0.3)
        assert pose.distance(poses[0]) <= NEAR
        here, first = np.array([[pose.x, pose.y]]), np.array([[poses[0].x, poses[0].y]])
        assert not crossed(here, first, plan.walls).any()
    setups = office(4, 3, seed, spread=False).robots
    assert [setup.pose for setup in setups] == poses
    assert all(setup.pose is None for setup in office(4, 3, seed, spread=True).robots)


def test_too_many_for_one_place_are_refused():
    closet = BuildingPlan(rooms=(Rectangle.spanning(0, 0, 2, 2, "closet"),), walls=())
    with pytest.raises(InvalidValue, match="12 robots do not fit into one place: use --spread"):
        gathered(closet, 12, 0)
    with pytest.raises(InvalidValue, match="do not fit"):
        gathered(BuildingPlan(rooms=(), walls=(Rectangle.spanning(0, 0, 1, 1),)), 1, 0)


def explored(seen: list[list[float]], nodes: int) -> Exploration:
    """What a fleet of as many robots as there are columns did on four squares of floor."""
    return Exploration(MappedFloor(np.array(seen)), nodes, 0, 0, 1, 0.01)


def test_figures_by_hand():
    inf = math.inf
    done = {
        "random": {2: explored([[30.0, inf], [inf, inf], [inf, inf], [inf, inf]], 3)},
        "ours": {2: explored([[30.0, 20.0], [inf, 70.0], [inf, inf], [inf, inf]], 5)},
        "fleet": {2: explored([[30.0, inf], [inf, 70.0], [90.0, inf], [130.0, inf]], 4)},
    }
    result = json.loads(json.dumps(figures(done, 2.0, 7)))
    square = SQUARE**2
    for name, squares in (("random", 1), ("ours", 2), ("fleet", 3)):
        assert result[f"area_per_minute_{name}"]["2"] == pytest.approx(squares * square / 2.0, abs=1e-3)
    assert result["speedup_over_random"] == {"ours": {"2": 2.0}, "fleet": {"2": 3.0}}
    assert result["overlap"] == {"random": {"2": 0.0}, "ours": {"2": 0.5}, "fleet": {"2": 0.0}}
    assert result["minutes_to_half"]["random"]["2"] is None
    assert result["minutes_to_half"]["ours"]["2"] == pytest.approx(70 / 60, abs=0.01)
    assert result["nodes"]["ours"]["2"] == 5
    assert table(result).row_count == 3
    nothing = {name: {2: explored([[inf, inf]], 0)} for name in STRATEGIES}
    assert figures(nothing, 1.0, 7)["speedup_over_random"]["ours"]["2"] is None
    assert table(figures(nothing, 1.0, 7)).row_count == 3


@pytest.mark.slow
def test_a_short_race():
    """One robot for some seconds: both strategies run in the same office, without a fleet."""
    done = measure([1], 3, 0.16, 1, spread=False, quiet=True)
    assert set(done["ours"]) == set(done["random"]) == {1}
    assert not done["fleet"]
    assert done["ours"][1].floor.whole == done["random"][1].floor.whole > 10.0
    assert done["ours"][1].nodes > 0
    assert done["ours"][1].floor.area(9.6) > 0.5
    assert np.isinf(done["ours"][1].floor.seen).mean() > 0.5
