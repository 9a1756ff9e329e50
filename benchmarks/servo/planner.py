"""The shortest path that keeps enough landmarks in view, by a planner that shares nothing with the servo.

Dijkstra (scipy) over a lattice of 5 cm cells and 96 headings with free turns on the spot. Its lengths are
within a few per cent of those of a finer lattice; where it finds no path, a start is taken to have none.
"""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from benchmarks.servo.world import LEAST_VISIBLE, Task, in_view
from mapweave.hybridmap.pose import Array

_CELL = 0.05
"""Of the lattice, m."""
_REACH = 6
_TURN_PRICE = 1e-4


def shortest_length(task: Task) -> float | None:
    """Length (m) of the shortest path, or None if there is none."""
    path = _lattice_path(task)
    if path is None:
        return None
    steps = np.diff(path[:, :2], axis=0)
    return float(np.hypot(steps[:, 0], steps[:, 1]).sum())


def _fine(poses: Array, task: Task) -> NDArray[np.bool_]:
    seen: NDArray[np.bool_] = in_view(poses, task.points).sum(axis=-1) >= LEAST_VISIBLE
    return seen


def _directions() -> tuple[NDArray[np.intp], Array]:
    """(H, 2) coprime steps in cells and their headings (H,), ascending."""
    span = range(-_REACH, _REACH + 1)
    steps = np.array([(a, b) for a in span for b in span if math.gcd(a, b) == 1], dtype=np.intp)
    headings = np.arctan2(steps[:, 1], steps[:, 0])
    order = np.argsort(headings)
    return steps[order], headings[order]


def _lattice_path(task: Task) -> Array | None:
    """(M, 3) x m, y m, heading rad: lattice poses from start to goal, start and goal themselves exact."""
    steps, headings = _directions()
    start = task.start
    behind, ahead = np.array([1.5, 0.8]), np.array([1.0, 0.8])
    low = np.floor((np.minimum([start.x, start.y], 0.0) - behind) / _CELL).astype(int)
    high = np.ceil((np.maximum([start.x, start.y], 0.0) + ahead) / _CELL).astype(int)
    nx, ny = (high - low + 1).tolist()
    i, j = np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij")
    x, y = (i + low[0]) * _CELL, (j + low[1]) * _CELL
    allowed = np.stack([_fine(np.stack([x, y, np.full(x.shape, h)], axis=-1), task) for h in headings])
    index = np.arange(allowed.size).reshape(allowed.shape)
    rows, columns, costs = [], [], []
    for k, (dx, dy) in enumerate(steps):
        a, b, c, d = max(0, -dx), nx - max(0, dx), max(0, -dy), ny - max(0, dy)
        here, there = np.s_[k, a:b, c:d], np.s_[k, a + dx : b + dx, c + dy : d + dy]
        both = allowed[here] & allowed[there]
        rows.append(index[here][both])
        columns.append(index[there][both])
        costs.append(np.full(both.sum(), _CELL * math.hypot(dx, dy)))
        following = (k + 1) % len(steps)
        both = allowed[k] & allowed[following]
        rows.append(index[k][both])
        columns.append(index[following][both])
        costs.append(np.full(both.sum(), _TURN_PRICE))
    graph = coo_matrix(
        (np.concatenate(costs), (np.concatenate(rows), np.concatenate(columns))), shape=(allowed.size,) * 2
    ).tocsr()
    goal = index[int(np.abs(headings).argmin()), -low[0], -low[1]]
    distance, before = dijkstra(graph, directed=False, indices=goal, return_predecessors=True)
    away = np.hypot(x - start.x, y - start.y)
    turned = np.abs(np.angle(np.exp(1j * (headings - start.heading))))
    near = (away[None] <= 1.1 * _CELL) & (turned[:, None, None] <= 0.2) & allowed
    total = np.where(near.ravel(), distance + np.broadcast_to(away, allowed.shape).ravel(), np.inf)
    state = int(total.argmin())
    if not np.isfinite(total[state]):
        return None
    path = [start.vector]
    while state != goal:
        heading, a, b = np.unravel_index(state, allowed.shape)
        path.append(np.array([x[a, b], y[a, b], headings[heading]]))
        state = int(before[state])
    path.append(np.zeros(3))
    return np.array(path)
