"""Absence: views that show nothing of what another robot has mapped there.

Two similar rooms look the same inside, but not outside their doors. Under a merge that takes one room for the
other, a robot that looks out of one door should see landmarks that were mapped from the other. A view should
show a landmark if it projects well into the image, from a distance and direction similar to where it was
mapped, and if the view has a depth in that direction that is no nearer: then nothing occludes it. A view that
should show many landmarks and shows almost none is evidence against the merge; one that shows some is
evidence for it.

**Why a true merge is safe.** Things are moved, people occlude them, descriptors fail. Under a true merge a
view that should show many landmarks shows none with a probability of at most ε (`missed`). The alternative is
a merge of places that share a part q of their appearance (`alike`). The odds against the merge are then
(1 - q) / ε where nothing is shown and q / (1 - ε) where something is; their expectation under a true merge is
at most 1, as in `mapweave.merge.mutual_exclusion.mutual_visibility`, and so is that of the mean over all
views of one place, which count once. The odds of different places multiply. No rate covers a building that
was redecorated between two views: so only views within an hour by one clock are compared, the odds are never
more than `most`, and by themselves they refute nothing: they count only where the robots' footprints are
evidence against a merge.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.merge.mutual_exclusion.trajectories import BodyTrajectory
from mapweave.merge.pose_graph.projected_view import ProjectedView
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from mapweave.registration.matching import match

MOST = 100.0
"""Odds against a merge are never more: that all things changed is as probable as this."""


NOTHING = 0.03
"""A view shows nothing if it shows at most this share of the landmarks that it should show."""
MISSED = 0.02
"""Largest share of such views that show nothing though the merge is true."""
ALIKE = 0.85
"""How often places that are taken for each other show the same."""
APART = 1.5
"""Views of places nearer to each other than this count once, m."""


@dataclass(frozen=True, eq=False)
class Views:
    """N views that should show something.

    Attributes:
        places: (N, 2) m, in merged: the middle of what they should show.
        expected: (N,) how many landmarks they should show.
        found: (N,) how many of these they show.
    """

    places: Array
    expected: NDArray[np.int64]
    found: NDArray[np.int64]

    def show_nothing(self) -> NDArray[np.bool_]:
        """(N,) which show nothing of what they should."""
        out: NDArray[np.bool_] = self.found <= NOTHING * self.expected
        return out

    def odds_against(self) -> Array:
        """(N,) odds against the merge that each gives."""
        out: Array = np.where(self.show_nothing(), (1.0 - ALIKE) / MISSED, ALIKE / (1.0 - MISSED))
        return out

    def place_numbers(self) -> NDArray[np.int64]:
        """(N,) number of each view's place."""
        seats = np.full(len(self.places), -1, np.int64)
        for k in range(len(seats)):
            if seats[k] < 0:
                ways = self.places - self.places[k]
                seats[(seats < 0) & (np.hypot(ways[:, 0], ways[:, 1]) < APART)] = seats.max(initial=-1) + 1
        return seats

    def evidence(self) -> float:
        """Natural logarithm of the odds against the merge."""
        if not len(self.places):
            return 0.0
        seats = self.place_numbers()
        means = np.bincount(seats, self.odds_against()) / np.bincount(seats)
        return min(float(np.log(means).sum()), math.log(MOST))


MOST_VIEWS = 80
"""Views of each robot that are looked at, evenly chosen."""
LEAST = 20
"""Landmarks that a view should show before it says anything."""


def negative_evidence(
    graph: PoseGraph,
    first: BodyTrajectory,
    second: BodyTrajectory,
) -> Views:
    """What the views of two robots should show of what the other one has mapped, and what they do show.

    Args:
        graph: the merged component that holds the nodes of both.
        first: of one robot.
        second: of another one, by the same clock.
    """
    rows: list[tuple[Array, int, int]] = []
    for observer, mapped in ((first, second), (second, first)):
        chosen = np.unique(np.linspace(0, len(observer.views) - 1, MOST_VIEWS).round().astype(np.int64))
        pairs = _nearby_pairs(graph, observer, mapped, chosen)
        for k in np.unique(pairs[:, 0]):
            compared = [
                _compare(graph, mapped.views[j], observer.views[k]) for j in pairs[pairs[:, 0] == k, 1]
            ]
            points = np.concatenate([points for points, _ in compared])
            if len(points) >= LEAST:
                rows.append((points.mean(axis=0), len(points), sum(shown for _, shown in compared)))
    return Views(
        np.array([place for place, _, _ in rows]).reshape(-1, 2),
        np.array([expected for _, expected, _ in rows], np.int64),
        np.array([shown for _, _, shown in rows], np.int64),
    )


