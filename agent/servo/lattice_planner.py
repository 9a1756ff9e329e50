"""The plan that finds any way there is: cost to the goal over a lattice of poses, then shortened.

For what two legs cannot do (a wall behind, landmarks on one side). States are cells of a grid times 32
headings that lead from cell to cell; moves are a step forward, a step backward and a turn to the next
heading. The cost to the goal of all states at once is found by value iteration with shifted arrays. The way
that descends it is then shortened: its points are joined by straight legs wherever those keep the exact
constraints.
"""

import math

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.servo.plan import LEG_PRICE, TURN_PRICE, Leg, ServoPlan, Surroundings, cost_of, sample
from mapweave.hybridmap.pose import Array, Pose2, wrap_angle

_FIRST_OCTANT = ((1, 0), (3, 1), (2, 1), (3, 2))
"""Directions of motion in cells, from 0 to 45 degrees; 32 in all, 7 to 18 degrees apart."""
FARTHEST = 5.0
"""m; the grid covers start and goal, and its size grows with the square of their distance. The servo is given
nodes within 1.4 m (DETECTION_REACH of the route follower), and parks in `benchmarks.servo` from up to
2.5 m."""

_BORDER = 3
"""Cells beside the grid: the longest move along one axis."""
_BINS = 72
"""Headings of which it is known whether landmarks stay in view: each 5 degrees."""


def _compass() -> tuple[NDArray[np.intp], Array]:
    """(32, 2) steps in cells, and (32,) their headings, rad ascending from 0."""
    octants = [(a, b) for a, b in _FIRST_OCTANT]
    quadrant = octants + [(1, 1)] + [(b, a) for a, b in reversed(octants[1:])]
    steps: list[tuple[int, int]] = []
    for _ in range(4):
        steps += quadrant
        quadrant = [(-b, a) for a, b in quadrant]
    array = np.array(steps, dtype=np.intp)
    return array, np.arctan2(array[:, 1], array[:, 0]) % (2.0 * math.pi)


_STEPS, _HEADINGS = _compass()
_COUNT = len(_STEPS)
_MOST_POINTS = 26
"""Points of a way that is shortened."""


def lattice_plan(
    surroundings: Surroundings,
    start: Pose2,
    margin: float,
    cell: float = 0.1,
    room: float = 1.2,
) -> ServoPlan | None:
    """A cheap admissible plan of any number of legs.

    Args:
        surroundings: constraints.
        start: pose in goal.
        margin: slack to keep, rad.
        cell: m.
        room: m of floor around start and goal that is searched.

    Returns:
        The plan, or None if the lattice knows no way, or the start is further away than FARTHEST.
    """
    if not math.hypot(start.x, start.y) <= FARTHEST:
        return None
    low = np.floor((np.minimum([start.x, start.y], 0.0) - room) / cell).astype(int)
    high = np.ceil((np.maximum([start.x, start.y], 0.0) + room) / cell).astype(int)
    x, y = np.meshgrid(
        cell * np.arange(low[0], high[0] + 1), cell * np.arange(low[1], high[1] + 1), indexing="ij"
    )
    # Row by row: all cells, headings and landmarks at once would take hundreds of megabytes.
    slack = surroundings.field.slack_table
    allowed = np.stack([slack(*row, _HEADINGS) >= margin for row in zip(x, y, strict=True)], axis=1)
    free = _free_half_cells(surroundings, start, low, high, cell)
    allowed &= free[::2, ::2]
    goal = (0, int(-low[0]), int(-low[1]))
    near = _nearest(allowed, start, low, cell)
    if near is None or not allowed[goal]:
        return None
    costs = _costs_to_go(allowed, free, goal, cell)
    if not np.isfinite(costs[near]):
        return None
    states = _descend(costs, free, near, goal, cell)
    points = np.array([[cell * (i + low[0]), cell * (j + low[1])] for _, i, j in states])
    return _shorten(surroundings, start, _thin(points), margin)


def _free_half_cells(
    surroundings: Surroundings, start: Pose2, low: NDArray[np.intp], high: NDArray[np.intp], cell: float
) -> NDArray[np.bool_]:
    """(2X-1, 2Y-1) whether cells and the points half way between them are clear of obstacles.

    Away from start and goal a little more clearance is required: the way between two points must be clear.
    """
    x, y = np.meshgrid(
        0.5 * cell * np.arange(2 * low[0], 2 * high[0] + 1),
        0.5 * cell * np.arange(2 * low[1], 2 * high[1] + 1),
        indexing="ij",
    )
    near = np.minimum(np.hypot(x, y), np.hypot(x - start.x, y - start.y)) < 1.5 * cell
    wanted = surroundings.clearance + np.where(near, 0.0, 0.2 * cell)
    rows = zip(np.stack([x, y], axis=-1), wanted, strict=True)
    return np.stack([surroundings.distance(points) >= enough for points, enough in rows])


