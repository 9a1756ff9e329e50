"""What a region of the map looks like elsewhere: told by the neighbours of a place, not by the place alone.

A view of one of two rooms that look the same may be like no node of the other room, since nobody has looked
there from that side. But the nodes around the place that was recognised have their doubles there, and all of
them imply one and the same motion from room to room. Where that takes the robot it may be as well: if what it
sees lies on what is there twice, or if nobody has looked there at where it would lie.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.node import MapId, Node, NodeId
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.mapserver.relocalization.alias_cache import AliasCache, AliasedNode
from mapweave.mapserver.relocalization.aliased_landmarks import between, same_place
from mapweave.mapserver.relocalization.candidates import Retrieval
from mapweave.mapserver.relocalization.place_hypotheses import THING_SIGMA, NodeMatch, extent
from mapweave.merge.pose_graph.merged_map import MergedMap

WELL_INSIDE = 0.85
"""Of a camera's semi-aperture: of what is nearer to the edge of its image a node keeps little."""
ALIKE_TURN, ALIKE_TIMES = math.radians(35.0), 1.6
"""A thing looks about the same from directions that differ less, and up to so many times as far away."""
IN_COMMON = 3
"""Matches that are in place: about one in 150 wrong ones is so by chance."""
UNTOLD_XY, UNTOLD_HEADING = 0.1, 0.05
"""m and rad, what a way between two nodes of a map that is not merged may be off."""


@dataclass(frozen=True)
class AliasedRegionSettings:
    """When the surroundings of a place count as being there twice.

    Attributes:
        least_nodes: nodes around it whose doubles imply the same motion. 0: regions are not looked at.
        least_share: of the landmarks that the view shows, how many must lie on what these doubles show.
        most_looked_at: how many of them may lie, in the other region, where somebody has looked and has not
            seen them, if the doubles show less. Then they must show more than one thing.
        least_around: nodes whose doubles must imply the same motion then. All but one must have a double of
            its own.
    """

    least_nodes: int = 2
    least_share: float = 0.5
    most_looked_at: float = 0.2
    least_around: int = 2


@dataclass(frozen=True, eq=False)
class Counterpart:
    """Where a robot may be as well, by what its surroundings look like.

    Attributes:
        node: the nearest there of those that look like a node here.
        node_from_robot: pose there.
        features: of the view, on what is or may be there twice.
        nodes: how many nodes here say so.
    """

    node: NodeId
    node_from_robot: PoseGaussian
    features: frozenset[int]
    nodes: int


Frame = int | MapId
"""A component of the merged map, or a map that is not in it yet."""


@dataclass(frozen=True, eq=False)
class _Vote:
    """A node here and its double there.

    Attributes:
        here: the node.
        alike: its double.
        frame: in which that lies.
        there: `frame_from_double`.
        robot: `frame_from_robot`, by the two.
        shown: (K, 3) m, landmarks here that the double shows too, in the frame here.
    """

    here: Node
    alike: AliasedNode
    frame: Frame
    there: Pose2
    robot: Pose2
    shown: Array


NODES = 8
"""Nodes around a place that are asked, at most."""
REACH = 3.0
"""Nodes farther from the robot are not asked, m."""
BESIDE = 0.35
"""A landmark nearer than this to one that a double shows is shown by it too, m."""


