"""A way toward a place known by bearings: exact without noise, the batch optimum with it, and honest."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.optimize

from agent.homing.trail import Trail
from agent.observation import Odometry
from hybridmap.pose import Pose2, PoseGaussian

ANYWHERE = PoseGaussian.from_sigmas(Pose2(), 2.0, 1.0)


@pytest.mark.parametrize("seed", range(4))
def test_without_noise_way_and_depths_are_exact(scene_of, seed):
    scene = scene_of(seed, sigma_px=0.0)
    guesses = scene.guesses()
    for _ in range(12):
        guesses.move(scene.drive(-0.03, 0.01))
        guesses.see(*scene.look())
    trail = guesses.trail
    # What is believed beforehand pulls a little.
    assert trail.pose.mean.distance(scene.pose) < 5e-3
    assert abs(trail.pose.mean.heading - scene.pose.heading) < 1e-3
    inverse, _ = trail.inverse_depths
    true = 1.0 / (scene.points[:, 0] - scene.place.mount_forward)
    assert np.abs(inverse - true)[trail.known].max() < 5e-3


def test_the_scale_comes_from_the_wheels_alone(scene_of):
    """Wheels that count double make a place that is twice as far away, whatever else."""
    ratios = []
    for seed in range(4):
        ways = []
        for factor in (1.0, 2.0):
            scene = scene_of(seed, sigma_px=0.0, plain=True)
            guesses = scene.guesses()
            for _ in range(12):
                odometry = scene.drive(-0.03, 0.0)
                guesses.move(Odometry(factor * odometry.forward, odometry.turn))
                guesses.see(*scene.look())
            mean = guesses.trail.pose.mean
            ways.append(math.hypot(mean.x, mean.y))
        ratios.append(ways[1] / ways[0])
    np.testing.assert_allclose(ratios, 2.0, atol=0.05)


def test_it_finds_the_batch_optimum(scene_of):
    """SciPy minimises the same sum of squares, written down anew, from the truth; nobody finds less."""
    scene = scene_of(2, count=12)
    trail = Trail(scene.robot, scene.place, scene.at_place, ANYWHERE, scene.settings, scene.pose)
    postures, shown, moves = [scene.pose.vector], [scene.look()], []
    trail.see(*shown[0])
    for _ in range(7):
        moves.append(scene.drive(-0.06, 0.02))
        trail.move(moves[-1])
        shown.append(scene.look())
        trail.see(*shown[-1])
        postures.append(scene.pose.vector)
    s, place, camera, robot = scene.settings, scene.place, scene.robot.camera, scene.robot
    count, known = len(scene.points), trail.known

    def squares(x: np.ndarray) -> np.ndarray:
        way, pixels, inverse = x[:24].reshape(8, 3), x[24 : 24 + 2 * count].reshape(-1, 2), x[-count:]
        points = place.back_project(pixels, 1.0 / np.maximum(inverse, 1e-3))
        parts = [
            ((pixels - scene.at_place) / s.node_sigma).ravel(),
            (inverse - 0.1 * s.nearness) / s.nearness,
        ]
        for (ids, seen), posture in zip(shown, way, strict=True):
            pixel = camera.project(Pose2.from_vector(posture).inverse().apply(points[ids]))
            parts.append((np.nan_to_num(pixel, nan=1e3) - seen).ravel() / s.pixel_sigma)
        first = Pose2.from_vector(way[0])
        parts.append(first.vector / [2.0, 2.0, 1.0])
        for j, move in enumerate(moves):
            there = Pose2.from_vector(way[j]).inverse() @ Pose2.from_vector(way[j + 1])
            off = move.motion().inverse() @ there
            sigma = robot.wheel_noise * (abs(move.forward) + abs(move.turn) * robot.axle)
            parts.append(off.vector / [sigma + 1e-4, sigma + 1e-4, sigma / robot.axle + 1e-4])
        return np.concatenate(parts)

    start = np.concatenate(
        [np.ravel(postures), scene.at_place.ravel(), 1.0 / (scene.points[:, 0] - place.mount_forward)]
    )
    best = scipy.optimize.least_squares(squares, start)
    last = Pose2.from_vector(best.x[21:24])
    sigma = np.sqrt(np.diag(trail.pose.covariance))
    assert trail.pose.mean.distance(last) < 0.15 * max(sigma[:2])
    assert abs(trail.pose.mean.heading - last.heading) < 0.15 * sigma[2]
    inverse, _ = trail.inverse_depths
    np.testing.assert_allclose(inverse[known], best.x[-count:][known], atol=0.01)
    assert trail.cost < best.cost * 1.02 + 0.1


def test_what_it_says_of_itself_is_true(scene_of):
    """Few landmarks, no idea where the robot begins, some way: 12 starts."""
    squares, depths = [], []
    for seed in range(12):
        scene = scene_of(seed, count=14)
        guesses = scene.guesses()
        for _ in range(10):
            guesses.move(scene.drive(-0.04, 0.0))
            guesses.see(*scene.look())
        squares.append(guesses.trail.pose.mahalanobis2(scene.pose))
        inverse, sigma = guesses.trail.inverse_depths
        off = (inverse - 1.0 / (scene.points[:, 0] - scene.place.mount_forward)) / sigma
        depths.append(float(np.nanmean(off**2)))
    # 3 degrees of freedom; an honest mean of 12 is within 1.4 to 5.1 in 99 of 100, and none is beyond 21.
    assert 1.0 < np.mean(squares) < 5.5
    assert max(squares) < 21.0
    assert np.mean(depths) < 2.5


def test_a_wrong_beginning_is_given_up(scene_of):
    """Started on the wrong side of the place, the guesses find the right one on the way."""
    for seed in (1, 5, 8):
        scene = scene_of(seed, count=10)
        believed = Pose2(-scene.pose.x, -scene.pose.y, scene.pose.heading)
        guesses = scene.guesses(PoseGaussian.from_sigmas(believed, 2.0, 0.5))
        for _ in range(20):
            guesses.move(scene.drive(-0.03, 0.0))
            guesses.see(*scene.look())
        assert guesses.trail.pose.mahalanobis2(scene.pose) < 21.0


def test_wrong_tracks_stand_out_and_can_be_forgotten(scene_of):
    scene = scene_of(3, count=25)
    guesses = scene.guesses()
    for tick in range(15):
        guesses.move(scene.drive(-0.03, 0.0))
        ids, pixels = scene.look()
        if tick == 14:
            pixels[0] += [9.0, 6.0]
            wrong = int(ids[0])
        guesses.see(ids, pixels)
    misses = guesses.trail.misses()
    assert int(np.nanargmax(misses)) == wrong
    assert misses[wrong] > 4.0
    assert np.median(misses[ids]) < 2.0
    guesses.forget(np.array([wrong]))
    assert not guesses.trail.known[wrong]
    assert np.isnan(guesses.trail.points()[wrong]).all()


def test_wheels_alone_carry_the_posture_on(scene_of):
    scene = scene_of(0)
    guesses = scene.guesses()
    for _ in range(15):
        guesses.move(scene.drive(-0.03, 0.0))
        guesses.see(*scene.look())
    before = guesses.trail.pose
    guesses.move(Odometry(0.2, 0.1))
    after = guesses.trail.pose
    assert (before.mean @ Odometry(0.2, 0.1).motion()).distance(after.mean) < 1e-9
    assert np.linalg.det(after.covariance) > np.linalg.det(before.covariance)
