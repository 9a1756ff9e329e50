"""Drives through pictures whose every point is known: photographs on walls, and the simulator's rooms.

The truth of a wall is a homography, written down here; OpenCV draws the picture, finer than it is seen. The
truth of a room is a ray against the panels (benchmarks/images/surface_points.py), of which the renderer knows
nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import skimage.data
from numpy.typing import NDArray

from benchmarks.images.surface_points import Surfaces
from mapweave.agent.observation import RobotDescription
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim.camera import CAMERAS, WEBCAM
from mapweave.sim.imager import Imager
from mapweave.sim.renderer import CAMERA_FROM_ROBOT
from mapweave.sim.scene import Scene
from mapweave.sim.texture import Image
from mapweave.sim.world import PanelSet
from mapweave.sim.worlds.catalog import make_world

TICK = 0.1
PHOTOGRAPHS = ("astronaut", "coffee", "camera", "brick", "chelsea", "coins")
FINER = 4
"""Pictures of walls are drawn so many times larger, and the mean is taken."""
TEXEL_PX = 1.25
"""How large a photograph's pixel is seen at first."""
WORLDS = ("office", "arena", "warehouse", "corridor")
LENSES = ("webcam", "wide", "phone", "cheap")
BORDER_PX = 4.0
SAME_POINT = 0.005
"""m; a ray that meets something further than this from a point does not see it."""


@dataclass(frozen=True, eq=False)
class Drive:
    """Pictures of a drive, and where the points of the first one really are in the others.

    Attributes:
        name: of the scene.
        description: of the robot.
        images: T.
        truth: (N, 2) px in the first image, ideal lens -> (T, N, 2) px likewise, NaN where a point is hidden
            or outside; for all times where the patch around it is not on one surface.
    """

    name: str
    description: RobotDescription
    images: tuple[Image, ...]
    truth: Callable[[Array], Array]


def drives(seed: int, count: int, frames: int) -> Iterator[tuple[str, Drive]]:
    """So many drives of each kind of scene, `walls` and `rooms`; other seeds, other pictures and ways."""
    for number in range(count):
        yield "walls", wall_drive(np.random.default_rng([seed, 1, number]), frames)
        yield "rooms", room_drive(np.random.default_rng([seed, 2, number]), frames)


def way(rng: np.random.Generator, frames: int) -> list[Pose2]:
    """Approach and retreat at up to 0.3 m/s with a weaving heading: `first_from_robot` a tick."""
    reach = rng.uniform(0.45, 0.65) * rng.choice([1.0, -1.0], p=[0.75, 0.25])
    period, swing = rng.uniform(6.5, 8.5), rng.uniform(0.02, 0.1)
    swings, phase = rng.uniform(3.0, 9.0), rng.uniform(0.0, math.tau)
    poses, before = [Pose2()], 0.0
    for tick in range(1, frames):
        gone = 0.5 * reach * (1 - math.cos(math.tau * tick * TICK / period))
        heading = swing * (math.sin(math.tau * tick * TICK / swings + phase) - math.sin(phase))
        moved = Pose2(poses[-1].x, poses[-1].y, heading) @ Pose2(gone - before)
        poses.append(moved)
        before = gone
    return poses


def wall_drive(rng: np.random.Generator, frames: int) -> Drive:
    """A photograph on a slanted wall, seen with blur, gamma, a light that waxes and wanes, and noise."""
    camera, name = WEBCAM, str(rng.choice(PHOTOGRAPHS))
    picture = _wide(getattr(skimage.data, name)())
    depth, slant = rng.uniform(1.2, 2.6), rng.uniform(-0.6, 0.6)
    to_images = [wall_to_image(picture, depth, slant, pose) for pose in way(rng, frames)]
    gamma, blur, noise = rng.uniform(0.7, 1.4), rng.uniform(0.4, 0.9), rng.uniform(1.0, 3.0)
    dimming, lights = rng.uniform(0.0, 0.15), rng.uniform(4.0, 12.0)
    images = []
    for tick, to_image in enumerate(to_images):
        seen = cv2.GaussianBlur(_drawn(picture, to_image, camera), (0, 0), blur)
        lamp = 1.0 - dimming * 0.5 * (1 - math.cos(math.tau * tick * TICK / lights))
        grey = 255.0 * (lamp * seen / 255.0) ** gamma + noise * rng.standard_normal(seen.shape)
        images.append(np.clip(np.rint(grey), 0, 255).astype(np.uint8))

    def truth(pixels: Array) -> Array:
        spots = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(to_images[0]).T
        seen = np.stack([spots @ to_image.T for to_image in to_images])
        at: Array = seen[..., :2] / seen[..., 2:]
        return np.asarray(np.where(camera.contains(at, BORDER_PX)[..., None], at, np.nan))

    return Drive(f"wall with {name}", RobotDescription(camera), tuple(images), truth)


