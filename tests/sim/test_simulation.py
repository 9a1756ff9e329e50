"""Simulated robots against their own specification: repeatable, level, slipping as much as they should."""

import hashlib
import math
import os
import subprocess
import sys

import numpy as np
import pytest

from mapweave import Command, Pose2
from mapweave.hybridmap.errors import InvalidValue
from mapweave.sim.body import BodySettings
from mapweave.sim.robots import RobotSetup, camera_from_table
from mapweave.sim.simulation import Simulation
from mapweave.sim.world import World
from mapweave.sim.worlds.catalog import make_world
from tests.programs import python

RANGE_NOISE = RobotSetup("r0").range_noise


def test_pybullet_prints_nothing_amid_a_log():
    """It said on stderr when it was built: a line without the time, and none of JSON."""
    program = "import sys, mapweave.sim.physics; print('after it', file=sys.stderr)"
    done = python("-c", program, check=True)
    assert (done.stdout, done.stderr) == ("", "after it\n")


def fingerprint(seed: int) -> str:
    """Digest of all that three robots sense on a short drive."""
    digest = hashlib.sha256()
    rng = np.random.default_rng(seed)
    with Simulation(make_world("office", seed, rooms=1), ["r0", "r1", "r2"], seed) as simulation:
        for tick in range(12):
            commands = {name: Command(*rng.uniform(-0.5, 0.5, 2).tolist()) for name in simulation.robots}
            for name, seen in simulation.step(commands).items():
                numbers = [seen.odometry.forward, seen.odometry.turn, *seen.proximity]
                digest.update(np.array([*numbers, seen.bumped]).tobytes() + name.encode())
                if tick % 6 == 0:
                    digest.update(seen.image.tobytes())
            if tick == 6:
                simulation.kidnap("r1", simulation.truth("r1") @ Pose2(0.05, 0.0, 0.3))
    return digest.hexdigest()


@pytest.mark.slow
def test_same_seed_and_commands_give_the_same_bits():
    """Also in another process, whose hashes differ, and with robots that meet."""
    here = fingerprint(5)
    script = (
        "import importlib.util as u;"
        f"s = u.spec_from_file_location('again', {__file__!r}); m = u.module_from_spec(s);"
        "s.loader.exec_module(m); print(m.fingerprint(5))"
    )
    for hash_seed in ("1", "2"):
        run = subprocess.run(
            [sys.executable, "-c", script],
            env={**os.environ, "PYTHONHASHSEED": hash_seed},
            capture_output=True,
            text=True,
            check=True,
        )
        # Nothing but our own line: stdout belongs to the program.
        assert run.stdout == here + "\n"
    assert fingerprint(6) != here


def test_odometry_errors_match_the_slip_model(bare: World):
    """Eight robots: 2 m straight, then two full turns, against variances derived from the settings."""
    names = [f"r{k}" for k in range(8)]
    poses = [Pose2(0.0, 3.0 * k, 0.0) for k in range(8)]
    settings = BodySettings()

    def share(seconds: float) -> float:
        """Deviation of one wheel's way, as a share: its radius, and the mean of slip over the time."""
        slip = settings.slip**2 * 2 / seconds * (1 - (1 - math.exp(-seconds)) / seconds)
        return math.sqrt(settings.radius_error**2 + slip)

    with Simulation(bare, names, 3, poses) as simulation:
        axle = simulation.describe("r0").axle

        def drive(command: Command, ticks: int) -> tuple[np.ndarray, np.ndarray]:
            """(8, 2) forward and turn: by the encoders, and true."""
            before = {n: simulation.truth(n) for n in names}
            turned = dict.fromkeys(names, 0.0)
            for _ in range(ticks):
                last = {n: simulation.truth(n) for n in names}
                simulation.advance(dict.fromkeys(names, command))
                for n in names:
                    turned[n] += (last[n].inverse() @ simulation.truth(n)).heading
            for _ in range(8):
                simulation.advance({})
            seen = [simulation.observe(n).odometry for n in names]
            true = [[before[n].distance(simulation.truth(n)), turned[n]] for n in names]
            return np.array([[o.forward, o.turn] for o in seen]), np.array(true)

        seen, true = drive(Command(0.3, 0.0), 67)
        wheel = share(6.7)
        assert seen[:, 0] == pytest.approx(2.0, abs=0.03)
        straight = (seen - true) / [wheel / math.sqrt(2) * 2.0, wheel * math.sqrt(2) * 2.0 / axle]
        seen, true = drive(Command(0.0, 0.8), 157)
        angle = 4 * math.pi
        assert seen[:, 1] == pytest.approx(angle, abs=0.1)
        wheel = share(15.7)
        turn_sigma = angle * math.hypot(wheel / math.sqrt(2), settings.axle_error)
        turning = (seen - true)[:, 1] / turn_sigma
    for errors in (straight[:, 0], straight[:, 1], turning):
        assert 0.3 < np.sqrt(np.mean(errors**2)) < 1.9
        assert np.abs(errors).max() < 4.0


