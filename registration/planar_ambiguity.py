"""The second pose from which a flat object looks almost the same.

From afar a wall with prints looks the same from a mirrored position on the other side of its middle: only
perspective distinguishes the two, which is second order in its size over its distance (the two-fold ambiguity
of planar pose; Schweighofer and Pinz 2006, Collins and Bartoli 2014). Refinement from one pose does not reach
the other, so it is tried explicitly.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Pose2, wrap_angle


def mirrored(pose: Pose2, points: NDArray[Any]) -> Pose2:
    """Reflect a pose in the plane that stands on the line through points, in their middle.

    The middle of the points keeps its bearing. Twice mirrored is where it was.

    Args:
        pose: of the robot, in the points' frame.
        points: (N, 2) m, seen from above, N > 1.
    """
    middle = points.mean(axis=0)
    line = np.linalg.svd(points - middle, full_matrices=False)[2][0]
    away = np.array([pose.x, pose.y]) - middle
    mirrored_position = away - 2.0 * float(away @ line) * line
    turned = math.atan2(mirrored_position[1], mirrored_position[0]) - math.atan2(away[1], away[0])
    x, y = middle + mirrored_position
    return Pose2(float(x), float(y), wrap_angle(pose.heading + turned))
