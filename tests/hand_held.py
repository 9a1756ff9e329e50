"""Nodes of a hand-held camera: tilted, off their height, of unknown scale."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from mapweave.hybridmap.node import Landmarks, Node

SCALE_SHARE = 0.3


def photograph(
    node: Node, scale: float = 1.0, pitch: float = 0.0, roll: float = 0.0, rise: float = 0.0
) -> Node:
    """What a node would have been if its camera had been held otherwise.

    Args:
        node: of a level camera.
        scale: by which all depths come out too large.
        pitch: rad, camera nods down.
        roll: rad, camera leans to the right.
        rise: m, by which the camera stands too high.
    """
    camera, known = node.camera, node.landmarks.take(node.landmarks.has_depth)
    centre = np.array([camera.mount_forward, 0.0, camera.mount_height + rise])
    # About the axes that stand still, x first.
    held = Rotation.from_euler("xy", [roll, pitch]).as_matrix()
    local = (known.points_in_robot(camera) - centre) @ held
    seen = camera.project(local + np.array([camera.mount_forward, 0.0, camera.mount_height]))
    inside = camera.contains(seen)
    depths = (scale * local[inside, 0]).astype(np.float32)
    landmarks = Landmarks(
        seen[inside].astype(np.float32),
        known.codes[inside],
        depths,
        (SCALE_SHARE * depths).astype(np.float32),
    )
    return replace(node, landmarks=landmarks)
