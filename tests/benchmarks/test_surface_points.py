"""What is seen through a pixel of the simulator, by another solution."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.images.surface_points import Surfaces
from mapweave.hybridmap.pose import Pose2
from mapweave.sim.camera import WEBCAM
from mapweave.sim.world import Panel
from mapweave.sim.worlds.catalog import make_world


def test_rays_agree_with_another_solution() -> None:
    """Against a solution of one system a panel and ray."""
    world = make_world("office", 5)
    surfaces, camera = Surfaces(world), WEBCAM
    rng = np.random.default_rng(0)
    pose = world.plan.random_free_pose(rng, 0.3)
    pixels = rng.uniform([0, 0], [camera.width - 1, camera.height - 1], (60, 2))
    seen = surfaces.see(pose, camera, pixels)
    eye = pose.apply(np.array([camera.mount_forward, 0.0, camera.mount_height]))
    met = 0
    for pixel, point, depth in zip(pixels, seen.points, seen.depths, strict=True):
        ray = pose.apply(camera.back_project(pixel, np.array(1.0))) - eye
        hits = [hit for panel in world.panels if (hit := _meets(panel, eye, ray)) is not None]
        nearest = min(hits, default=math.inf)
        assert depth == pytest.approx(nearest, rel=1e-9)
        if hits:
            met += 1
            np.testing.assert_allclose(point, eye + nearest * ray, atol=1e-9)
    assert met > 40


def _meets(panel: Panel, eye: np.ndarray, ray: np.ndarray) -> float | None:
    """How far along a ray it meets a panel's front, in lengths of the ray."""
    if ray @ np.cross(panel.along, panel.down) <= 0:
        return None
    depth, p, q = np.linalg.solve(np.column_stack([ray, -panel.along, -panel.down]), panel.corner - eye)
    return float(depth) if 0 <= p <= 1 and 0 <= q <= 1 and depth > 0.03 else None


def test_a_patch_across_an_edge_is_no_point() -> None:
    """A box before a wall: its middle is one surface, its edge is two."""
    world = make_world("arena", 0, boxes=1)
    box = world.plan.furniture[0]
    face = Pose2(box.x, box.y, box.heading) @ Pose2(box.length / 2 + 1.0, 0.0, math.pi)
    edge = WEBCAM.fx * box.width / 2 / 1.0
    row = WEBCAM.cy + 40.0
    pixels = np.array([[WEBCAM.cx, row], [WEBCAM.cx + edge, row], [WEBCAM.cx - edge, row]])
    assert Surfaces(world).flat(face, WEBCAM, pixels).tolist() == [True, False, False]
