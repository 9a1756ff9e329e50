"""Whether a camera's calibration can be right."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

from mapweave.doctor.finding import Finding, good, warning, wrong

if TYPE_CHECKING:
    from mapweave.agent.observation import RobotDescription
    from mapweave.agent.recordings.recording import Recording
    from mapweave.hybridmap.camera import Camera

SUBJECT = "calibration"
CALIBRATE = "mapweave calibrate camera"
NARROWEST, WIDEST = math.radians(15.0), math.radians(150.0)
"""Horizontal fields of view of lenses that people mount on robots."""
SQUARE = 0.05
"""Pixels of today's cameras are square to within this."""
CENTRED = 0.15
"""The principal point is nearer to the middle than this share of the image."""
HIGHEST = 3.0
"""m; of a small robot's camera."""
FARTHEST_FORWARD = 1.5
"""m, ahead of the axle or behind it."""
EQUAL_PARTS = 64
"""Radii at which the distortion is examined."""


def examine(description: RobotDescription) -> Iterator[Finding]:
    """Compare the declared camera with what cameras are like."""
    from mapweave.vision.lens import NO_DISTORTION

    camera = description.camera
    found = faults(description)
    if found:
        yield wrong(SUBJECT, "; ".join(found), f"measure them, or: {CALIBRATE}")
        return
    words = (
        f"{camera.width}x{camera.height} px, {math.degrees(_view(camera)):.0f} degrees wide, lens "
        f"{camera.mount_height:g} m high and {camera.mount_forward:g} m ahead of the axle"
    )
    if description.distortion == NO_DISTORTION:
        yield warning(SUBJECT, f"{words}; no distortion is declared", f"most lenses have some: {CALIBRATE}")
    else:
        yield good(SUBJECT, words)


def faults(description: RobotDescription | Recording) -> list[str]:
    """What of a camera can hardly be right."""
    camera = description.camera
    view = _view(camera)
    found = []
    if not NARROWEST <= view <= WIDEST:
        found.append(f"fx = {camera.fx:g} px makes the field of view {math.degrees(view):.0f} degrees")
    if abs(camera.fx / camera.fy - 1.0) > SQUARE:
        found.append(f"fx = {camera.fx:g} and fy = {camera.fy:g} px are not the same")
    for name, centre, size in (("cx", camera.cx, camera.width), ("cy", camera.cy, camera.height)):
        if abs(centre - size / 2.0) > CENTRED * size:
            found.append(f"{name} = {centre:g} is far from the middle of {size} px")
    radius = folding_radius(description)
    if radius is not None:
        found.append(f"the distortion folds the image back at {radius:.0f} px from its middle")
    if not 0.01 <= camera.mount_height <= HIGHEST:
        found.append(f"height_m = {camera.mount_height:g} is not the height of a robot's camera")
    if abs(camera.mount_forward) > FARTHEST_FORWARD:
        found.append(f"forward_m = {camera.mount_forward:g} is farther from the axle than a robot is long")
    return found


def recorded_faults(recording: Recording) -> list[str]:
    """The same of a recording's camera, a line each with what to do."""
    return [f"camera: {fault}: measure it, or: {CALIBRATE}" for fault in faults(recording)]


def _view(camera: Camera) -> float:
    """Horizontal field of view, rad."""
    return 2.0 * math.atan(camera.width / (2.0 * camera.fx))


def folding_radius(description: RobotDescription | Recording) -> float | None:
    """Where the radial distortion turns back within the image, px from the principal point; None if nowhere.

    r (1 + k1 r^2 + k2 r^4 + k3 r^6) must grow with r up to the corner.
    """
    camera, lens = description.camera, description.distortion
    if not isinstance(lens, tuple):
        return None  # a fisheye that folds is refused by the settings
    k1, k2, _, _, k3 = lens
    corner = math.hypot(
        max(camera.cx, camera.width - camera.cx) / camera.fx,
        max(camera.cy, camera.height - camera.cy) / camera.fy,
    )
    for step in range(1, EQUAL_PARTS + 1):
        square = (corner * step / EQUAL_PARTS) ** 2
        if 1.0 + 3.0 * k1 * square + 5.0 * k2 * square**2 + 7.0 * k3 * square**3 <= 0.0:
            return corner * step / EQUAL_PARTS * camera.fx
    return None
