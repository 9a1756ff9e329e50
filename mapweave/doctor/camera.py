"""The camera of the settings: whether it opens, how fast its images come, and whether they show anything."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from mapweave.doctor.finding import Finding, good, warning, wrong

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mapweave.agent.drivers.camera import FrameSource
    from mapweave.agent.drivers.settings import CameraSettings

SECONDS = 2.0
"""Of images."""
FIRST_PATIENCE = 4.0
"""s until the first image; a stream takes a moment."""
LEAST_RATE = 8.0
"""Images a second; the agent takes ten."""
OLDEST = 0.3
"""s that a new image may be old."""


@dataclass(frozen=True, eq=False)
class Watched:
    """What came from a camera for a while.

    Attributes:
        images: (H, W) grey each, in order.
        ages: s, of each on arrival.
        rate: images a second.
    """

    images: list[NDArray[np.uint8]]
    ages: list[float]
    rate: float


def watch(camera: FrameSource, seconds: float) -> Watched:
    """Take every image for a while, beginning with the first."""
    images: list[NDArray[np.uint8]] = []
    ages: list[float] = []
    frame = camera.newer(0, FIRST_PATIENCE)
    if frame is None:
        return Watched(images, ages, 0.0)
    arrived: list[float] = []
    end = time.monotonic() + seconds
    while frame is not None and time.monotonic() < end:
        images.append(frame.image)
        ages.append((time.time_ns() - frame.stamp_ns) * 1e-9)
        arrived.append(time.monotonic())
        frame = camera.newer(frame.stamp_ns, max(end - arrived[-1], 0.0))
    return Watched(images, ages, (len(images) - 1) / max(arrived[-1] - arrived[0], 1e-3))


def examine(settings: CameraSettings) -> Iterator[Finding]:
    """Open the camera and look at its images."""
    from mapweave.agent.drivers.camera import Capture
    from mapweave.hybridmap.errors import DeviceError

    try:
        camera = Capture(settings)
    except DeviceError as error:
        advice = "mapweave find-cameras lists the cameras that open; set [robot.camera] source"
        if "://" in settings.source:
            advice = "mend that, or [robot.camera] source; mapweave find-cameras URL tries an address"
        yield wrong("camera", str(error), advice)
        return
    try:
        watched = watch(camera, SECONDS)
    finally:
        camera.close()
    yield from judge(settings, watched)


def judge(settings: CameraSettings, watched: Watched) -> Iterator[Finding]:
    """What the images of a camera say."""
    from mapweave.agent.drivers.stream_refusal import without_password

    source = without_password(settings.source)
    if not watched.images:
        yield wrong(
            "camera", f"{source} opens and gives no image",
            "does another program use it? A Raspberry Pi's own camera needs rpicam-vid, see docs/robot.md",
        )  # fmt: skip
        return
    height, width = watched.images[-1].shape
    words = f"{source}: {width}x{height} px, {watched.rate:.0f} images/s"
    if (width, height) != (settings.width, settings.height):
        yield wrong(
            "camera", f"{words}, but declared as {settings.width}x{settings.height}",
            "set width and height of [robot.camera] to what the camera gives, and calibrate at that size",
        )  # fmt: skip
        return
    age = sorted(watched.ages)[len(watched.ages) // 2]
    if watched.rate < LEAST_RATE:
        yield warning("camera", words, "the agent takes 10 images/s: more light, or a smaller image")
    elif age > OLDEST:
        yield warning(
            "camera", f"{words}, {age:.1f} s old on arrival", "a stream is buffered: lower its latency"
        )
    else:
        yield good("camera", f"{words}, {1e3 * max(age, 0.0):.0f} ms old on arrival")
    yield image_quality(watched.images)


def image_quality(images: list[NDArray[np.uint8]]) -> Finding:
    """Focus and exposure, by the median of some images."""
    import numpy as np

    from mapweave.agent.vision.image_quality import ImageQuality

    looks = [ImageQuality.of(image) for image in images[:: max(len(images) // 5, 1)]]
    quality = sorted(looks, key=lambda one: (one.fault != "", one.blur))[len(looks) // 2]
    if quality.fault:
        return wrong("image", quality.fault, "look at a frame: mapweave find-cameras --out FOLDER")
    if len(images) > 3 and all(np.array_equal(images[0], image) for image in images[1:]):
        return wrong("image", "the camera repeats one image", "unplug it and plug it in; does a stream hang?")
    return good(
        "image",
        f"mean grey level {quality.mean:.0f}, {quality.white:.0%} white, {quality.black:.0%} black, "
        f"{quality.corners} corners, blur {quality.blur:.2f}",
    )
