"""All panels of a moment in columns, with what the renderer needs of each."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array
from mapweave.sim.world import PanelSet


class Scene:
    """Panel sets side by side, each of which can be moved or exchanged as a whole.

    Attributes:
        corner: (N, 3) m, in world.
        along: (N, 3) m.
        down: (N, 3) m.
        normal: (N, 3) m2, `along` x `down`: away from who sees the panel's front.
        middle: (N, 3) m, in world.
        radius: (N,) m, of the ball around the middle that holds the panel.
        textures: N.
    """

    def __init__(self, sets: Sequence[PanelSet]) -> None:
        """Put sets side by side; their numbers are their places in the sequence."""
        self._sets = list(sets)
        ends = np.cumsum([len(panel_set.textures) for panel_set in sets], dtype=int).tolist()
        self._spans = [
            slice(end - len(panel_set.textures), end) for end, panel_set in zip(ends, self._sets, strict=True)
        ]
        joined = PanelSet.joined(self._sets) if self._sets else PanelSet.of([])
        self.corner = joined.corner
        self.along = joined.along
        self.down = joined.down
        self.normal: Array = cross(self.along, self.down)
        self.middle: Array = self.corner + (self.along + self.down) / 2
        diagonals = np.stack([self.along + self.down, self.along - self.down])
        self.radius: Array = np.sqrt((diagonals**2).sum(axis=-1)).max(axis=0) / 2
        self.textures = joined.textures

    def place(self, number: int, rotation: NDArray[np.float64], position: NDArray[np.float64]) -> None:
        """Move a panel set.

        Args:
            number: of the set.
            rotation: (3, 3) turns vectors of the set's frame into world.
            position: (3,) m, of the set's origin in world.
        """
        span, own = self._spans[number], self._sets[number]
        turned = rotation.T
        self.corner[span] = own.corner @ turned + position
        self.along[span] = along = own.along @ turned
        self.down[span] = down = own.down @ turned
        self.normal[span] = cross(along, down)
        self.middle[span] = self.corner[span] + (along + down) / 2


def cross(a: Array, b: Array) -> Array:
    """`np.cross` of (n, 3) with (n, 3), in a fifth of its time for small n."""
    return a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]
