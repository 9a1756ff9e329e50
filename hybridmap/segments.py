"""How near straight ways pass to places."""

import numpy as np

from mapweave.hybridmap.pose import Array


def distances(points: Array, begin: Array, end: Array) -> Array:
    """(K, N) m, distance of each point from each segment.

    Args:
        points: (K, 2) m.
        begin: (N, 2) m, in the same frame; where the segments begin.
        end: (N, 2) m; a segment may have no length.
    """
    along = end - begin
    to = points[:, None] - begin
    length2 = (along * along).sum(axis=-1)
    share = np.clip((to * along).sum(axis=-1) / np.where(length2 > 0.0, length2, 1.0), 0.0, 1.0)
    return np.asarray(np.linalg.norm(to - share[..., None] * along, axis=-1))
