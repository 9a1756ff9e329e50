"""Rows that keep their places, and know since when they are what they are.

A viewer that has all rows as of some version needs only those that have changed since. So a difference costs
no memory for each viewer, and one that is slow skips what it missed.
"""

import base64
from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray


class RowTable:
    """Rows by key. A row that is all zeros is in use by no key.

    Attributes:
        rows: (N,) structured, one row a slot.
        slots: slot of each key.
    """

    def __init__(self, fields: Sequence[tuple[str, str]]) -> None:
        """Begin without rows.

        Args:
            fields: name and NumPy type of each column, little-endian.
        """
        self.rows: NDArray[Any] = np.zeros(0, list(fields))
        self.slots: dict[Hashable, int] = {}
        self._changed = np.zeros(0, np.int64)
        self._free: list[int] = []

    def replace(self, keys: Sequence[Hashable], rows: NDArray[Any], version: int) -> bool:
        """Hold exactly these rows.

        Args:
            keys: of the rows, no key twice.
            rows: (K,) in the same order, none of them all zeros.
            version: which is noted at the rows that change; greater than all before.

        Returns:
            Whether any row has changed.
        """
        gone = self.slots.keys() - set(keys)
        empty = np.array([self.slots.pop(key) for key in gone], np.int64)
        new = [key for key in keys if key not in self.slots]
        self._free += empty.tolist()
        self._grow(len(new) - len(self._free))
        for key in new:
            self.slots[key] = self._free.pop()
        at = np.array([self.slots[key] for key in keys], np.int64)
        before = self.rows.copy()
        self.rows[empty] = np.zeros(1, self.rows.dtype)
        self.rows[at] = rows
        # Bytes are compared, since a number that is none differs from itself.
        width = (len(self.rows), self.rows.dtype.itemsize)
        differs = (self.rows.view(np.uint8).reshape(width) != before.view(np.uint8).reshape(width)).any(1)
        self._changed[differs] = version
        return bool(differs.any())

    def columns(self, since: int) -> dict[str, Any]:
        """The rows that have changed after a version; 0 for all.

        Returns:
            `count` of all slots; `rows`, the slots that are given, `<u4`, unless these are all; and each
            column, all in base64.
        """
        picked = np.arange(len(self.rows)) if since == 0 else np.flatnonzero(self._changed > since)
        some, out = self.rows[picked], {"count": len(self.rows)}
        columns = {name: some[name] for name in self.rows.dtype.names or ()}
        if since:
            columns = {"rows": picked.astype("<u4"), **columns}
        return out | {name: base64.b64encode(column.tobytes()).decode() for name, column in columns.items()}

    def _grow(self, by: int) -> None:
        if by <= 0:
            return
        first = len(self.rows)
        self._free += reversed(range(first, first + by))
        self.rows = np.concatenate([self.rows, np.zeros(by, self.rows.dtype)])
        self._changed = np.concatenate([self._changed, np.zeros(by, np.int64)])