def test_kidnap_is_not_noticed_by_the_encoders(office: World):
    """Neither standing nor driving; and the robot is where it was put."""
    with Simulation(office, ["r0"], 1) as simulation:
        for _ in range(5):
            simulation.step({"r0": Command(0.2, 0.3)})
        for speed in (0.0, 0.3):
            simulation.step({"r0": Command(speed, 0.0)})
            simulation.observe("r0")
            place = office.start_poses(3, 9)[2]
            simulation.kidnap("r0", place)
            there = simulation.truth("r0")
            assert there.distance(place) < 1e-9
            assert abs((place.inverse() @ there).heading) < 1e-6
            seen = simulation.observe("r0")
            assert (seen.odometry.forward, seen.odometry.turn) == (0.0, 0.0)
            seen = simulation.step({})["r0"]
            assert abs(seen.odometry.forward) < 1e-4
            assert abs(seen.odometry.turn) < 1e-3


def test_the_solver_loses_next_to_nothing(bare: World):
    """Ideal wheels over 9 m and three turns: where odometry says, to 1 % of what slip costs."""
    ideal = BodySettings(radius_error=0.0, axle_error=0.0, slip=0.0)
    legs = [
        (0.3, 0.0, 100), (0.0, 0.8, 80), (0.3, 0.2, 100), (0.0, -0.8, 80), (0.3, -0.4, 100), (0.0, 0.0, 10),
    ]  # fmt: skip
    with Simulation(bare, [RobotSetup("r0", body=ideal)], 1, [Pose2()]) as simulation:
        pose = Pose2()
        for forward, turn, ticks in legs:
            for _ in range(ticks):
                simulation.advance({"r0": Command(forward, turn)})
                pose = pose @ simulation._robots["r0"].body.odometry().motion()
        off = pose.inverse() @ simulation.truth("r0")
    assert math.hypot(off.x, off.y) < 0.006
    assert abs(off.heading) < math.radians(0.1)


def test_a_robot_without_a_command_stays_where_it_is(bare: World):
    """Of any mass and heading, after a drive: within 0.04 mm in half a second and 0.2 mm in five seconds."""
    masses = [1.0, 4.0, 4.0, 4.0, 4.0, 30.0]
    setups = [RobotSetup(f"r{k}", body=BodySettings(mass=mass)) for k, mass in enumerate(masses)]
    poses = [Pose2(0.0, 3.0 * k, 0.6 * k) for k in range(len(masses))]
    with Simulation(bare, setups, 6, poses) as simulation:
        for _ in range(15):
            simulation.advance({name: Command(0.25, 0.3) for name in simulation.robots})
        for _ in range(70):
            simulation.advance({})
        for name in simulation.robots:
            # The wheels have come to rest after 2 s.
            way = simulation.trajectory(name)[1][35:, :2]
            for ticks, bound in ((5, 4e-5), (50, 2e-4)):
                assert np.linalg.norm(way[ticks:] - way[:-ticks], axis=1).max() < bound


