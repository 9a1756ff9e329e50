"""A recording of a short drive: forward before two walls."""

from pathlib import Path

from mapweave.hybridmap.pose import Pose2
from tests.agent.conftest import PhotoWalls
from tests.recordings import write_folder

STEP = 0.02
"""m from one image to the next."""
COUNT = 60
"""Images."""


def wall_drive(folder: Path) -> Path:
    """Write the recording into a folder, which is made; returns the folder."""
    walls = PhotoWalls()
    images = (walls.render(Pose2(STEP * k)) for k in range(COUNT))
    return write_folder(folder, images, [(STEP if k else 0.0, 0.0) for k in range(COUNT)])
