"""Each monitor by itself: what it calls a fault, when, and what it does not."""

import math

import numpy as np
import pytest

from mapweave import Camera, Command, Observation, Odometry, Pose2, RobotDescription
from mapweave.agent.ranger_monitor import RangerMonitor
from mapweave.agent.sensor_health.clock_monitor import ClockMonitor
from mapweave.agent.sensor_health.encoder_monitor import EncoderMonitor
from mapweave.agent.sensor_health.sensor_monitor import CameraMonitor

TICK = 0.1
STANDS, DRIVES = Odometry(0.0, 0.0), Odometry(0.02, 0.0)
NOISE = np.random.default_rng(0)
BODY = RobotDescription(Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.3))
HALF = BODY.axle / 2


def noisy(grey: float, sigma: float = 2.0) -> np.ndarray:
    """An image of one grey level, as a camera sees it."""
    return np.clip(NOISE.normal(grey, sigma, (240, 320)), 0, 255).astype(np.uint8)


def textured(seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).integers(30, 220, (240, 320)).astype(np.uint8)


# Camera


def faults(images, odometry) -> list[str]:
    monitor, out = CameraMonitor(TICK), []
    for image in images:
        monitor.see(image, odometry)
        out.append(monitor.fault)
    return out


def test_a_frozen_camera_is_one_while_the_wheels_move():
    image = textured()
    assert not any(faults([image] * 100, STANDS)), "a robot that stands may see the same to the last bit"
    moving = faults([image] * 12, DRIVES)
    first = next(k for k, fault in enumerate(moving) if fault)
    assert "frozen" in moving[-1] and first * TICK <= 1.0
    monitor = CameraMonitor(TICK)
    for one in [image] * 12:
        monitor.see(one, DRIVES)
    monitor.see(image, STANDS)
    assert monitor.fault, "standing still does not mend it"
    monitor.see(textured(2), STANDS)
    assert not monitor.fault and not monitor.frozen


@pytest.mark.parametrize(("grey", "words"), [(3.0, "black"), (255.0, "white")])
def test_a_black_and_a_white_image_are_faults(grey, words):
    seen = faults([textured(), *(noisy(grey) for _ in range(10)), textured(2)], DRIVES)
    first = next(k for k, fault in enumerate(seen) if fault)
    assert words in seen[first] and 1 < first * TICK * 10 <= 10 and not seen[-1]


@pytest.mark.parametrize("image", [
    noisy(235.0), noisy(128.0), noisy(40.0), np.full((240, 320), 128, np.uint8), noisy(12.0, 6.0),
], ids=["white wall", "grey wall", "dark wall", "drawn wall", "dim room"])  # fmt: skip
def test_a_wall_and_a_dim_room_are_no_dead_camera(image):
    assert not any(faults([image.copy() if k % 2 else image + (k % 3) for k in range(40)], DRIVES))
    assert image.min() < image.max() or not any(faults([image] * 40, DRIVES))


def test_no_image_is_a_fault_and_three_dropped_ones_are_not():
    good = [textured(k) for k in range(3)]
    assert not any(faults([good[0], None, None, None, good[1], None, good[2]], DRIVES))
    seen = faults([good[0], *[None] * 10, good[1]], DRIVES)
    first = next(k for k, fault in enumerate(seen) if fault)
    assert "gives no image" in seen[first] and first * TICK <= 1.0 and not seen[-1]


# Clock


def stamped(steps: list[float]) -> list[str]:
    monitor, now, out = ClockMonitor(TICK), 1_000_000_000_000, []
    for step in steps:
        now += round(step * 1e9)
        monitor.see(now)
        out.append(monitor.fault)
    return out


@pytest.mark.parametrize(("bad", "within", "words"), [
    ([0.0] * 10, 7, "stands still"),
    ([-3600.0], 1, "jumped back by 3600.0 s"),
    ([3600.0], 1, "jumped ahead by 3600.0 s"),
    ([-0.1] * 3, 1, "jumped back"),
])  # fmt: skip
def test_a_clock_that_fails_is_named_and_believed_again_after_a_second(bad, within, words):
    before, after = [TICK] * 5, [TICK] * 12
    said = stamped([*before, *bad, *after])
    assert not any(said[:5]) and words in said[4 + within]
    assert said[-5] and not said[-1]


def test_late_and_early_images_are_no_fault():
    assert not any(stamped([TICK, 0.3, 0.02, 0.0, 0.0, 0.2, 2.0, TICK, 9.0, TICK]))


# Rangers

BEARINGS = tuple(np.linspace(0.0, math.tau, 8, endpoint=False).tolist())
AHEAD = np.array([1.0, *[3.0] * 7])
ASIDE = np.array([3.0, 3.0, 0.5, 3.0, 3.0, 3.0, 0.5, 3.0])


@pytest.mark.parametrize(("readings", "odometry", "frozen"), [
    (AHEAD, DRIVES, True),
    (AHEAD, Odometry(-0.02, 0.0), False),
    (ASIDE, DRIVES, False),
    (ASIDE, Odometry(0.0, 0.05), True),
    (np.full(8, 3.0), Odometry(0.02, 0.05), False),
    (AHEAD, STANDS, False),
], ids=["toward", "away from", "along a corridor", "turning", "open floor", "standing"])  # fmt: skip
def test_readings_that_stay_though_they_cannot_are_frozen(readings, odometry, frozen):
    monitor = RangerMonitor(RobotDescription(BODY.camera, ranger_bearings=BEARINGS, ranger_reach=3.0))
    for _ in range(20):
        monitor.see(readings.copy(), odometry)
    assert bool(monitor.fault) == frozen == monitor.frozen
    monitor.see(readings - 0.01, odometry)
    assert not monitor.fault