def test_a_robot_that_stands_can_be_pushed(bare: World):
    """By a heavier one, also across its wheels; then it stays where it was pushed to."""
    setups = [RobotSetup("r0"), RobotSetup("r1", body=BodySettings(mass=8.0))]
    with Simulation(bare, setups, 7, [Pose2(0.0, 0.0, math.pi / 2), Pose2(-0.4, 0.0, 0.0)]) as simulation:
        for _ in range(40):
            simulation.advance({"r1": Command(0.3)})
        assert simulation.truth("r0").x > 0.5
        for _ in range(70):
            simulation.advance({})
        way = simulation.trajectory("r0")[1][60:, :2]
        assert np.linalg.norm(way[50:] - way[:-50], axis=1).max() < 2e-4


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_commands_are_clipped(bare: World, sign: float):
    """Ten times the limit is the limit."""
    with Simulation(bare, ["r0"], 2, [Pose2()]) as simulation:
        description = simulation.describe("r0")
        limits = {"forward": description.max_forward, "turn": description.max_turn}
        for field, limit in limits.items():
            command = Command(**{field: sign * 10 * limit})
            for _ in range(25):
                seen = simulation.step({"r0": command})["r0"]
            assert getattr(seen.odometry, field) / description.tick == pytest.approx(sign * limit, rel=0.02)


def test_a_collision_counts_once_however_long_it_lasts(walled: World):
    """Pushing, and being carried away, end no differently than backing off."""
    with Simulation(walled, ["r0"], 4, [Pose2(0.5, 0.0, 0.2)]) as simulation:

        def drive(forward: float, ticks: int) -> bool:
            return [simulation.step({"r0": Command(forward)})["r0"].bumped for _ in range(ticks)][-1]

        assert not drive(0.2, 5)
        assert simulation.collisions("r0") == 0
        pushing = [drive(0.3, 1) for _ in range(60)]
        assert any(pushing)
        assert simulation.collisions("r0") == 1
        assert not drive(-0.3, 15)
        assert simulation.collisions("r0") == 1
        drive(0.3, 40)
        assert simulation.collisions("r0") == 2
        simulation.kidnap("r0", Pose2(-1.0, 0.0, 0.0))
        assert not simulation.observe("r0").bumped
        assert not drive(0.0, 3)
        assert simulation.collisions("r0") == 2


def test_robot_stays_level(bare: World):
    """The camera must not nod: under 0.15 degree while starting, stopping and turning, at full speed."""
    with Simulation(bare, ["r0"], 5, [Pose2()]) as simulation:
        body = simulation._robots["r0"].body
        worst = 0.0
        for command in [Command(0.3), Command(-0.3), Command(0.0, 0.8), Command(0.3, -0.8), Command()]:
            for _ in range(15):
                simulation.advance({"r0": command})
                position, rotation = body.position_and_rotation()
                worst = max(worst, math.acos(min(1.0, rotation[2, 2])))
                assert abs(position[2]) < 1e-3
        assert math.degrees(worst) < 0.15


def slab_distance(world: World, x: float, y: float, angle: float) -> float:
    """Way of a ray to the first rectangle of the plan, by the slab method."""
    nearest = math.inf
    for box in (*world.plan.walls, *world.plan.furniture):
        c, s = math.cos(box.heading), math.sin(box.heading)
        start = (c * (x - box.x) + s * (y - box.y), -s * (x - box.x) + c * (y - box.y))
        step = (math.cos(angle - box.heading), math.sin(angle - box.heading))
        enter, leave = 0.0, math.inf
        for at, by, half in zip(start, step, (box.length / 2, box.width / 2), strict=True):
            if abs(by) < 1e-12:
                enter = enter if abs(at) <= half else math.inf
                continue
            a, b = sorted(((-half - at) / by, (half - at) / by))
            enter, leave = max(enter, a), min(leave, b)
        if enter <= leave:
            nearest = min(nearest, enter)
    return nearest