NEAR = 1.5
"""A view is held against nodes at most so far away, m."""
TURN = math.radians(50.0)
"""A view is held against nodes turned by at most this, rad."""
LASTING = 3600.0
"""A view is held against nodes made at most so much earlier or later, s."""
MOST_NODES = 4
"""A view is held against so many nodes at most, the nearest ones."""
SIGMA_XY = 0.15
"""A view is held against nodes whose relative position is known as well as this, m."""
SIGMA_HEADING = math.radians(3.0)
"""A view is held against nodes whose relative heading is known as well as this, rad."""


def _nearby_pairs(
    graph: PoseGraph,
    observer: BodyTrajectory,
    mapped: BodyTrajectory,
    chosen: NDArray[np.int64],
) -> NDArray[np.int64]:
    """(P, 2) views, and nodes of the other robot that might show the same, the nearest ones of each view."""
    observer_nodes, mapped_nodes = (
        [view.id for view in trajectory.views] for trajectory in (observer, mapped)
    )
    poses, mapped_poses = (
        graph.means[graph.index([observer_nodes[k] for k in chosen])],
        graph.means[graph.index(mapped_nodes)],
    )
    ways = np.hypot(*(poses[:, None, :2] - mapped_poses[None, :, :2]).transpose(2, 0, 1))
    turns = np.abs(np.angle(np.exp(1j * (poses[:, None, 2] - mapped_poses[None, :, 2]))))
    gaps = np.abs(observer.view_times[chosen][:, None] - mapped.view_times[None])
    ways[(turns > TURN) | (gaps > LASTING)] = np.inf
    nearest = np.argsort(ways, axis=1, kind="stable")[:, :MOST_NODES]
    i, j = np.nonzero(np.take_along_axis(ways, nearest, axis=1) < NEAR)
    pairs = np.stack([chosen[i], nearest[i, j]], axis=1)
    if not len(pairs):
        return pairs
    between = graph.relative(
        [observer_nodes[k] for k in pairs[:, 0]], [mapped_nodes[k] for k in pairs[:, 1]]
    ).covariances
    certain = np.linalg.eigvalsh(between[:, :2, :2])[:, -1] < SIGMA_XY**2
    out: NDArray[np.int64] = pairs[certain & (between[:, 2, 2] < SIGMA_HEADING**2)]
    return out


WITHIN = 0.15
"""A landmark is found if what matches it is this near to where it should be, rad."""


def _compare(graph: PoseGraph, node: Node, view: Node) -> tuple[Array, int]:
    """(K, 2) m, in merged, a node's landmarks that a view should show, and how many of them it shows."""
    merged_from_node = graph.pose(node.id)
    node_from_view = merged_from_node.inverse() @ graph.pose(view.id)
    shown, pixels = should_show(node, view, node_from_view)
    if not len(shown):
        return np.zeros((0, 2)), 0
    seats = np.full(len(node.landmarks), -1)
    seats[shown] = np.arange(len(shown))
    landmarks, features = match(node.landmarks.codes, view.landmarks.codes).T
    landmarks, features = seats[landmarks[seats[landmarks] >= 0]], features[seats[landmarks] >= 0]
    off = np.linalg.norm(pixels[landmarks] - view.landmarks.pixels[features], axis=1) / view.camera.fx
    return merged_from_node.apply(node.points_in_robot[shown][:, :2]), int((off < WITHIN).sum())


MARGIN = 0.04
"""A landmark should be seen if it projects this far inside the image, rad,"""
SCALE = 1.4
"""if its distance has changed by at most this factor,"""
ASIDE = math.radians(15.0)
"""if it is seen from a direction that differs by at most this, rad,"""
AROUND = 0.1
"""if the view knows a depth this near to it in the image, rad,"""
BEFORE = 0.8
"""and none there of less than this share of the landmark's distance."""


def should_show(node: Node, view: Node, node_from_view: Pose2) -> tuple[NDArray[np.int64], Array]:
    """Which of a node's landmarks a view should show, and (K, 2) px where.

    Args:
        node: that has mapped them.
        view: another node.
        node_from_view: relative pose.
    """
    projection = ProjectedView.of(node, view, node_from_view, MARGIN * view.camera.fx, SCALE, ASIDE)
    shown = np.flatnonzero(projection.fits)
    with_depth = view.landmarks.take(view.landmarks.has_depth)
    off = np.linalg.norm(projection.pixels[shown, None] - with_depth.pixels[None], axis=2) / view.camera.fx
    about, before = off < AROUND, with_depth.depths[None] < BEFORE * projection.depths[shown, None]
    clear = (about & ~before).any(axis=1) & ~(about & before).any(axis=1)
    return shown[clear], projection.pixels[shown[clear]]
