"""Sensors that fail say what was ordered, for as long as was ordered, and nothing else changes."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave import Command, Odometry, Pose2
from mapweave.sim.events import Fail
from mapweave.sim.faults import SensorFaults, describe
from mapweave.sim.simulation import Simulation
from mapweave.sim.world import World

AXLE = 0.24


def drive(office: World, fault: Fail | None, ticks: int = 12) -> list:
    """What a robot senses on a gentle drive, with a fault from the third tick on."""
    seen = []
    with Simulation(office, ["r0"], 3) as simulation:
        for tick in range(ticks):
            if tick == 3 and fault:
                simulation.apply(fault)
            seen.append(simulation.step({"r0": Command(0.05, 0.4)})["r0"])
    return seen


@pytest.fixture(scope="module")
def healthy(office: World) -> list:
    """The same drive with nothing broken."""
    return drive(office, None)


def test_cameras_drop_freeze_and_are_covered(office: World, healthy: list):
    """Ticks 3 to 7 of twelve; before and after all is as ever."""
    dropped = drive(office, Fail("r0", "camera", "drop", 0.5))
    assert [s.image is None for s in dropped] == [False] * 3 + [True] * 5 + [False] * 4
    frozen = drive(office, Fail("r0", "camera", "freeze", 0.5))
    for tick in range(12):
        assert np.array_equal(frozen[tick].image, frozen[2].image) == (2 <= tick < 8)
    covered = drive(office, Fail("r0", "camera", "blocked", 0.5))
    for tick, one in enumerate(covered):
        assert (one.image.mean() < 15) == (3 <= tick < 8)
    for faulty in (dropped, frozen, covered):
        for a, b in zip(faulty, healthy, strict=True):
            assert a.odometry == b.odometry
            assert a.proximity.tolist() == b.proximity.tolist()


def wheels(odometry: Odometry) -> tuple[float, float]:
    """Ways of left and right wheel, m."""
    return odometry.forward - odometry.turn * AXLE / 2, odometry.forward + odometry.turn * AXLE / 2


def test_encoders_fail_wheel_by_wheel(office: World, healthy: list):
    """Zero, one wheel zero, a share too much, one jump."""
    ways = {
        "zero": lambda left, right: (0.0, 0.0),
        "zero_left": lambda left, right: (0.0, right),
        "zero_right": lambda left, right: (left, 0.0),
        "scale": lambda left, right: (1.1 * left, 1.1 * right),
    }
    for how, expected in ways.items():
        for tick, (a, b) in enumerate(
            zip(drive(office, Fail("r0", "encoders", how, 0.5)), healthy, strict=True)
        ):
            wanted = expected(*wheels(b.odometry)) if 3 <= tick < 8 else wheels(b.odometry)
            assert wheels(a.odometry) == pytest.approx(wanted, abs=1e-12)
    jumped = drive(office, Fail("r0", "encoders", "spike", 0.5, amount=-0.2))
    extra = [a.odometry.forward - b.odometry.forward for a, b in zip(jumped, healthy, strict=True)]
    assert extra == pytest.approx([0.0] * 3 + [-0.2] + [0.0] * 8, abs=1e-12)


@given(
    st.floats(-1, 1), st.floats(-1, 1),
    st.sets(st.sampled_from(["zero", "zero_left", "zero_right", "scale"]), min_size=0),
)  # fmt: skip
def test_encoder_faults_in_any_combination(forward: float, turn: float, hows: set[str]):
    """Against the wheels taken one by one."""
    faults = SensorFaults(AXLE, (1,))
    for how in sorted(hows):
        faults.begin(Fail("r0", "encoders", how), 0, 5)
    left, right = wheels(Odometry(forward, turn))
    scale = 1.1 if "scale" in hows else 1.0
    left = 0.0 if hows & {"zero", "zero_left"} else scale * left
    right = 0.0 if hows & {"zero", "zero_right"} else scale * right
    assert wheels(faults.odometry(Odometry(forward, turn), 3)) == pytest.approx((left, right), abs=1e-9)
    assert faults.odometry(Odometry(forward, turn), 6) == Odometry(forward, turn)


def test_rangers_spike_and_drop_out(office: World, healthy: list):
    """All at their maximum; or about the ordered share short, the others right."""
    for tick, one in enumerate(drive(office, Fail("r0", "rangers", "drop", 0.5))):
        assert (one.proximity == 3.0).all() == (3 <= tick < 8)
    spiked = drive(office, Fail("r0", "rangers", "spike", 0.5, amount=0.4))
    changed = [a.proximity != b.proximity for a, b in zip(spiked, healthy, strict=True)]
    assert not any(changed[k].any() for k in (0, 1, 2, 8, 9, 10, 11))
    wrong = np.array(changed[3:8])
    # 80 readings: within three standard deviations.
    assert wrong.mean() == pytest.approx(0.4, abs=3 * math.sqrt(0.24 / 80))
    for a, b in zip(spiked[3:8], healthy[3:8], strict=True):
        assert (a.proximity <= b.proximity).all()
        assert (a.proximity >= 0.0).all()


def test_bumpers_stick_and_die(walled: World):
    """Pressed without a wall, not pressed at one; collisions are counted as they are."""
    with Simulation(walled, ["r0"], 4, [Pose2(0.5, 0.0, 0.0)]) as simulation:
        simulation.apply(Fail("r0", "bumper", "stuck", 0.3))
        assert [simulation.step({})["r0"].bumped for _ in range(5)] == [True] * 3 + [False] * 2
        simulation.apply(Fail("r0", "bumper", "dead", 4.0))
        assert not any(simulation.step({"r0": Command(0.3)})["r0"].bumped for _ in range(40))
        assert simulation.collisions("r0") == 1
        assert any(simulation.step({"r0": Command(0.3)})["r0"].bumped for _ in range(10))


def test_faults_are_described():
    assert describe(Fail("r0", "camera", "drop", 3.0)) == "the camera of r0 fails (drop) for 3 s"
    assert describe(Fail("r0", "encoders", "spike")) == "the encoders of r0 jump by 0.3 m"
    assert describe(Fail("r1", "rangers", "spike", 2.0)) == "the rangers of r1 fail (spike, 0.1) for 2 s"
