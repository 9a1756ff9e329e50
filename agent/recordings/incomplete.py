"""Recordings that lack something: what a person can give, and what can be done without it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.recordings.recording import (
    BagContents,
    Images,
    Recording,
    StampedPoses,
    assembled,
    names_of,
)
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import DeviceError
from mapweave.hybridmap.pose import Array
from mapweave.vision.lens import NO_DISTORTION, Distortion

NO_ODOMETRY = (
    "no odometry: give --odometry FILE (stamped poses), or let `mapweave replay` map it by its images alone, "
    "without a scale"
)

CameraAndLens = tuple[Camera, Distortion]


@dataclass(frozen=True)
class CameraGiven:
    """What is known of a camera.

    Attributes:
        known: the camera; its height is 0 if that lacks. None if nothing is known.
        lacks: what a person must give, in words; empty if nothing lacks.
    """

    known: CameraAndLens | None
    lacks: str = ""


class Incomplete(DeviceError):
    """A recording lacks something that a person can give.

    Attributes:
        recording: the rest; its increments are zero if it has no odometry. None if it has no images.
        lacks: of images and camera, a line each.
        odometry: whether it has odometry.
        bag: what else is in it, if it is one.
    """

    def __init__(
        self,
        message: str,
        recording: Recording | None,
        lacks: tuple[str, ...],
        odometry: bool,
        bag: BagContents | None = None,
    ) -> None:
        """Take the line for people, and what there is."""
        super().__init__(message)
        self.recording, self.lacks, self.odometry, self.bag = recording, lacks, odometry, bag


class NoOdometry(Incomplete):
    """A recording has all but odometry.

    Attributes:
        recording: the rest; its increments are zero.
    """

    recording: Recording

    def __init__(self, message: str, recording: Recording) -> None:
        """Take the line for people, and what there is."""
        super().__init__(message, recording, (), odometry=False, bag=recording.bag)


def complete(
    path: Path,
    kind: str,
    given: CameraGiven,
    images: Images,
    odometry: StampedPoses | Array | None,
    notes: tuple[str, ...] = (),
    damage: tuple[str, ...] = (),
    bag: BagContents | None = None,
) -> Recording:
    """Put together what was found. Arguments as of `assembled`; without odometry it is None.

    Raises:
        NoOdometry: it can be mapped by its images alone.
        Incomplete: a person must say more of it.
        DeviceError: what there is does not fit together.
    """
    camera, distortion = given.known or (_stand_in(images), NO_DISTORTION)
    increments = np.zeros((len(images.stamps_ns), 2)) if odometry is None else odometry
    recording = assembled(path, kind, camera, distortion, images, increments, notes, damage)
    recording = replace(recording, bag=bag)
    if given.lacks:
        raise Incomplete(f"{path}: {given.lacks}", recording, (given.lacks,), odometry is not None, bag)
    if odometry is None:
        topics = "" if bag is None else f"; topics: {names_of(bag.topics)}"
        raise NoOdometry(
            f"{path}: {kind}, {len(images.stamps_ns)} images, but {NO_ODOMETRY}{topics}", recording
        )
    return recording


def first_image(count: int, read: Callable[[int], NDArray[np.uint8]]) -> tuple[NDArray[np.uint8], str]:
    """The first image that can be read, (H, W) grey, and why those before it cannot; empty if all can.

    Raises:
        DeviceError: none can be read.
    """
    why = ""
    for k in range(count):
        try:
            return read(k), why
        except DeviceError as error:
            why = why or str(error)
    raise DeviceError(why)


def _stand_in(images: Images) -> Camera:
    """A camera of which only the size is known, for a recording that is described and not mapped."""
    image, _ = first_image(len(images.stamps_ns), images.read)
    height, width = image.shape
    return Camera(width, height, width, width, 0.5 * (width - 1), 0.5 * (height - 1), mount_height=0.0)