def test_ranges_are_those_of_the_floor_plan(office: World):
    """At random places, with the noise that they should have and no bias."""
    rng = np.random.default_rng(0)
    errors = []
    with Simulation(office, ["r0"], 6) as simulation:
        description = simulation.describe("r0")
        for _ in range(40):
            simulation.kidnap("r0", office.plan.random_free_pose(rng, 0.3))
            pose = simulation.truth("r0")
            ranges = simulation.observe("r0").proximity
            for bearing, seen in zip(description.ranger_bearings, ranges, strict=True):
                way = slab_distance(office, pose.x, pose.y, pose.heading + bearing) - description.radius
                if way >= description.ranger_reach:
                    assert seen == description.ranger_reach
                elif way < 0.95 * description.ranger_reach:
                    assert abs(seen - way) < 5 * RANGE_NOISE * way + 0.002
                    errors.append((seen - way) / way)
    assert len(errors) > 300
    assert np.std(errors) == pytest.approx(RANGE_NOISE, rel=0.25)
    assert abs(np.mean(errors)) < 4 * RANGE_NOISE / math.sqrt(len(errors))


def test_robots_see_and_sense_each_other(bare: World):
    """At once, also one that was just put there."""
    with Simulation(bare, ["r0", "r1"], 7, [Pose2(), Pose2(5.0, 0.0, 0.0)]) as simulation:
        alone = simulation.observe("r0")
        assert alone.proximity.min() == simulation.describe("r0").ranger_reach
        simulation.kidnap("r1", Pose2(1.0, 0.0, 2.0))
        met = simulation.observe("r0")
        assert met.proximity[0] == pytest.approx(1.0 - 2 * 0.16, rel=0.05)
        assert np.abs(met.image.astype(float) - alone.image).max() > 60


def test_truth_is_kept_by_tick(bare: World):
    """One pose a tick; times and names that do not exist are refused."""
    with Simulation(bare, ["r0"], 8, [Pose2(1.0, 2.0, 0.5)]) as simulation:
        for _ in range(6):
            simulation.advance({"r0": Command(0.3)})
        stamps, poses = simulation.trajectory("r0")
        assert stamps.tolist() == [k * 100_000_000 for k in range(7)]
        assert simulation.truth_at("r0", 0).distance(Pose2(1.0, 2.0)) < 1e-9
        assert simulation.truth_at("r0", int(stamps[-1])) == simulation.truth("r0")
        assert poses[-1].tolist() == simulation.truth("r0").vector.tolist()
        for stamp_ns in (-1, 700_000_000):
            with pytest.raises(InvalidValue, match="not between"):
                simulation.truth_at("r0", stamp_ns)
        with pytest.raises(InvalidValue, match="no robot"):
            simulation.advance({"r9": Command()})
    simulation.close()


def test_robots_of_the_same_name_are_refused(bare: World):
    """One line that says so."""
    with pytest.raises(InvalidValue, match="same name"):
        Simulation(bare, ["r0", "r0"], 1)


def test_robots_differ_in_rangers_and_cameras(bare: World):
    """Each senses with its own: also one without rangers, and pictures of another size."""
    small = camera_from_table({"intrinsics": {"width": 160, "height": 120, "cx": 79.5, "cy": 59.5}})
    robots = [RobotSetup("a", rangers=0), RobotSetup("b", rangers=5, camera=small), "c"]
    with Simulation(bare, robots, 1, [Pose2(), Pose2(1.0, 0.0, 3.14), Pose2(0.0, 9.0)]) as simulation:
        seen = simulation.step({})
        assert [len(seen[name].proximity) for name in "abc"] == [0, 5, 16]
        assert [seen[name].image.shape for name in "abc"] == [(240, 320), (120, 160), (240, 320)]
        assert seen["b"].proximity[0] == pytest.approx(1.0 - 2 * 0.16, rel=0.06)
        assert simulation.describe("b").camera == small.intrinsics
