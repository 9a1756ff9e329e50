"""Photographs brought to level, against the truth of a synthetic world; and their unknown scale."""

import math

import numpy as np
import pytest

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.registration.levelling import level
from mapweave.registration.recognition import recognise, register
from synthetic.world import Sensing, room, take_node, take_view
from tests.hand_held import SCALE_SHARE, photograph

HERE = PoseGaussian.from_sigmas(Pose2(), 0.01, 0.01)
SHARP = Sensing(pixel_sigma=0.3, depth_share=0.01, unknown_depth=0.0)


def scene(seed: int, off: Pose2) -> tuple[Node, object, np.random.Generator]:
    rng = np.random.default_rng(seed)
    world, at = room(0.0, 0.0, 6.0, 5.0, 900, rng), Pose2(2.0, 2.5, 0.1)
    node = take_node(world, NodeId("p0", 1, 1), at, HERE, rng, SHARP)
    view, _ = take_view(world, at @ off, rng, SHARP)
    return node, view, rng


@pytest.mark.parametrize("seed", range(6))
def test_pitch_roll_and_rise_do_not_move_the_robot(seed: int):
    rng = np.random.default_rng(seed + 100)
    off = Pose2(*rng.uniform([-0.5, -0.2, -0.15], [0.1, 0.2, 0.15]))
    pitch, roll = rng.normal(0.0, math.radians(1.5), 2)
    scale, rise = rng.uniform(0.8, 1.25), rng.normal(0.0, 0.02)
    node, view, _ = scene(seed, off)
    held = photograph(node, scale, pitch, roll, rise)
    recognition = recognise(held, view, None, np.random.default_rng(0))
    assert recognition is not None
    levelled = level(held, view, recognition)
    got = levelled.node_from_robot
    # The camera's way is right in the photograph's own unit.
    mount = Pose2(node.camera.mount_forward)
    way, true = (mount.inverse() @ pose @ mount for pose in (got.mean, off))
    assert math.hypot(way.x / scale - true.x, way.y / scale - true.y) < 0.02
    assert abs(way.heading - true.heading) < 0.008
    assert got.mahalanobis2(off) < 16.3
    # So are its landmarks, as a level camera sees them.
    level_pixels, tilted_pixels = levelled.node.landmarks.pixels, held.landmarks.pixels
    codes = {code.tobytes(): k for k, code in enumerate(node.landmarks.codes)}
    rows = [codes[code.tobytes()] for code in held.landmarks.codes]
    miss, before = (
        np.median(np.abs(pixels[:, 1] - node.landmarks.pixels[rows, 1]))
        for pixels in (level_pixels, tilted_pixels)
    )
    assert miss < 1.5
    assert miss < before


def test_a_level_photograph_stays_as_it_is():
    node, view, rng = scene(3, Pose2(-0.2, 0.05, 0.03))
    held = photograph(node)
    recognition = recognise(held, view, None, rng)
    assert recognition is not None
    levelled = level(held, view, recognition)
    assert np.median(np.abs(levelled.node.landmarks.pixels - held.landmarks.pixels)) < 0.5
    assert np.allclose(levelled.node.landmarks.depths, held.landmarks.depths, rtol=0.02)


def test_the_scale_is_a_share_of_the_way_to_the_photograph():
    off = Pose2(-0.5, 0.1, 0.05)
    node, view, rng = scene(2, off)
    recognition = recognise(photograph(node), view, None, rng)
    assert recognition is not None
    sigma = math.sqrt(float(np.linalg.eigvalsh(recognition.node_from_robot.covariance[:2, :2])[-1]))
    assert sigma == pytest.approx(SCALE_SHARE * math.hypot(off.x, off.y), rel=0.2)
    measured = recognise(node, view, None, np.random.default_rng(0))
    assert measured is not None
    assert math.sqrt(float(measured.node_from_robot.covariance[0, 0])) < 0.2 * sigma


@pytest.mark.parametrize("scale", [0.75, 1.3])
def test_a_measured_node_gives_a_photograph_its_scale(scale: float):
    """Registered with a node whose depths are measured, a photograph has its true pose."""
    rng = np.random.default_rng(5)
    world, at, off = room(0.0, 0.0, 6.0, 5.0, 900, rng), Pose2(2.0, 2.5, 0.1), Pose2(-0.4, 0.2, -0.1)
    node = take_node(world, NodeId("p0", 1, 1), at, HERE, rng, SHARP)
    other = take_node(world, NodeId("r0", 1, 1), at @ off, HERE, rng, SHARP)
    recognition = register(photograph(node, scale), other, None, np.random.default_rng(0))
    assert recognition is not None
    assert recognition.node_from_robot.mean.distance(off) < 0.06
    assert recognition.node_from_robot.mahalanobis2(off) < 16.3
