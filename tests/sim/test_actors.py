"""People and boxes: they keep to free floor, give way to robots, and robots notice them."""

import math
from itertools import pairwise

import numpy as np
import pytest

from mapweave import Command, Pose2
from mapweave.hybridmap.errors import InvalidValue
from mapweave.sim.actors import AHEAD, FIGURES, Actor
from mapweave.sim.events import Walk
from mapweave.sim.floorplan import BuildingPlan, distances_to
from mapweave.sim.placement import is_clear, sampled
from mapweave.sim.simulation import Simulation
from mapweave.sim.world import World
from mapweave.sim.worlds.catalog import KINDS, make_world
from tests.quick import first_quick

NO_OTHERS = np.zeros((0, 2))


def test_a_person_walks_to_and_fro_at_its_speed():
    """Along both legs and back, never faster, looking where it goes."""
    actor = Actor("person", ((0.0, 0.0), (1.0, 0.0), (1.0, 0.5)), 0.5, 100, NO_OTHERS, 0.16)
    poses = [actor.pose]
    for _ in range(62):
        actor.walk(0.1, NO_OTHERS)
        poses.append(actor.pose)
    steps = np.array([p.distance(q) for p, q in pairwise(poses)])
    assert steps.max() <= 0.05 + 1e-9
    assert poses[30].distance(Pose2(1.0, 0.5)) < 0.051
    assert poses[61].distance(Pose2(0.0, 0.0)) < 0.051
    for a, b in pairwise(poses[2:19]):
        assert (b.x - a.x, b.heading) == (pytest.approx(0.05), 0.0)
    back = poses[50].heading
    assert math.cos(back) == pytest.approx(-1.0)


def test_a_person_waits_for_a_robot_then_turns_back():
    """Never nearer than 0.5 m to what is ahead."""
    robot = np.array([[1.5, 0.1]])
    actor = Actor("person", ((0.0, 0.0), (3.0, 0.0)), 1.0, 1000, robot, 0.16)
    xs = []
    for _ in range(60):
        actor.walk(0.1, robot)
        xs.append(actor.pose.x)
    edge = 1.5 - 0.16 - AHEAD - FIGURES["person"].length / 2
    assert max(xs) <= edge
    assert max(xs) > edge - 0.11
    assert min(xs[30:]) < 0.2
    with pytest.raises(InvalidValue, match="robots stand all along"):
        Actor("box", ((0.0, 0.0), (0.3, 0.0)), 1.0, 10, np.array([[0.15, 0.0]]), 0.16)


@pytest.mark.parametrize("kind", sorted(KINDS))
@pytest.mark.parametrize("seed", first_quick([1, 2], 1))
def test_paths_near_robots_are_on_free_floor_and_in_view(kind: str, seed: int):
    """In every world: no wall, furniture or robot is touched; before the camera if there is room."""
    world = make_world(kind, seed)
    with Simulation(world, ["a", "b", "c", "d"], seed) as simulation:
        solids = (*world.plan.walls, *world.plan.furniture)
        for name in simulation.robots:
            simulation.apply(Walk(near=name, seconds=4.0))
            robot = simulation.truth(name)
            off = robot.inverse().apply(sampled(simulation._stage.actors[-1].path))
            seen = (np.abs(np.arctan2(off[:, 1], off[:, 0])) < math.radians(30)) & (off[:, 0] < 3.5)
            ahead = robot @ Pose2(1.8, 0.0)
            if is_clear(world.plan, [(robot.x, robot.y), (ahead.x, ahead.y)], 0.4):
                assert seen.sum() > 10
        for _ in range(35):
            simulation.advance({})
            for shape in simulation.snapshot().actors:
                assert distances_to(solids, shape.corners).min() > 0.0
                assert world.plan.is_free(shape.x, shape.y, 0.2)
        assert all(simulation.collisions(name) == 0 for name in simulation.robots)
        simulation.advance({})
        for _ in range(6):
            simulation.advance({})
        assert simulation.snapshot().actors == ()


def test_rangers_cameras_and_bumpers_notice(bare: World):
    """At once, where it stands; and it is gone at the end."""
    with Simulation(bare, ["r0"], 1, [Pose2()]) as simulation:
        alone = simulation.observe("r0")
        simulation.apply(Walk("box", path=((1.0, -0.001), (1.0, 0.02)), speed=0.01, seconds=6.0))
        met = simulation.observe("r0")
        assert met.proximity[0] == pytest.approx(1.0 - 0.2 - 0.16, rel=0.05)
        assert np.abs(met.image.astype(int) - alone.image)[110:200, 120:200].mean() > 20
        bumps = [simulation.step({"r0": Command(0.3)})["r0"].bumped for _ in range(40)]
        assert any(bumps)
        assert simulation.collisions("r0") == 1
        assert simulation.truth("r0").x < 0.7
        for _ in range(25):
            after = simulation.step({"r0": Command(-0.1)})["r0"]
        assert simulation.snapshot().actors == ()
        assert after.proximity.min() == simulation.describe("r0").ranger_reach


def test_the_picture_of_a_person_is_where_the_person_is(bare: World, stand):
    """Pixels that change are those of its corners' hull, give or take a pixel."""
    with Simulation(bare, ["r0"], 1, [Pose2()]) as simulation:
        alone = simulation.observe("r0").image
        simulation.apply(Walk("person", path=((2.0, -0.5), (2.0, 0.5)), speed=0.3, seconds=9.0))
        for _ in range(4):
            simulation.advance({})
        image = simulation.observe("r0").image
        shape = simulation.snapshot().actors[0]
        camera = simulation.describe("r0").camera
        corners = np.array([[x, y, z] for x, y in shape.corners for z in (0.0, 1.75)])
        pixels = camera.project(simulation.truth("r0").inverse().apply(corners))
    changed = np.abs(image.astype(int) - alone) > 25
    columns = np.flatnonzero(changed.sum(axis=0) > 20)
    assert columns[0] == pytest.approx(pixels[:, 0].min(), abs=2)
    assert columns[-1] == pytest.approx(pixels[:, 0].max(), abs=2)
    rows = np.flatnonzero(changed.sum(axis=1) > 8)
    assert rows[-1] == pytest.approx(pixels[:, 1].max(), abs=2)
    assert rows[0] == 0


def test_legs_through_walls_are_refused(walled: World):
    """Also those that only graze one, and legs without length."""
    plan: BuildingPlan = walled.plan
    assert plan.walls[0].x == pytest.approx(1.1)
    with Simulation(walled, ["r0"], 1, [Pose2(-3.0, 0.0)]) as simulation:
        simulation.apply(Walk(path=((-2.0, 1.0), (0.7, 1.0))))
        for path in (((0.0, 0.0), (2.0, 0.0)), ((0.9, -1.0), (0.9, 1.0)), ((0.0, 0.0), (0.0, 0.0))):
            with pytest.raises(InvalidValue, match="walk: the leg"):
                simulation.apply(Walk(path=path))
        assert len(simulation.snapshot().actors) == 1