# Encoders

COMMANDS = [*[Command(0.2, 0.0)] * 12, *[Command(0.0, 0.4)] * 14, *[Command(0.0, -0.4)] * 14]


@pytest.fixture(scope="module")
def drive(walls) -> list[np.ndarray]:
    """Images of a robot that obeys `COMMANDS`."""
    pose, images = Pose2(0.3, 0.3, -0.1), []
    for command in COMMANDS:
        pose = pose @ Odometry(command.forward * TICK, command.turn * TICK).motion()
        noise = NOISE.normal(0.0, 1.5, (240, 320))
        images.append(np.clip(walls.render(pose) + noise, 0, 255).astype(np.uint8))
    return images


def standing(drive) -> list[np.ndarray]:
    """The first image of a drive again and again, with the noise of a camera."""
    return [np.clip(drive[0] + NOISE.normal(0, 1.5, (240, 320)), 0, 255).astype(np.uint8) for _ in drive]


def first_fault(images, wheels, commands=COMMANDS) -> tuple[float, str]:
    """When the encoders fail, s, and the words; wheels (2,) m of what they truly did."""
    monitor = EncoderMonitor(BODY)
    for tick, (image, command, true) in enumerate(zip(images, commands, COMMANDS, strict=True)):
        ways = np.array([true.forward - HALF * true.turn, true.forward + HALF * true.turn]) * TICK
        left, right = wheels(ways, tick)
        odometry = Odometry((left + right) / 2, (right - left) / BODY.axle)
        monitor.see(Observation(tick * 100_000_000, odometry, image), command)
        if monitor.fault:
            return tick * TICK, monitor.fault
    return math.inf, ""


@pytest.mark.parametrize(("wheels", "words"), [
    (lambda ways, tick: 0.0 * ways, "the encoders do not count while the image moves"),
    (lambda ways, tick: ways * [0.0, 1.0], "the left encoder does not count"),
    (lambda ways, tick: ways * [1.0, 0.0], "the right encoder does not count"),
    (lambda ways, tick: ways + np.array([0.0, 0.03]), "one of them runs away"),
    (lambda ways, tick: ways + np.array([0.5 * (tick == 5), 0.0]), "the encoders jump by 0.52 m"),
], ids=["dead", "left dead", "right dead", "right runs away", "jump"])  # fmt: skip
def test_encoders_that_fail_are_named_within_a_second_and_a_half(drive, wheels, words):
    when, said = first_fault(drive, wheels)
    assert words in said and when <= 1.5


def test_encoders_that_count_before_a_standing_image_run_away_or_the_wheels_spin(drive):
    when, said = first_fault(standing(drive), lambda ways, tick: ways)
    assert "or the wheels spin" in said and when <= 1.5


@pytest.mark.parametrize("case", ["healthy", "slow to start", "pushed", "stuck", "bare wall", "scale"])
def test_no_false_alarm(drive, case):
    images, commands, wheels = drive, COMMANDS, lambda ways, tick: ways
    if case == "slow to start":
        commands = [*COMMANDS[2:], Command(), Command()]
    elif case == "pushed":
        commands = [Command()] * len(COMMANDS)
    elif case == "stuck":
        images = standing(drive)
        wheels = lambda ways, tick: 0.0 * ways  # noqa: E731
    elif case == "bare wall":
        images = [noisy(200.0) for _ in drive]
    elif case == "scale":
        wheels = lambda ways, tick: 1.15 * ways  # noqa: E731
    assert first_fault(images, wheels, commands)[1] == ""


def test_motors_that_go_the_other_way_than_commanded_are_named(drive, walls):
    """Encoders and image agree on it: before, the robot drove on against each of its commands."""
    reversed_commands = [Command(-command.forward, -command.turn) for command in COMMANDS]
    when, said = first_fault(drive, lambda ways, tick: ways, reversed_commands)
    assert "exchange the sign of both motors" in said and when <= 1.5
    for sign, words in ((-1.0, "exchange left and right motor"), (1.0, "")):
        monitor, pose = EncoderMonitor(BODY), Pose2(0.3, 0.3, -0.4)
        for tick in range(15):
            moved = Odometry(0.0, 0.06)
            pose = pose @ moved.motion()
            monitor.see(Observation(tick * 100_000_000, moved, walls.render(pose)), Command(0.0, sign * 0.6))
        assert words in monitor.fault and bool(monitor.fault) is bool(words)


def test_encoders_are_believed_again_once_they_count_what_was_commanded(drive):
    monitor = EncoderMonitor(BODY)
    monitor.see(Observation(0, Odometry(1.0, 0.0), drive[0]), Command(0.2))
    assert monitor.fault
    for tick, (image, command) in enumerate(zip(drive[12:], COMMANDS[12:], strict=True), 1):
        counted = Odometry(0.0, command.turn * TICK if tick > 14 else 0.0)
        monitor.see(Observation(tick * 100_000_000, counted, image), command)
        if tick <= 14:
            assert monitor.fault, "they do not count yet"
    assert not monitor.fault
