"""What of a camera by ROS, its CameraInfo and its mount by tf, is not used or can hardly be right."""

import math
from typing import Any

from mapweave.agent.ros_messages.values import Mount

MOST_OFF = math.radians(3.0)
"""A camera that looks so far from straight ahead by tf is named."""
MOST_LEFT = 0.05
"""m; likewise one that is so far from the middle."""


def doubts(message: Any, mount: Mount | None, rectified: bool = False) -> list[str]:
    """What to say of a camera, a line each.

    Args:
        message: a CameraInfo of ROS 1 or ROS 2.
        mount: of the camera; None if it is unknown.
        rectified: whether its images are without distortion, and the coefficients are not used.
    """
    lines = []
    coefficients = getattr(message, "d", getattr(message, "D", ()))
    if len(coefficients) == 3 and any(coefficients) and not rectified:
        lines.append(
            "the camera has 3 coefficients of distortion, taken for k1, k2, p1; is the third k3? There must "
            "be 4 or 5 (k1, k2, p1, p2, k3): calibrate it again"
        )
    if mount is None:
        return lines
    if abs(mount.left) > MOST_LEFT:
        lines.append(f"the camera is {mount.left:.2f} m to the left, which is not taken into account")
    if abs(mount.heading) > MOST_OFF:
        lines.append(
            f"the camera looks {math.degrees(mount.heading):.0f} deg to the left: it should look ahead"
        )
    if abs(mount.pitch) > MOST_OFF:
        way = "down" if mount.pitch > 0.0 else "up"
        lines.append(
            f"the camera looks {math.degrees(abs(mount.pitch)):.0f} deg {way} by tf, which is not taken into "
            "account: `mapweave calibrate drive` measures it, and a recording may have it as pitch_deg of "
            "--camera FILE"
        )
    return lines
