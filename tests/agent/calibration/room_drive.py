"""Drives through a room with known geometry: tracks of image pairs, or a recording with rendered images.

The room is a box with pillars, its floor and walls covered with a random pattern. Wheels slip, tracks tremble
and some of them are false.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.agent.calibration.camera_motions import WheelTrack, robot_from_camera
from mapweave.agent.calibration.pair_information import ImagePair
from mapweave.agent.drive_geometry import DriveGeometry
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.25, mount_forward=0.08)
SIDE = (12.0, 16.0)
"""Of the room, m; its middle is the origin."""
CEILING = 2.5
TICK = 0.1
TEXEL = 0.02
"""Of the pattern, m."""


@dataclass(frozen=True, eq=False)
class RoomDrive:
    """One drive.

    Attributes:
        camera: intrinsics; its mount is in `true`.
        true: the geometry.
        stamps: (T,) s of the images.
        poses: (T, 3) true x m, y m, heading rad of the robot at the images.
        wheels: what the wheels report.
    """

    camera: Camera
    true: DriveGeometry
    stamps: Array
    poses: Array
    wheels: WheelTrack


def drive(
    rng: np.random.Generator,
    true: DriveGeometry,
    seconds: float = 40.0,
    shape: str = "eight",
    wheel_noise: float = 0.01,
    camera: Camera = CAMERA,
) -> RoomDrive:
    """A drive of some seconds at 10 Hz.

    Args:
        rng: of the wheels' noise.
        true: the geometry.
        seconds: how long.
        shape: "eight", "straight", or "turning" on the spot with short ways in between.
        wheel_noise: standard deviation of a step's way and turn as a share of it.
        camera: the intrinsics.
    """
    fine = 20
    dt = TICK / fine
    margin = 10 * fine
    t = dt * np.arange(-margin, round(seconds / TICK) * fine + margin + 1)
    if shape == "straight":
        speed, rate = 0.12 + 0.05 * np.sin(0.5 * t), 0.0 * t
    elif shape == "turning":
        on = np.clip(3.0 * np.sin(2 * np.pi * t / 12.0), -1.0, 1.0)
        speed, rate = 0.25 * np.maximum(on, 0.0), 0.6 * np.maximum(-on, 0.0)
    else:
        speed = 0.35 + 0.15 * np.sin(2 * np.pi * t / 7.0)
        rate = 0.55 * np.sin(2 * np.pi * t / 13.0) + 0.25 * np.sin(2 * np.pi * t / 4.3)
    heading = np.concatenate([[0.0], np.cumsum(rate[:-1] * dt)])
    middle = heading[:-1] + 0.5 * np.diff(heading)
    x = np.concatenate([[0.0], np.cumsum(speed[:-1] * dt * np.cos(middle))])
    y = np.concatenate([[0.0], np.cumsum(speed[:-1] * dt * np.sin(middle))])
    x, y = x - 0.5 * (x.max() + x.min()), y - 0.5 * (y.max() + y.min())
    way = np.concatenate([[0.0], np.cumsum(speed[:-1] * dt)])
    stamps: Array = TICK * np.arange(round(seconds / TICK) + 1, dtype=np.float64)
    poses: Array = np.column_stack([np.interp(stamps, t, c) for c in (x, y, heading)])
    # The reading that belongs to an image has a later stamp by the delay.
    read = np.concatenate([[-TICK], stamps, [stamps[-1] + TICK]]) - true.delay
    ways, headings = np.diff(np.interp(read, t, way)), np.diff(np.interp(read, t, heading))
    reported_way = ways / true.wheel_scale * (1.0 + wheel_noise * rng.normal(size=len(ways)))
    reported_turn = (headings - true.drift * ways) / true.turn_scale
    reported_turn = reported_turn * (1.0 + wheel_noise * rng.normal(size=len(ways)))
    reported_turn += 0.2 * wheel_noise * np.abs(ways) / 0.24 * rng.normal(size=len(ways))
    wheels = WheelTrack(
        read + true.delay, np.concatenate([[0.0], np.cumsum(reported_way)]),
        np.concatenate([[0.0], np.cumsum(reported_turn)]),
    )  # fmt: skip
    return RoomDrive(camera, true, stamps, poses, wheels)


def camera_poses(run: RoomDrive) -> tuple[Array, Array]:
    """(T, 3, 3) world_from_camera rotations and (T, 3) m optical centres."""
    true = run.true
    mount = robot_from_camera(true.heading, true.pitch, true.roll)
    c, s = np.cos(run.poses[:, 2]), np.sin(run.poses[:, 2])
    zero, one = 0.0 * c, 0.0 * c + 1.0
    turn = np.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=1).reshape(-1, 3, 3)
    place = np.column_stack([run.poses[:, :2], zero])
    return turn @ mount, place + turn @ np.array([true.forward, true.left, true.height])


def first_in_view(points: Array, rotation: Array, centre: Array) -> tuple[NDArray[np.intp], Array]:
    """The first 150 points that a camera sees, as tracks are kept: their numbers (N,), and (N, 2) px.

    Args:
        points: (M, 3) m, in world.
        rotation: (3, 3) world_from_camera.
        centre: (3,) m, of the camera.
    """
    most, at_once = 150, 1000
    ids, seen = np.zeros(0, np.intp), np.zeros((0, 2))
    for begin in range(0, len(points), at_once):
        local = (points[begin : begin + at_once] - centre) @ rotation
        ahead = local[:, 2] > 0.3
        pixels = local[:, :2] / np.where(ahead, local[:, 2], 1.0)[:, None] * CAMERA.fx + [
            CAMERA.cx,
            CAMERA.cy,
        ]
        found = np.flatnonzero(ahead & CAMERA.contains(pixels, 4.0))
        ids, seen = np.append(ids, begin + found), np.concatenate([seen, pixels[found]])
        if len(ids) >= most:
            break
    return ids[:most], seen[:most]


def pairs(
    rng: np.random.Generator, run: RoomDrive, pixel_sigma: float = 0.4, outliers: float = 0.1, step: int = 5,
    floor: bool = True, tracks: int = 150,
) -> list[ImagePair]:  # fmt: skip
    """Image pairs with tracks of points on walls, pillars and the floor."""
    rotation, centre = camera_poses(run)
    camera, half = run.camera, 0.5 * np.array(SIDE)
    n = 3000
    walls = np.column_stack([rng.uniform(-half, half, (n, 2)), rng.uniform(0.0, CEILING, n)])
    side = rng.integers(0, 2, n)
    walls[np.arange(n), side] = half[side] * rng.choice([-1.0, 1.0], n)
    inner = np.column_stack([rng.uniform(-half, half, (n // 3, 2)), rng.uniform(0.0, 1.0, n // 3)])
    ground = np.column_stack([rng.uniform(-half, half, (n if floor else 0, 2)), np.zeros(n if floor else 0)])
    points = np.concatenate([walls, inner, ground])
    found = []
    for i in range(0, len(run.stamps) - step, step):
        seen = []
        for k in (i, i + step):
            local = (points - centre[k]) @ rotation[k]
            ahead = local[:, 2] > 0.15
            normal = local[:, :2] / np.where(ahead, local[:, 2], 1.0)[:, None]
            pixels = normal * [camera.fx, camera.fy] + [camera.cx, camera.cy]
            seen.append((normal, ahead & camera.contains(pixels, 4.0)))
        both = np.flatnonzero(seen[0][1] & seen[1][1])
        both = rng.permutation(both)[:tracks]
        noise = pixel_sigma / camera.fx * rng.normal(size=(2, len(both), 2)) / math.sqrt(2.0)
        before, after = seen[0][0][both] + noise[0], seen[1][0][both] + noise[1]
        false = rng.random(len(both)) < outliers
        after[false] += rng.normal(0.0, 8.0 / camera.fx, (int(false.sum()), 2))
        if len(both) >= 25:
            found.append(ImagePair(float(run.stamps[i]), float(run.stamps[i + step]), before, after))
    return found


def render(run: RoomDrive, seed: int = 0, floor: float = 1.0) -> list[NDArray[np.uint8]]:
    """One image a stamp: rays from the camera to the nearest plane of the room and its pillars.

    Args:
        run: the drive.
        seed: of pattern and noise.
        floor: contrast of floor and ceiling over that of the walls.
    """
    rng = np.random.default_rng(seed)
    size = 1024
    pattern = np.zeros((size, size), np.float32)
    for cells, gain in ((32, 25.0), (128, 35.0), (512, 30.0)):
        coarse = rng.normal(size=(cells, cells)).astype(np.float32)
        pattern += gain * cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC)
    pattern = np.clip(pattern + 128.0, 10, 245)
    rotation, centre = camera_poses(run)
    camera, half = run.camera, 0.5 * np.array(SIDE)
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    images = []
    for r, c in zip(rotation, centre, strict=True):
        d = (rays @ r.T).reshape(-1, 3)
        d = np.where(np.abs(d) < 1e-9, 1e-9, d)
        low, high = np.array([-half[0], -half[1], 0.0]), np.array([half[0], half[1], CEILING])
        out = np.where(d > 0, (high - c) / d, (low - c) / d)
        plane = out.argmin(axis=1)
        reach = out[np.arange(len(d)), plane]
        for k, (px, py) in enumerate(((-5.2, -3.0), (5.3, -4.5), (-5.0, 4.0), (5.2, 3.0))):
            one, two = ((np.array([px, py]) + edge - c[:2]) / d[:, :2] for edge in (-0.2, 0.2))
            enter, leave = np.minimum(one, two), np.maximum(one, two)
            near = enter.max(axis=1)
            hit = (near > 0.05) & (near < leave.min(axis=1)) & (near < reach)
            reach = np.where(hit, near, reach)
            plane = np.where(hit, enter.argmax(axis=1) + 3 * (k + 1), plane)
        p = c + reach[:, None] * d
        axis = plane % 3
        a = np.where(axis == 0, p[:, 1], p[:, 0]) / TEXEL + 97.0 * plane
        b = np.where(axis == 2, p[:, 1], p[:, 2]) / TEXEL + 53.0 * plane
        grey = cv2.remap(
            pattern, (a % (size - 1)).astype(np.float32).reshape(u.shape),
            (b % (size - 1)).astype(np.float32).reshape(u.shape), cv2.INTER_LINEAR,
        )  # fmt: skip
        level = (plane == 2).reshape(u.shape)
        grey[level] = 128.0 + floor * (grey[level] - 128.0)
        shade = np.array([0.85, 1.0, 0.7])[axis].reshape(u.shape)
        noisy = grey * shade + rng.normal(0.0, 2.0, grey.shape)
        images.append(np.clip(noisy, 0, 255).astype(np.uint8))
    return images


def write(run: RoomDrive, folder: Path, seed: int = 0) -> None:
    """Write a recording with images, camera.toml, times.txt, odometry.csv and truth.csv (of the camera)."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for k, image in enumerate(render(run, seed)):
        cv2.imwrite(str(folder / "images" / f"{k:06d}.png"), image)
    camera, true = run.camera, run.true
    folder.joinpath("camera.toml").write_text(
        f"width = {camera.width}\nheight = {camera.height}\nfx = {camera.fx}\nfy = {camera.fy}\n"
        f"cx = {camera.cx}\ncy = {camera.cy}\ndistortion = [0.0, 0.0, 0.0, 0.0, 0.0]\n"
        f"height_m = {true.height}\nforward_m = {true.forward}\n"
    )
    folder.joinpath("times.txt").write_text("".join(f"{t:.3f}\n" for t in run.stamps))
    way, turn = (np.interp(run.stamps, run.wheels.stamps, c) for c in (run.wheels.way, run.wheels.turn))
    rows = zip(run.stamps, np.diff(way, prepend=way[0]), np.diff(turn, prepend=turn[0]), strict=True)
    folder.joinpath("odometry.csv").write_text(
        "stamp_s,forward_m,turn_rad\n" + "".join(f"{t:.3f},{f:.6f},{r:.8f}\n" for t, f, r in rows)
    )
    _, centre = camera_poses(run)
    truth = zip(run.stamps, centre[:, 0], centre[:, 1], run.poses[:, 2], strict=True)
    folder.joinpath("truth.csv").write_text(
        "stamp_s,x_m,y_m,heading_rad\n"
        + "".join(f"{t:.3f},{x:.5f},{y:.5f},{h:.6f}\n" for t, x, y, h in truth)
    )
