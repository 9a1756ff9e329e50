"""A recorded drive that asks a map: its images are seen as the declared geometry has them."""

import math
from typing import cast

import numpy as np
import pytest

from mapweave import Camera, Observation, Odometry, Relocalizer, RobotDescription
from mapweave.agent.drive_geometry import DriveGeometry
from mapweave.agent.drivers.replay import Replay
from mapweave.evaluation.drive import DriveMap
from mapweave.evaluation.truth import Truth
from mapweave.hybridmap.query import Certainty, RelocalizeAnswer, View

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.3, 0.0)


class OneImage:
    """A recording of one image."""

    def __init__(self, geometry: DriveGeometry) -> None:
        noise = np.random.default_rng(0).integers(0, 256, (240, 320), dtype=np.uint8)
        self._left = [Observation(1, Odometry(0.0, 0.0), noise)]
        self._geometry = geometry

    def describe(self) -> RobotDescription:
        return RobotDescription(camera=CAMERA, geometry=self._geometry)

    def sense(self) -> Observation | None:
        return self._left.pop() if self._left else None


class Listener:
    """Keeps the views with which it is asked, and answers nothing."""

    def __init__(self) -> None:
        self.views: list[View] = []

    def answer(self, view: View) -> RelocalizeAnswer:
        self.views.append(view)
        return RelocalizeAnswer(Certainty.UNKNOWN, (), "nowhere")


def asked(geometry: DriveGeometry) -> View:
    listener = Listener()
    nowhere = Truth(np.zeros(0, np.int64), [])
    drive = DriveMap({}, cast(Relocalizer, listener), [], nowhere)
    assert len(list(drive.questions(cast(Replay, OneImage(geometry))))) == 1
    return listener.views[0]


def test_a_robot_that_declares_where_its_camera_looks_asks_with_a_level_view():
    pitch = math.radians(-0.5)
    level, plain = asked(DriveGeometry(pitch=pitch)), asked(DriveGeometry())
    assert plain.camera == CAMERA
    assert level.camera.cy == pytest.approx(CAMERA.cy - CAMERA.fy * math.tan(pitch))
    # What is seen in the middle of the image is that much higher, in the camera's axes.
    rises = (level.camera.cy - level.pixels[:, 1]) / CAMERA.fy - (
        plain.camera.cy - plain.pixels[:, 1]
    ) / CAMERA.fy
    middle = np.hypot(*(plain.pixels - [CAMERA.cx, CAMERA.cy]).T) < 60.0
    assert middle.sum() > 10
    assert np.median(rises[middle]) == pytest.approx(math.tan(-pitch), rel=0.1)
