"""Parking at a place known by bearings, on an exact unicycle with pixel noise."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from agent.observation import RobotDescription
from agent.servo.appearance import AppearanceServo
from agent.servo.step import ServoStep
from hybridmap.camera import Camera
from hybridmap.pose import Pose2, PoseGaussian, wrap_angle

NOTHING = np.zeros((0, 2))


def park(scene: Any, seconds: float = 60.0) -> tuple[list[ServoStep], int, PoseGaussian]:
    """Drive until the servo says something final; returns its steps, the fewest landmarks in view,
    and where the robot believes to be.
    """
    guesses, servo = scene.guesses(), AppearanceServo(scene.robot)
    tick, steps, least = scene.robot.tick, [], 99
    ids, _ = scene.look()
    servo.start(guesses.trail.pose, guesses.trail.points())
    for _ in range(round(seconds / tick)):
        visible = np.zeros(len(scene.points), np.bool_)
        visible[ids] = True
        trail = guesses.trail
        steps.append(servo.command(trail.pose, trail.points(), visible, NOTHING))
        if steps[-1].state in ("arrived", "stuck"):
            break
        guesses.move(scene.drive(steps[-1].command.forward * tick, steps[-1].command.turn * tick))
        ids, pixels = scene.look()
        least = min(least, len(ids))
        guesses.see(ids, pixels)
    return steps, least, guesses.trail.pose


@pytest.mark.parametrize("seed", range(5))
def test_it_parks_with_the_landmarks_in_view(scene_of: Callable[..., Any], seed: int) -> None:
    plain = seed % 2 == 0
    scene = scene_of(seed, count=40, plain=plain)
    steps, least, _ = park(scene)
    assert steps[-1].state == "arrived"
    assert math.hypot(scene.pose.x, scene.pose.y) < 0.015
    assert abs(wrap_angle(scene.pose.heading)) < math.radians(1.0)
    assert least >= 4
    limits = scene.robot
    assert max(abs(step.command.forward) for step in steps) <= limits.max_forward + 1e-9
    assert max(abs(step.command.turn) for step in steps) <= limits.max_turn + 1e-9
    # Until the wheels have told how far it is, it is careful. A camera ahead of the axle tells it by a turn.
    assert any("slowly" in step.reason for step in steps) or not plain
    assert "slowly" not in steps[-10].reason


def test_at_a_far_scene_it_says_how_little_bearings_tell(scene_of: Callable[..., Any]) -> None:
    """From 60 m away half a metre is a few pixels; it stops where it can tell no more, and says so."""
    scene = scene_of(1, count=40, depth=(50.0, 80.0), plain=True)
    scene.pose = Pose2(-0.3, 0.1, 0.3)
    steps, least, believed = park(scene)
    assert steps[-1].state == "arrived"
    assert "as far as bearings tell" in steps[-1].reason
    assert believed.mahalanobis2(scene.pose) < 16.0
    assert abs(scene.pose.heading) < math.radians(2.0)
    assert least >= 4


def test_after_a_pure_turn_it_turns_back(scene_of: Callable[..., Any]) -> None:
    scene = scene_of(2, count=40)
    scene.pose = Pose2(0.0, 0.0, 0.3)
    steps, _, _ = park(scene)
    assert steps[-1].state == "arrived"
    assert math.hypot(scene.pose.x, scene.pose.y) < 0.03
    assert abs(scene.pose.heading) < math.radians(1.5)


def test_it_gives_up_with_a_reason_when_nothing_is_seen() -> None:
    servo = AppearanceServo(RobotDescription(Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.25)))
    posture = PoseGaussian.from_sigmas(Pose2(-1.0, 0.2, 0.1), 0.1, 0.05)
    points = np.column_stack([np.full(8, 3.0), np.linspace(-1, 1, 8), np.full(8, 0.3)])
    servo.start(posture, points)
    nothing = np.zeros(8, np.bool_)
    steps = [servo.command(posture, points, nothing, NOTHING) for _ in range(15)]
    assert steps[-1].state == "stuck"
    assert "fewer than 4" in steps[-1].reason
    assert steps[-1].command.forward == steps[-1].command.turn == 0.0


def test_a_way_that_was_drawn_from_a_wrong_place_is_drawn_anew() -> None:
    """At first the robot thinks itself 40 cm aside; then it knows better, and parks without to and fro."""
    rng = np.random.default_rng(0)
    camera = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.25)
    robot = RobotDescription(camera)
    depths, slopes = rng.uniform(1.5, 5.0, 40), rng.uniform(-0.5, 0.5, 40)
    points = np.column_stack([depths, slopes * depths, 0.25 + rng.uniform(-0.3, 0.3, 40) * depths])
    pose, wrong = Pose2(-1.4, 1.0, 0.2), Pose2(0.2, -0.4, 0.1)
    servo = AppearanceServo(robot)
    servo.start(PoseGaussian.from_sigmas(wrong @ pose, 0.3, 0.1), wrong.apply(points))
    for tick in range(300):
        visible = camera.contains(camera.project(pose.inverse().apply(points)))
        if tick < 20:
            # As bearings have it: robot and landmarks are moved alike, and at the goal they are not.
            believed, where = PoseGaussian.from_sigmas(wrong @ pose, 0.3, 0.1), wrong.apply(points)
        else:
            believed, where = PoseGaussian.from_sigmas(pose, 0.01, 0.005), points
        step = servo.command(believed, where + 1e-4 * rng.normal(size=points.shape), visible, NOTHING)
        if step.state == "arrived":
            break
        way, turn = step.command.forward * robot.tick, step.command.turn * robot.tick
        pose = pose @ Pose2(way * math.cos(turn / 2), way * math.sin(turn / 2), turn)
    assert step.state == "arrived"
    assert math.hypot(pose.x, pose.y) < 0.01
