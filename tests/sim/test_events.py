"""What happens to a world: parsed, done once, seen by everything that should see it, and repeatable."""

import hashlib
import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave import Command, Pose2
from mapweave.hybridmap.errors import InvalidValue, MapweaveError
from mapweave.sim.events import KINDS, Fail, Kidnap, Light, MoveFurniture, Walk, parse_event
from mapweave.sim.robots import RobotSetup
from mapweave.sim.simulation import Simulation
from mapweave.sim.world import World


def test_tables_become_events():
    assert parse_event({"do": "kidnap", "robot": "r0", "x": 1, "y": 2.0}) == Kidnap("r0", 1.0, 2.0)
    assert parse_event({"do": "light", "factor": 0.3, "seconds": 2}) == Light(0.3, 2.0)
    walk = parse_event({"do": "walk", "path": [[0, 0], [1, 2]], "speed": 1})
    assert walk == Walk(path=((0.0, 0.0), (1.0, 2.0)), speed=1.0)
    assert parse_event({"do": "move_furniture", "share": 0.5}) == MoveFurniture(0.5)
    fail = parse_event({"do": "fail", "robot": "r0", "sensor": "encoders", "how": "scale"})
    assert isinstance(fail, Fail)
    assert fail.size == 0.1


@pytest.mark.parametrize(("table", "says"), [
    ({"do": "explode"}, "known are kidnap, light, walk, move_furniture, fail"),
    ({}, "known are kidnap"),
    ({"do": "kidnap", "robot": "r0"}, "say where"),
    ({"do": "kidnap", "robot": "r0", "x": 1.0}, "say where"),
    ({"do": "kidnap", "robot": "r0", "x": 1.0, "y": 1.0, "room": "room 1"}, "say where"),
    ({"do": "kidnap", "x": 1.0, "y": 1.0}, "robot is missing"),
    ({"do": "light", "factor": -1}, "factor must be a number, 0 to 20; it is -1"),
    ({"do": "walk"}, "say where"),
    ({"do": "walk", "near": "r0", "what": "dog"}, "known are person, box"),
    ({"do": "walk", "path": [[0, 0]]}, "2 to 1000"),
    ({"do": "fail", "robot": "r0", "sensor": "nose", "how": "drop"}, "there are camera, encoders"),
    ({"do": "fail", "robot": "r0", "sensor": "camera", "how": "spike"}, "known are drop, blocked, freeze"),
    ({"do": "fail", "robot": "r0", "sensor": "camera", "how": "drop", "second": 1}, "did you mean 'seconds'"),
    ({"do": "fail", "robot": "r0", "sensor": "rangers", "how": "spike", "amount": 3}, "amount is 3"),
])  # fmt: skip
def test_wrong_tables_are_reported_with_a_reason(table: dict[str, object], says: str):
    with pytest.raises(MapweaveError, match=says) as caught:
        parse_event(table)
    assert "\n" not in str(caught.value)


@given(
    st.dictionaries(
        st.sampled_from(
            ["do", "robot", "x", "y", "path", "near", "factor", "seconds", "sensor", "how", "share"]
        ),
        st.one_of(
            st.sampled_from([*KINDS, "camera", "drop"]),
            st.integers(),
            st.floats(),
            st.none(),
            st.lists(st.lists(st.floats(), max_size=3), max_size=3),
        ),
    )
)
def test_no_table_crashes(table: dict[str, object]):
    """Nonsense is an event or one of our errors."""
    try:
        parse_event(table)
    except MapweaveError as error:
        assert "\n" not in str(error)