class AliasedRegions:
    """Finds counterparts of places. It stands for one merged map; make another for the next."""

    def __init__(
        self,
        index: Retrieval,
        node_of: Callable[[NodeId], Node | None],
        merged: MergedMap,
        alike: AliasCache,
        settings: AliasedRegionSettings,
    ) -> None:
        """Take what is known; which nodes look alike outlives the merged map."""
        self._index, self._node_of, self._merged = index, node_of, merged
        self._alike, self._settings = alike, settings
        self._left: list[NodeId] | None = None

    def prepare(self, most: int) -> int:
        """Find out what at most so many nodes look like before anybody asks, and say how many are left.

        Not by two threads at once.
        """
        if not self._settings.least_nodes:
            return 0
        if self._left is None:
            self._left = sorted((one for one in self._merged.poses if one not in self._alike), reverse=True)
        while self._left and most > 0:
            node = self._node_of(self._left.pop())
            if node is not None and not self._alike.knows(node):
                self._look_alikes(node)
                most -= 1
        return len(self._left)

    def counterpart(self, seen: NodeMatch, ranked: Sequence[NodeId] = ()) -> Counterpart | None:
        """Where else a robot may be.

        Args:
            seen: the node that was recognised best.
            ranked: nodes that look like the view; of a map that is not merged yet no other neighbours are
                known.

        Returns:
            The counterpart that shows most of what the view shows; None if there is none.
        """
        s, node = self._settings, self._node_of(seen.node)
        if node is None or not s.least_nodes:
            return None
        frame, frame_from_node = self._placed(node)
        robot = frame_from_node @ seen.recognition.node_from_robot.mean
        landmarks, features = seen.recognition.pairs.T
        points = frame_from_node.apply(node.points_in_robot[landmarks])
        known = np.isfinite(points[:, 0])
        if not known.any():
            return None
        points, features = points[known], features[known]
        votes = self._votes(self._around(node, frame, robot, points, ranked), frame, robot)
        best: tuple[list[_Vote], NDArray[np.bool_]] | None = None
        for party in self._parties(votes):
            shown = np.concatenate([vote.shown for vote in party])
            twice = np.linalg.norm(points[:, None] - shown[None], axis=2).min(axis=1, initial=np.inf) < BESIDE
            if twice.mean() < s.least_share:
                best_told = max(party, key=lambda vote: (len(vote.shown), vote.alike.other.id))
                missed = self._looked_at(best_told, frame_from_node, robot, points, node) & ~twice
                if missed.mean() > s.most_looked_at or not self._is_wide(party, shown):
                    continue
                twice = np.logical_not(missed)
            if best is None or twice.sum() > best[1].sum():
                best = party, twice
        return None if best is None else self._told(seen, node, best[0], features[best[1]])

    def _is_wide(self, party: Sequence[_Vote], shown: Array) -> bool:
        """Whether a party speaks for what it does not show: many nodes, and more than one thing."""
        here, there = {vote.here.id for vote in party}, {vote.alike.other.id for vote in party}
        least = self._settings.least_around
        return len(here) >= least and len(there) >= least - 1 and extent(shown) >= THING_SIGMA

    def _looked_at(
        self, vote: _Vote, frame_from_node: Pose2, robot: Pose2, points: Array, node: Node
    ) -> NDArray[np.bool_]:
        """(K,) which points somebody would have seen in the other region, about as the robot sees them.

        Who has a few landmarks in common with the node here, where they should be, has not looked in vain.

        Args:
            vote: says where the other region is.
            frame_from_node: where the node is.
            robot: `frame_from_robot`, here.
            points: (K, 3) m, what it sees, in the frame here.
            node: that was recognised; its camera stands for all.
        """
        seen = np.ones(len(points), np.bool_)
        if not isinstance(vote.frame, int):
            return seen
        seen[:] = False
        there_from_here = vote.robot @ robot.inverse()
        there = there_from_here.apply(points)
        own, own_bearings = _ways(there, vote.robot.vector[None])
        for one_id, mean in zip(*self._near(vote.frame, vote.robot), strict=True):
            away, bearings = _ways(there, mean[None])
            inside = np.cos(bearings - mean[2]) > math.cos(WELL_INSIDE * node.camera.semi_aperture)
            alike = np.cos(bearings - own_bearings) > math.cos(ALIKE_TURN)
            alike &= (away < ALIKE_TIMES * own) & (own < ALIKE_TIMES * away)
            looked = (inside & alike)[0]
            one = self._node_of(one_id) if (looked & ~seen).any() else None
            if one is None:
                continue
            one_from_node = Pose2.from_vector(mean).inverse() @ there_from_here @ frame_from_node
            if self._alike.in_place(one, node, one_from_node) < IN_COMMON:
                seen |= looked
        return seen

    def _told(
        self, seen: NodeMatch, node: Node, party: Sequence[_Vote], features: NDArray[np.int64]
    ) -> Counterpart:
        """What a party says, by the node there that is nearest to the robot."""
        chosen = min(party, key=lambda vote: (vote.robot.distance(vote.there), vote.alike.other.id))
        robot = seen.recognition.node_from_robot
        if chosen.here.id != node.id:
            robot = self._way(chosen.here, node) @ robot
        pose = chosen.alike.other_from_node @ robot
        agreeing = len({vote.here.id for vote in party})
        return Counterpart(chosen.alike.other.id, pose, frozenset(features.tolist()), agreeing)

    def _around(
        self, node: Node, frame: Frame, robot: Pose2, points: Array, ranked: Sequence[NodeId]
    ) -> Iterator[Node]:
        """The node, then others near the robot, first those that look at most of the points that it sees."""
        if isinstance(frame, int):
            ids, means = self._near(frame, robot)
        else:
            same = [one for one in ranked if one.map == frame and self._merged.component_of(one) is None]
            nodes = [one for one in map(self._node_of, same) if one is not None]
            ids = [one.id for one in nodes]
            means = np.array([one.map_from_robot.mean.vector for one in nodes]).reshape(-1, 3)
        yield node
        bearings = _ways(points, means)[1] - means[:, 2:]
        seen = np.cos(bearings) > math.cos(node.camera.semi_aperture)
        for k in np.argsort(-seen.sum(axis=1), kind="stable")[:NODES].tolist():
            one = self._node_of(ids[k])
            if one is not None and one.id != node.id:
                yield one

    def _near(self, component: int, at: Pose2) -> tuple[list[NodeId], Array]:
        """The nodes nearest to a pose in a component, within reach, and (N, 3) their poses."""
        graph = self._merged.graphs[component]
        away = np.hypot(graph.means[:, 0] - at.x, graph.means[:, 1] - at.y)
        near = np.flatnonzero(away < REACH)
        near = near[np.argsort(away[near], kind="stable")][: 3 * NODES]
        return [graph.nodes[k] for k in near.tolist()], graph.means[near]

    def _votes(self, around: Iterable[Node], frame: Frame, robot: Pose2) -> list[_Vote]:
        """What the doubles of nodes say."""
        votes: list[_Vote] = []
        for one in around:
            frame_from_one = self._placed(one)[1]
            for alike in self._look_alikes(one):
                other_frame, there = self._placed(alike.other)
                told = there @ alike.other_from_node.mean @ frame_from_one.inverse() @ robot
                if other_frame == frame and same_place(told, robot):
                    continue
                shown = frame_from_one.apply(one.points_in_robot[alike.landmarks])
                shown = shown[np.isfinite(shown[:, 0])]
                votes.append(_Vote(one, alike, other_frame, there, told, shown))
        return votes

    def _parties(self, votes: Sequence[_Vote]) -> Iterator[list[_Vote]]:
        """Votes of enough nodes for about the same pose."""
        for vote in votes:
            party = [one for one in votes if one.frame == vote.frame and same_place(one.robot, vote.robot)]
            if len({one.here.id for one in party}) >= self._settings.least_nodes:
                yield party

    def _placed(self, node: Node) -> tuple[Frame, Pose2]:
        """A node's frame, and `frame_from_node`."""
        component = self._merged.component_of(node.id)
        if component is None:
            return node.id.map, node.map_from_robot.mean
        return component, self._merged.pose(node.id)

    def _way(self, a: Node, b: Node) -> PoseGaussian:
        """`a_from_b` of two nodes in one frame; in a map that is not merged nobody says how surely."""
        mean = self._placed(a)[1].inverse() @ self._placed(b)[1]
        told = self._merged.relative(a.id, b.id)
        return told or PoseGaussian.from_sigmas(mean, UNTOLD_XY, UNTOLD_HEADING)

    def _look_alikes(self, node: Node) -> list[AliasedNode]:
        return self._alike.of(node, self._index, self._node_of, partial(between, self._merged))


def _ways(points: Array, poses: Array) -> tuple[Array, Array]:
    """(N, K) m and rad, how far and in which direction (K, 3) points are from (N, 3) poses."""
    way = points[None, :, :2] - poses[:, None, :2]
    return np.hypot(way[..., 0], way[..., 1]), np.arctan2(way[..., 1], way[..., 0])
