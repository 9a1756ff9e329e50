"""Recordings that tests write: a folder of images with what belongs to it, and a video."""

from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from mapweave import Camera, Pose2
from tests.agent.conftest import CAMERA


def camera_toml(camera: Camera = CAMERA, distortion: Sequence[float] = ()) -> str:
    """A camera file."""
    c = camera
    text = f"width = {c.width}\nheight = {c.height}\nfx = {c.fx}\nfy = {c.fy}\ncx = {c.cx}\ncy = {c.cy}\n"
    lens = f"distortion = {list(distortion)}\n" if distortion else ""
    return f"{text}height_m = {c.mount_height}\n{lens}"


def steps(way: Sequence[Pose2], stretched: float = 1.0) -> list[tuple[float, float]]:
    """What wheels report at each pose, m and rad, if they make ways longer by a factor."""
    moved = [before.inverse() @ now for before, now in pairwise([way[0], *way])]
    return [(stretched * move.x, move.heading) for move in moved]


def write_folder(
    folder: Path,
    images: Iterable[np.ndarray],
    odometry: Iterable[tuple[float, float]] = (),
    camera: str | None = None,
    *,
    timed: bool = False,
    truth: Iterable[Pose2] = (),
) -> Path:
    """Make a folder of grey images; ten a second, where it has times.

    Args:
        folder: is made.
        images: (H, W) uint8 each.
        odometry: forward (m) and turn (rad) since the image before; without any there is no such file.
        camera: a camera file, that of `CAMERA` otherwise.
        timed: whether there is times.txt.
        truth: the robot's pose at each image; without any there is no such file.
    """
    (folder / "images").mkdir(parents=True)
    (folder / "camera.toml").write_text(camera or camera_toml())
    count = 0
    for count, image in enumerate(images, 1):
        cv2.imwrite(str(folder / "images" / f"{count - 1}.png"), image)
    if rows := [f"{forward},{turn}\n" for forward, turn in odometry]:
        (folder / "odometry.csv").write_text("".join(["forward_m,turn_rad\n", *rows]))
    if timed:
        (folder / "times.txt").write_text("".join(f"{0.1 * k:.3f}\n" for k in range(count)))
    if rows := [f"{0.1 * k:.3f},{p.x},{p.y},{p.heading}\n" for k, p in enumerate(truth)]:
        (folder / "truth.csv").write_text("".join(["stamp_s,x_m,y_m,heading_rad\n", *rows]))
    return folder


def write_video(path: Path, images: Iterable[np.ndarray], rate: float, codec: str = "MJPG") -> Path:
    """Write grey images, or (H, W, 3) ones, as so many frames a second."""
    writer = None
    for image in images:
        frame = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
        if writer is None:
            writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), rate, frame.shape[1::-1])
        writer.write(frame)
    assert writer is not None
    writer.release()
    return path
