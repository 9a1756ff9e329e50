"""The floor as the robot drives over it: heights of the camera over points that it passes later.

No road is a plane for as far as it is seen: over a crest, or from a street into a crossing, a plane through
what lies ahead misses the camera's height by several percent, all along the bend to the same side. But where
the robot drives, the floor is where its wheels have been. So each point is held against the camera at the
time when it was nearest to that point, along the motions that the image pairs since have shown. What was not
driven over yet, or lies aside, is seen from the nearest place all the same, and its slope from there is
unknown (`floor_scale.py`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapweave.agent.calibration.camera_motions import CameraMotions
from mapweave.hybridmap.pose import Array

FOLLOWED = 24
"""Image pairs over which the way is followed from each: floor is looked for as far off as 8 heights of the
camera (`FLOOR_STEEPNESS`), and a pair is up to half a height long, or little longer; a few more for turns."""


@dataclass(eq=False)
class DrivenStep:
    """The way of one image pair. Pairs before it keep it, too.

    Attributes:
        number: one more than that of the step before.
        last_s: stamp of its second image, s.
        at: the motion that it shows, one.
    """

    number: int
    last_s: float
    at: CameraMotions


def follow(ways: list[list[DrivenStep]], first_s: float, last_s: float, at: CameraMotions) -> None:
    """Begin the way of another pair, and let it go on the ways that end where it begins.

    Args:
        ways: of the pairs so far, the newest last; FOLLOWED steps each at most.
        first_s: stamp of the pair's first image, s.
        last_s: of its second.
        at: the motion that it shows.
    """
    before = ways[-1][0] if ways else None
    step = DrivenStep(before.number + 1 if before else 0, last_s, at)
    if before is not None and before.last_s == first_s:
        for way in ways[-FOLLOWED:]:
            if len(way) < FOLLOWED and way[-1] is before:
                way.append(step)
    ways.append([step])


def heights_over(
    points: Sequence[Array], ways: Sequence[Sequence[DrivenStep]], down: Array
) -> tuple[Array, Array]:
    """Heights of the camera over points, where it came nearest to them.

    Args:
        points: of each pair, (K, 3) m in its first camera.
        ways: of each pair, from its first image on; none is empty.
        down: (3,) unit vector to the floor in the camera.

    Returns:
        (N,) heights over all points in a row, m, and (N,) how far off along the floor each is from where the
        camera was, m, negative behind.
    """
    steps = sorted({step for way in ways for step in way}, key=lambda step: step.number)
    place = {step: k for k, step in enumerate(steps)}
    # All cameras in the frame of the oldest. Those of one way are in a row.
    turned, centre = np.empty((len(steps) + 1, 3, 3)), np.zeros((len(steps) + 1, 3))
    turned[0] = np.eye(3)
    for k, step in enumerate(steps):
        turned[k + 1] = turned[k] @ step.at.rotation.T
        centre[k + 1] = centre[k] - turned[k + 1] @ step.at.translation
    begins, lengths = np.array([place[way[0]] for way in ways]), np.array([len(way) for way in ways])
    cameras = begins[:, None] + np.minimum(np.arange(lengths.max() + 1), lengths[:, None])
    counts = np.array([len(some) for some in points])
    own = np.repeat(np.arange(len(ways)), counts)
    at, first = np.concatenate(points), turned[begins]
    # Nearest to P is the camera C with the least |C|^2 - 2 P C, both from the pair's first camera.
    along = (centre[cameras] - centre[begins, None]) @ first
    padded = np.zeros((len(ways), counts.max(), 3))
    inside = np.arange(counts.max()) < counts[:, None]
    padded[inside] = at
    far = (along * along).sum(axis=2)[:, None] - 2.0 * padded @ np.swapaxes(along, 1, 2)
    nearest = far.argmin(axis=2)[inside]
    off = at - along[own, nearest]
    downs = (turned[cameras[own, nearest]] @ down)[:, None] @ first[own]
    heights = (off[:, None] @ downs[..., 0, :, None])[:, 0, 0]
    aside = np.sqrt(np.maximum((off * off).sum(axis=1) - heights**2, 0.0))
    return heights, np.copysign(aside, off[:, 2])
