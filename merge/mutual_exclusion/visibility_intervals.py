"""Looking: when one robot was near enough to see another one, and what its proximity sensors saw then."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array
from mapweave.merge.mutual_exclusion.trajectories import RobotTrajectory, Stay
from mapweave.merge.pose_graph.solved_graph import PoseGraph


@dataclass(frozen=True, eq=False)
class VisibilityInterval:
    """M observations of another robot's expected place, and their P rays.

    Attributes:
        moments: (M,) indices of their times.
        observers: (M,) rows in the graph of the observers' nodes.
        headings: (M,) rad, of the observers in the merged frame.
        levers: (M, 2) m, from that node to the observer, in the merged frame: it was on its way from it.
        others: (M,) rows of the other robot's nodes.
        other_levers: (M, 2) m, from that node to the other.
        offsets: (M, 2) m, from the observer to the other.
        spreads: (M, 2, 2) m^2, covariance of both poses relative to these nodes.
        radii: (M,) m, of the other.
        looks: (P,) observation of each ray, ascending.
        directions: (P, 2) of the rays, unit vectors in the merged frame.
        lengths: (P,) m, how far they went.
    """

    moments: NDArray[np.int64]
    observers: NDArray[np.int64]
    headings: Array
    levers: Array
    others: NDArray[np.int64]
    other_levers: Array
    offsets: Array
    spreads: Array
    radii: Array
    looks: NDArray[np.int64]
    directions: Array
    lengths: Array

    def __len__(self) -> int:
        return len(self.moments)

    def __add__(self, other: VisibilityInterval) -> VisibilityInterval:
        """These observations, then others."""
        pairs = {name: (getattr(self, name), getattr(other, name)) for name in self.__dataclass_fields__}
        pairs["looks"] = self.looks, other.looks + len(self)
        return VisibilityInterval(**{name: np.concatenate(pair) for name, pair in pairs.items()})

    def take(self, mask: NDArray[np.bool_]) -> VisibilityInterval:
        """Some of these observations, by a mask (M,)."""
        rays = ("looks", "directions", "lengths")
        of_rays = mask[self.looks]
        kept = {n: getattr(self, n)[of_rays if n in rays else mask] for n in self.__dataclass_fields__}
        kept["looks"] = (np.cumsum(mask) - 1)[kept["looks"]]
        return VisibilityInterval(**kept)


def visibility_intervals(
    graph: PoseGraph,
    observer: RobotTrajectory,
    poses: Array,
    other: RobotTrajectory,
    stay: Stay,
    times: Array,
) -> VisibilityInterval:
    """All observations of one robot with the other robot's expected place in reach.

    Args:
        graph: the merged component that holds the nodes of both.
        observer: its trajectory.
        poses: (N, 3) m, m and rad, where it was at each moment.
        other: the other's.
        stay: where the other one was at `times`.
        times: (T,) s, ascending; among them all times of the observer's trajectory that both have in common.
    """
    rows, other_rows = graph.index(observer.nodes), graph.index(other.nodes)[stay.nearest]
    at = np.minimum(np.searchsorted(times, observer.times), len(times) - 1)
    offsets = stay.places[at] - poses[:, :2]
    furthest = np.max(observer.looks.distances, axis=1, initial=0.0, where=observer.looks.seen)
    nearby = np.hypot(offsets[:, 0], offsets[:, 1]) < furthest + other.radius
    good = np.flatnonzero((times[at] == observer.times) & stay.known[at] & nearby & (other.radius > 0.0))
    moments = at[good]
    scans, sensors = np.nonzero(observer.looks.seen[good])
    angles = (poses[good, 2, None] + observer.looks.bearings[good])[scans, sensors]
    levers = poses[good, :2] - graph.means[rows[good], :2]
    return VisibilityInterval(
        moments=moments,
        observers=rows[good],
        headings=poses[good, 2],
        levers=levers,
        others=other_rows[moments],
        other_levers=stay.places[moments] - graph.means[other_rows[moments], :2],
        offsets=offsets[good],
        spreads=stay.spreads[moments] + observer.drifts[good, None, None] ** 2 * np.eye(2),
        radii=np.full(len(good), other.radius),
        looks=scans,
        directions=np.stack([np.cos(angles), np.sin(angles)], axis=1),
        lengths=observer.looks.distances[good][scans, sensors],
    )