def _nearest(
    allowed: NDArray[np.bool_], start: Pose2, low: NDArray[np.intp], cell: float
) -> tuple[int, int, int] | None:
    """The allowed state nearest to the start, within a cell and two headings."""
    i, j = round(start.x / cell) - int(low[0]), round(start.y / cell) - int(low[1])
    best, nearest = math.inf, None
    for di in (-1, 0, 1):
        for dj in (-1, 0, 1):
            for h in range(_COUNT):
                turn = abs(wrap_angle(float(_HEADINGS[h]) - start.heading))
                if turn > 0.45 or not allowed[h, i + di, j + dj]:
                    continue
                aside = math.hypot(
                    (i + di + int(low[0])) * cell - start.x, (j + dj + int(low[1])) * cell - start.y
                )
                if aside + 0.3 * turn < best:
                    best, nearest = aside + 0.3 * turn, (h, i + di, j + dj)
    return nearest


def _costs_to_go(
    allowed: NDArray[np.bool_],
    free: NDArray[np.bool_],
    goal: tuple[int, int, int],
    cell: float,
) -> Array:
    """(32, X, Y) m, infinite where no way leads to the goal.

    Args:
        allowed: (32, X, Y) admissible states.
        free: (2X-1, 2Y-1) points clear of obstacles, half cells apart.
        goal: state.
        cell: m.
    """
    headings, nx, ny = allowed.shape
    b = _BORDER
    padded = np.full((headings, nx + 2 * b, ny + 2 * b), np.inf)
    costs: Array = padded[:, b : b + nx, b : b + ny]
    costs[goal] = 0.0
    wall = np.where(allowed, 0.0, np.inf)
    halves = np.full((2 * nx - 1 + 2 * b, 2 * ny - 1 + 2 * b), np.inf)
    halves[b:-b, b:-b] = np.where(free, 0.0, np.inf)
    turn = TURN_PRICE * np.diff(np.append(_HEADINGS, 2.0 * math.pi))
    way = cell * np.hypot(_STEPS[:, 0], _STEPS[:, 1])
    # What a move costs from each cell: its length, or infinity through an obstacle half way.
    moves = [
        [
            w + halves[b + dx : b + dx + 2 * nx - 1 : 2, b + dy : b + dy + 2 * ny - 1 : 2] + wall[h]
            for dx, dy in (step, -step)
        ]
        for h, (w, step) in enumerate(zip(way, _STEPS, strict=True))
    ]
    previous = np.inf
    for sweep in range(400):
        if sweep % 4 == 0:
            total = float(np.where(np.isfinite(costs), costs, 1e3).sum())
            if total == previous:
                break
            previous = total
        for h in range(headings):
            dx, dy = _STEPS[h]
            ahead = padded[h, b + dx : b + dx + nx, b + dy : b + dy + ny] + moves[h][0]
            behind = padded[h, b - dx : b - dx + nx, b - dy : b - dy + ny] + moves[h][1]
            np.minimum(ahead, behind, out=ahead)
            np.minimum(costs[h], ahead, out=costs[h])
        for h in [*range(headings), *range(headings)]:
            np.minimum(costs[h], costs[h - 1] + turn[h - 1] + wall[h], out=costs[h])
        for h in [*reversed(range(headings)), *reversed(range(headings))]:
            after = (h + 1) % headings
            np.minimum(costs[h], costs[after] + turn[h] + wall[h], out=costs[h])
    return costs


def _descend(
    costs: Array,
    free: NDArray[np.bool_],
    state: tuple[int, int, int],
    goal: tuple[int, int, int],
    cell: float,
) -> list[tuple[int, int, int]]:
    """The states along the cheapest moves from a state to the goal."""
    _, nx, ny = costs.shape
    states = [state]
    for _ in range(1000):
        if state == goal:
            break
        h, i, j = state
        options: list[tuple[float, tuple[int, int, int]]] = []
        for side in (-1, 1):
            neighbour = (h + side) % _COUNT
            turned = abs(wrap_angle(float(_HEADINGS[neighbour] - _HEADINGS[h])))
            options.append((float(costs[neighbour, i, j]) + TURN_PRICE * turned, (neighbour, i, j)))
            a, b = i + side * int(_STEPS[h, 0]), j + side * int(_STEPS[h, 1])
            if 0 <= a < nx and 0 <= b < ny and free[i + a, j + b]:
                step = cell * math.hypot(*_STEPS[h])
                options.append((float(costs[h, a, b]) + step, (h, a, b)))
        state = min(options)[1]
        states.append(state)
    return states


