"""Bent maps: a little wrong everywhere, so that no line of sight refutes them.

Links of a bent map contradict each other, but each puts the map nearly where all others do. No second room is
so near to the first: the map is at that one place, and its geometry is wrong.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapweave.merge.pose_graph.fragments import Fragment
from mapweave.merge.pose_graph.links import Link
from mapweave.registration.pose_arrays import compose_poses, inverse_poses

AGREEING = 0.9
"""Two maps agree if this share of their links do: a few are false. Sound maps of the benchmark have 0.97 and
more, those of a robot with wrong geometry up to 0.75."""
BENT_XY, BENT_HEADING = 1.5, math.radians(30.0)
"""Placements that differ by less are of one place, m and rad: rooms that look alike are at least as far apart
as one is wide, and doors are 0.9 m wide alone."""
AT_ONCE = 1 << 14
"""Pairs of links, about, that are compared together: more take memory, and no less time."""


def is_bent(links: Sequence[Link], placed: Fragment, fixed: Fragment) -> bool:
    """Whether a map can be placed so that nearly all links have their nodes nearly there.

    Args:
        links: from `placed` to `fixed`, which contradict each other.
        placed: piece of map.
        fixed: piece of map.
    """
    return bool((nearly_there(links, placed, fixed).mean(axis=1) >= AGREEING).any())


def nearly_there(
    links: Sequence[Link],
    placed: Fragment,
    fixed: Fragment,
    most: tuple[float, float] = (BENT_XY, BENT_HEADING),
) -> NDArray[np.bool_]:
    """(N, N) whether the placement by link j has the node of link k nearly where link k has it.

    Args:
        links: from `placed` to `fixed`, at least one.
        placed: piece of map.
        fixed: piece of map.
        most: what is nearly, m and rad.
    """
    own = compose_poses(
        fixed.graph.means[fixed.graph.index([link.b for link in links])],
        inverse_poses(np.stack([link.a_from_b.mean.vector for link in links])),
    )
    inside = placed.graph.means[placed.graph.index([link.a for link in links])]
    placements = compose_poses(own, inverse_poses(inside))
    count, from_own = len(links), inverse_poses(own)
    near = np.empty((count, count), np.bool_)
    for first in range(0, count, rows := max(1, AT_ONCE // count)):
        some = placements[first : first + rows]
        laid = compose_poses(np.repeat(some, count, axis=0), np.tile(inside, (len(some), 1)))
        off = compose_poses(np.tile(from_own, (len(some), 1)), laid)
        fits = (np.hypot(off[:, 0], off[:, 1]) < most[0]) & (np.abs(off[:, 2]) < most[1])
        near[first : first + rows] = fits.reshape(len(some), count)
    return near