def test_unknown_robots_rooms_and_places_are_refused(office: World):
    """By name, before anything changes."""
    wall = office.plan.walls[0]
    wrong = [
        (Kidnap("r9", 1.0, 1.0), "no robot 'r9'; there are r0"),
        (Kidnap("r0", near="r9"), "no robot 'r9'"),
        (Kidnap("r0", near="r0"), "near itself"),
        (Kidnap("r0", room="cellar"), "no room 'cellar'"),
        (Kidnap("r0", wall.x, wall.y), "no free place"),
        (Kidnap("r0", 500.0, 0.0), "no free place"),
        (Walk(near="r9"), "no robot 'r9'"),
        (Walk(path=((0.5, 0.9), (0.5, 60.0))), "wall or furniture"),
        (Fail("r9", "camera", "drop"), "no robot 'r9'"),
    ]
    with Simulation(office, ["r0"], 1) as simulation:
        before = simulation.truth("r0")
        for event, says in wrong:
            with pytest.raises(InvalidValue, match=says):
                simulation.apply(event)
        assert simulation.truth("r0") == before
        assert simulation.snapshot().actors == ()


def test_kidnapped_robots_are_put_on_free_floor_away_from_others(office: World):
    """Anywhere, also where another robot is already."""
    with Simulation(office, ["r0", "r1"], 2) as simulation:
        room = office.plan.room("room 2")
        other = simulation.truth("r1")
        orders = [
            Kidnap("r0", room="room 2"), Kidnap("r0", near="r1", heading=1.0),
            Kidnap("r0", other.x, other.y), Kidnap("r0", near="r1"),
        ]  # fmt: skip
        for event in orders:
            line = simulation.apply(event)
            pose = simulation.truth("r0")
            assert line == f"r0 is put down at ({pose.x:.2f}, {pose.y:.2f})"
            assert office.plan.is_free(pose.x, pose.y, 0.17)
            assert pose.distance(other) > 0.4
            if event.room:
                assert abs(pose.x - room.x) < room.length / 2
                assert abs(pose.y - room.y) < room.width / 2
            if event.near or event.x is not None:
                assert pose.distance(other) < 2.0
            if event.heading is not None:
                assert pose.heading == pytest.approx(1.0, abs=1e-6)
            simulation.step({})
            assert simulation.truth("r0").distance(pose) < 0.01
        assert simulation.collisions("r0") == simulation.collisions("r1") == 0


def test_light_goes_down_over_its_time(office: World):
    """Pictures darken step by step by the factor; the automatic then brings them back."""
    with Simulation(office, ["r0"], 3) as simulation:
        base = simulation.step({})["r0"].image.mean()
        assert "0.5" in simulation.apply(Light(0.5, 1.0))
        means = [simulation.step({})["r0"].image.mean() / base for _ in range(10)]
        # The automatic of the standard robot does nothing yet while the mean is in its band.
        expected = 1.0 - 0.05 * np.arange(1, 11)
        in_band = expected * base > 130.0 * math.exp(-0.5)
        assert np.abs(np.array(means) - expected)[in_band].max() < 0.02
        assert in_band.sum() >= 2
        simulation.apply(Light(0.1, 0.0))
        dark = simulation.step({})["r0"].image.mean()
        assert dark < 0.3 * base
        for _ in range(30):
            simulation.advance({})
            adapted = simulation.observe("r0").image.mean()
        assert adapted > 2.0 * dark


def test_moved_furniture_is_felt_and_seen_where_the_plan_has_it(office: World):
    """Against a fresh simulation of the new world: the same ranges and the same pictures."""
    quiet = RobotSetup("r0", range_noise=0.0)
    with Simulation(office, [quiet], 4) as simulation:
        simulation.step({})
        place = simulation.truth("r0")
        line = simulation.apply(MoveFurniture(0.6))
        world = simulation.world
        pairs = zip(office.plan.furniture, world.plan.furniture, strict=True)
        moved = [k for k, (a, b) in enumerate(pairs) if a != b]
        assert line.startswith(f"{len(moved)} of {len(office.plan.furniture)} ")
        assert moved
        assert simulation.snapshot().furniture == world.plan.furniture
        assert world.plan.is_free(place.x, place.y, 0.3)
        with Simulation(world, [quiet], 4) as fresh:
            for room in [r.name for r in world.plan.rooms if r.name.startswith("room")]:
                pose = world.plan.random_free_pose(np.random.default_rng(3), 0.4, room)
                seen = []
                for item in (simulation, fresh):
                    item.kidnap("r0", pose)
                    seen.append(item.observe("r0"))
                assert seen[0].proximity == pytest.approx(seen[1].proximity, abs=1e-6)
                # The two have other noise by now.
                assert np.abs(seen[0].image.astype(int) - seen[1].image).mean() < 3.0