def _wide(picture: Image) -> Image:
    """A photograph in grey, mirrored on to twice its size: it shall fill the view."""
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) if picture.ndim == 3 else picture
    rows, columns = (side // 2 for side in grey.shape)
    wide = cv2.copyMakeBorder(grey, rows, rows, columns, columns, cv2.BORDER_REFLECT_101)
    return np.asarray(wide, dtype=np.uint8)


def wall_to_image(picture: Image, depth: float, slant: float, pose: Pose2) -> Array:
    """(3, 3) homography from the pixels of a picture to those of a robot's image.

    Args:
        picture: whose middle hangs straight ahead of the first pose, as high as the camera.
        depth: of its middle there, m.
        slant: of the wall, rad; 0 is square to the first view.
        pose: `first_from_robot`.
    """
    texel = TEXEL_PX * depth / WEBCAM.fx
    right = -texel * np.array([math.sin(slant), math.cos(slant), 0.0])
    down = np.array([0.0, 0.0, -texel])
    middle = np.array([depth - pose.x, -pose.y, 0.0])
    rows, columns = picture.shape
    corner = middle - 0.5 * (columns - 1) * right - 0.5 * (rows - 1) * down
    turned = np.eye(3)
    turned[:2, :2] = pose.rotation.T
    focal = np.array([[WEBCAM.fx, 0, WEBCAM.cx], [0, WEBCAM.fy, WEBCAM.cy], [0, 0, 1.0]])
    return np.asarray(focal @ CAMERA_FROM_ROBOT @ turned @ np.column_stack([right, down, corner]))


def _drawn(picture: Image, to_image: Array, camera: Camera) -> NDArray[np.float32]:
    """(H, W) float32 grey: each pixel is the mean of FINER x FINER samples."""
    finer = np.array([[FINER, 0, (FINER - 1) / 2], [0, FINER, (FINER - 1) / 2], [0, 0, 1.0]])
    size = (camera.width, camera.height)
    large = cv2.warpPerspective(
        picture, finer @ to_image, (FINER * size[0], FINER * size[1]), flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT_101,
    )  # fmt: skip
    return np.asarray(cv2.resize(large.astype(np.float32), size, interpolation=cv2.INTER_AREA))


def room_drive(rng: np.random.Generator, frames: int) -> Drive:
    """A drive in a simulated building, through one of the simulator's cameras."""
    kind, lens = str(rng.choice(WORLDS)), str(rng.choice(LENSES))
    world, setup = make_world(kind, int(rng.integers(1 << 20))), CAMERAS[lens]
    camera, surfaces, steps = setup.intrinsics, Surfaces(world), way(rng, frames)
    grid = np.stack(np.meshgrid(np.arange(20, 320, 20.0), np.arange(20, 160, 20.0)), -1).reshape(-1, 2)
    reach = max(step.x for step in steps)
    while True:
        start = world.plan.random_free_pose(rng, 0.3)
        depths = surfaces.see(start, camera, grid).depths
        if depths.min() > reach + 0.4 and 1.2 < np.median(depths) < 4.5:
            break
    poses = [start @ step for step in steps]
    imager = Imager(setup, world.background, [int(rng.integers(1 << 30))])
    scene, images = Scene([PanelSet.of(world.panels)]), []
    for before, pose in zip([start, *poses], poses, strict=False):
        rotation = np.eye(3)
        rotation[:2, :2] = pose.rotation
        pose_vector = np.array([pose.x, pose.y, 0.0]), rotation
        images.append(imager.picture(scene, pose_vector, 1.0, (pose.heading - before.heading) / TICK, TICK))

    def truth(pixels: Array) -> Array:
        points = surfaces.see(start, camera, pixels).points
        points[~surfaces.flat(start, camera, pixels)] = np.nan
        seen = []
        for pose in poses:
            at = camera.project(pose.inverse().apply(points))
            shown = camera.contains(at, BORDER_PX)
            met = surfaces.see(pose, camera, at[shown]).points
            shown[shown] = np.linalg.norm(met - points[shown], axis=1) < SAME_POINT
            seen.append(np.where(shown[:, None], at, np.nan))
        return np.array(seen)

    return Drive(f"{kind} by {lens}", RobotDescription(camera, setup.distortion), tuple(images), truth)