def _thin(points: Array) -> Array:
    """Keep at most so many of a way's points: first its corners, then points between, evenly."""
    moved = np.append(True, np.abs(np.diff(points, axis=0)).sum(axis=1) > 0)
    points = points[moved]
    if len(points) <= _MOST_POINTS:
        return points
    steps = np.diff(points, axis=0)
    corner = np.abs(np.diff(steps, axis=0)).sum(axis=1) > 1e-9
    keep = np.flatnonzero(np.concatenate([[True], corner, [True]]))
    extra = np.linspace(0, len(points) - 1, max(_MOST_POINTS - len(keep), 0)).round().astype(int)
    chosen: Array = points[np.union1d(keep, extra)]
    return chosen


def _shorten(surroundings: Surroundings, start: Pose2, way: Array, margin: float) -> ServoPlan | None:
    """The cheapest sequence of exact legs over a way's points."""
    points = np.concatenate([[[start.x, start.y]], way])
    first, last = np.triu_indices(len(points), 1)
    first, last = np.repeat(first, 2), np.repeat(last, 2)
    delta = points[last] - points[first]
    length = np.hypot(delta[:, 0], delta[:, 1])
    heading = np.arctan2(delta[:, 1], delta[:, 0])
    direction = np.tile([1.0, -1.0], len(first) // 2)
    heading = np.where(direction > 0, heading, heading + math.pi)
    along = np.linspace(0.0, 1.0, 12)[:, None]
    poses = np.concatenate(
        [
            points[first][:, None] + along * delta[:, None],
            np.broadcast_to(heading[:, None, None], (len(first), 12, 1)),
        ],
        axis=-1,
    )
    fine = (length > 1e-6) & surroundings.allowed(poses, margin).all(axis=1)
    first, last, heading, length, direction = (a[fine] for a in (first, last, heading, length, direction))
    best, before = _cheapest(surroundings, points, start, first, last, heading, length, margin)
    turned_home = best + TURN_PRICE * np.abs(np.mod(heading + math.pi, 2.0 * math.pi) - math.pi)
    ends = np.flatnonzero((last == len(points) - 1) & np.isfinite(turned_home))
    for end in ends[np.argsort(turned_home[ends], kind="stable")][:3].tolist():
        chain = [end]
        while before[chain[-1]] >= 0:
            chain.append(int(before[chain[-1]]))
        legs: list[Leg] = []
        branch = start.heading
        for k in reversed(chain):
            branch += wrap_angle(float(heading[k]) - branch)
            x, y = points[last[k]].tolist()
            legs.append(Leg(branch, float(direction[k]), x, y, float(length[k])))
        if surroundings.allowed(sample(start, legs), 0.7 * margin).all():
            return ServoPlan(start, tuple(legs), cost_of(start, legs), margin)
    return None


def _cheapest(
    surroundings: Surroundings,
    points: Array,
    start: Pose2,
    first: NDArray[np.intp],
    last: NDArray[np.intp],
    heading: Array,
    length: Array,
    margin: float,
) -> tuple[Array, NDArray[np.intp]]:
    """Cheapest cost (m) of a chain of legs that ends with each leg, and the leg before it (-1: the first)."""
    grid = np.linspace(0.0, 2.0 * math.pi, _BINS, endpoint=False)
    blind = surroundings.field.slack_table(points[:, 0], points[:, 1], grid) < margin
    # Forbidden headings summed along the circle (three times round): a turn is free if the sum stays.
    sums = np.cumsum(np.tile(blind.T, (1, 3)), axis=1)
    best, before = np.full(len(first), np.inf), np.full(len(first), -1, dtype=np.intp)
    for vertex in range(len(points) - 1):
        leaving = np.flatnonzero(first == vertex)
        arriving = np.flatnonzero((last == vertex) & np.isfinite(best))
        origins = np.array([start.heading]) if vertex == 0 else heading[arriving]
        if not len(leaving) or not len(origins):
            continue
        reached = np.zeros(1) if vertex == 0 else best[arriving]
        turn = np.mod(heading[leaving][:, None] - origins + math.pi, 2.0 * math.pi) - math.pi
        low = np.mod(np.minimum(origins, origins + turn), 2.0 * math.pi) / (2.0 * math.pi) * _BINS + _BINS
        high = low + np.abs(turn) / (2.0 * math.pi) * _BINS
        free = sums[vertex][np.floor(high).astype(int)] == sums[vertex][np.floor(low).astype(int)]
        cost = np.where(free, reached + TURN_PRICE * np.abs(turn), np.inf)
        choice = cost.argmin(axis=1)
        best[leaving] = cost[np.arange(len(leaving)), choice] + length[leaving] + LEG_PRICE
        if vertex > 0:
            before[leaving] = arriving[choice]
    return best, before
