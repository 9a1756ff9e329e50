"""A recording of a short drive: forward before two walls."""

from pathlib import Path

import cv2

from mapweave.hybridmap.pose import Pose2
from tests.agent.conftest import PhotoWalls

STEP = 0.02
"""m from one image to the next."""
COUNT = 60
"""Images."""
CAMERA = "width = 320\nheight = 240\nfx = 277\nfy = 277\ncx = 159.5\ncy = 119.5\nheight_m = 0.3\n"


def wall_drive(folder: Path) -> Path:
    """Write the recording into a folder, which is made; returns the folder."""
    walls = PhotoWalls()
    (folder / "images").mkdir(parents=True)
    (folder / "camera.toml").write_text(CAMERA)
    for k in range(COUNT):
        cv2.imwrite(str(folder / "images" / f"{k}.png"), walls.render(Pose2(STEP * k)))
    odometry = "".join(f"{STEP if k else 0},0\n" for k in range(COUNT))
    (folder / "odometry.csv").write_text(f"forward_m,turn_rad\n{odometry}")
    return folder