def run(seed: int, office: World, threads: int) -> str:
    """Digest of an eventful run."""
    digest = hashlib.sha256()
    robots = [RobotSetup("a"), RobotSetup("b"), RobotSetup("c")]
    events = {
        2: Walk(near="a"), 4: Fail("b", "rangers", "spike"), 6: MoveFurniture(0.3), 8: Kidnap("c", near="a"),
        9: Light(0.4, 0.5), 10: Walk("box", near="b"), 12: Fail("a", "camera", "freeze", 0.5),
    }  # fmt: skip
    with Simulation(office, robots, seed) as simulation, ThreadPoolExecutor(threads) as pool:
        for tick in range(18):
            if tick in events:
                digest.update(simulation.apply(events[tick]).encode())
            simulation.advance(dict.fromkeys(simulation.robots, Command(0.2, 0.3)))
            for seen in pool.map(simulation.observe, simulation.robots):
                digest.update(seen.proximity.tobytes() + seen.image.tobytes())
                digest.update(repr((seen.odometry, seen.bumped)).encode())
            shot = simulation.snapshot()
            digest.update(repr((shot.actors, shot.furniture, sorted(shot.robots.items()))).encode())
    return digest.hexdigest()


def test_events_are_repeatable_and_images_may_be_concurrent(office: World):
    """The same bits from one thread and from three; others for another seed."""
    first = run(5, office, 1)
    assert run(5, office, 3) == first
    assert run(6, office, 3) != first


def test_one_robots_faults_leave_the_others_alone(office: World):
    """A robot that drops frames does not change another's noise."""
    pictures = []
    for fault in (None, Fail("r0", "camera", "drop", 1.0)):
        with Simulation(office, ["r0", "r1"], 7) as simulation:
            if fault:
                simulation.apply(fault)
            pictures.append([simulation.step({})["r1"].image for _ in range(4)])
    np.testing.assert_array_equal(*pictures)


def test_snapshots_show_the_last_pictures(office: World):
    """No new ones; none before the first, and none where the camera gave none."""
    with Simulation(office, ["r0", "r1"], 8) as simulation:
        assert simulation.snapshot().images == {"r0": None, "r1": None}
        simulation.advance({})
        image = simulation.observe("r0").image
        shot = simulation.snapshot()
        assert shot.images["r0"] is image
        assert shot.images["r1"] is None
        assert (shot.tick, shot.stamp_ns) == (1, 100_000_000)
        assert shot.robots["r1"] == simulation.truth("r1")
        simulation.apply(Fail("r0", "camera", "drop", 1.0))
        simulation.step({})
        assert simulation.snapshot().images["r0"] is None


def test_places_that_setups_ask_for(office: World):
    """Robots start there; others elsewhere; where one cannot stand is refused."""
    place = office.start_poses(1, 9)[0]
    here = RobotSetup("a", start=(place.x, place.y, 0.7))
    with Simulation(office, ["b", here, "c"], 9) as simulation:
        assert simulation.truth("a").distance(Pose2(place.x, place.y)) < 1e-9
        poses = [simulation.truth(name) for name in simulation.robots]
        assert min(p.distance(q) for k, p in enumerate(poses) for q in poses[:k]) > 0.4
    with pytest.raises(InvalidValue, match="taken"):
        Simulation(office, [here, RobotSetup("b", start=(place.x + 0.1, place.y, 0.0))], 9)
    with pytest.raises(InvalidValue, match="no free place"):
        Simulation(office, [RobotSetup("b", start=(-50.0, 0.0, 0.0))], 9)
