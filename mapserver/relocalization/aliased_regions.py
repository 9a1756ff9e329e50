"""Aliased regions: a place's neighbours show whether its whole region looks like another.

A view of one of two similar rooms may match no node of the other room, if that was not seen from the same
side. But the nodes around the recognised place have their aliases there, and all of them imply the same
motion from room to room. The robot may be at the place that this motion gives: if the landmarks that it sees
are aliased, or if their counterparts were not observed there.
"""

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.mapserver.relocalization.alias_cache import AliasCache, AliasedNode
from mapweave.mapserver.relocalization.aliased_landmarks import between, same_place
from mapweave.mapserver.relocalization.candidates import Retrieval
from mapweave.mapserver.relocalization.place_hypotheses import THING_SIGMA, NodeMatch, extent
from mapweave.mapserver.retrieval.ranking import IncompleteSearch
from mapweave.merge.pose_graph.merged_map import MergedMap

WELL_INSIDE = 0.85
"""Of a camera's semi-aperture: of what is nearer to the edge of its image a node keeps little."""
ALIKE_TURN, ALIKE_TIMES = math.radians(35.0), 1.6
"""A thing looks about the same within this angle, and up to so many times as far away."""
IN_COMMON = 3
"""Matches that are in place: about one in 150 wrong ones is so by chance."""
UNTOLD_XY, UNTOLD_HEADING = 0.1, 0.05
"""m and rad, what a way between two nodes of a map that is not merged may be off."""


@dataclass(frozen=True)
class AliasedRegionSettings:
    """When the surroundings of a place count as being there twice.

    Attributes:
        least_nodes: nodes around it whose aliases imply the same motion. 0: regions are not tested.
        least_share: of the landmarks that the view shows, how many must lie on what these aliases show.
        most_looked_at: how many of them may be, in the other region, in observed but empty places, if the
            aliases show less. Then they must show more than one thing.
        least_around: nodes whose aliases must imply the same motion then. All but one must have an alias of
            its own.
    """

    least_nodes: int = 2
    least_share: float = 0.5
    most_looked_at: float = 0.2
    least_around: int = 2


@dataclass(frozen=True, eq=False)
class Counterpart:
    """Another pose where a robot may be, by the similarity of the surroundings.

    Attributes:
        node: the nearest alias there.
        node_from_robot: pose there.
        features: of the view, on what is or may be there twice.
        nodes: how many nodes here imply it.
    """

    node: NodeId
    node_from_robot: PoseGaussian
    features: frozenset[int]
    nodes: int


Frame = int | MapId
"""A component of the merged map, or a map that is not in it yet."""


@dataclass(frozen=True, eq=False)
class _Vote:
    """A node here and its alias there.

    Attributes:
        here: the node.
        alike: its alias.
        frame: in which that lies.
        there: `frame_from_alias`.
        robot: `frame_from_robot`, by the two.
        shown: (K, 3) m, landmarks here that the alias shows too, in the frame here.
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
"""A landmark nearer than this to one that an alias shows is shown by it too, m."""


class AliasedRegions:
    """Finds counterparts of places. It belongs to one merged map; make another for the next."""

    def __init__(
        self,
        index: Retrieval,
        node_of: Callable[[NodeId], Node | None],
        merged: MergedMap,
        alike: AliasCache,
        settings: AliasedRegionSettings,
    ) -> None:
        """Take the merged map and the alias cache, which outlives it."""
        self._index, self._node_of, self._merged = index, node_of, merged
        self._alike, self._settings = alike, settings
        self._left: list[NodeId] | None = None

    def prepare(self, most: int) -> int:
        """Evaluate the aliases of at most so many nodes in advance, and return how many are left.

        Not by two threads at once.
        """
        if not self._settings.least_nodes:
            return 0
        if self._left is None:
            self._left = sorted(
                (node_id for node_id in self._merged.poses if node_id not in self._alike), reverse=True
            )
        while self._left and most > 0:
            node = self._node_of(self._left.pop())
            if node is not None and not self._alike.knows(node):
                try:
                    self._aliases(node)
                except IncompleteSearch:  # once a question needs it, or after the next merge
                    return 0
                most -= 1
        return len(self._left)

    def counterpart(
        self,
        recognised: NodeMatch,
        ranked: Sequence[NodeId] = (),
        elsewhere: Collection[MapId] = (),
    ) -> Counterpart | None:
        """Where else a robot may be.

        Args:
            recognised: the node that was recognised best.
            ranked: candidates of the view; a map that is not merged yet has no other neighbours.
            elsewhere: maps on which the robot knows that it is not.

        Returns:
            The counterpart that shows most of what the view shows; None if there is none.

        Raises:
            IncompleteSearch: a part of the map cannot be searched now.
        """
        s, node = self._settings, self._node_of(recognised.node)
        if node is None or not s.least_nodes:
            return None
        frame, frame_from_node = self._placed(node)
        robot = frame_from_node @ recognised.recognition.node_from_robot.mean
        landmarks, features = recognised.recognition.pairs.T
        points = frame_from_node.apply(node.points_in_robot[landmarks])
        has_depth = np.isfinite(points[:, 0])
        if not has_depth.any():
            return None
        points, features = points[has_depth], features[has_depth]
        around = self._around(node, frame, robot, points, ranked)
        votes = [
            vote for vote in self._votes(around, frame, robot) if vote.alike.other.id.map not in elsewhere
        ]
        best: tuple[list[_Vote], NDArray[np.bool_]] | None = None
        for party in self._parties(votes):
            shown = np.concatenate([vote.shown for vote in party])
            twice = np.linalg.norm(points[:, None] - shown[None], axis=2).min(axis=1, initial=np.inf) < BESIDE
            if twice.mean() < s.least_share:
                largest = max(party, key=lambda vote: (len(vote.shown), vote.alike.other.id))
                missed = self._observed(largest, frame_from_node, robot, points, node) & ~twice
                if missed.mean() > s.most_looked_at or not self._is_wide(party, shown):
                    continue
                twice = np.logical_not(missed)
            if best is None or twice.sum() > best[1].sum():
                best = party, twice
        return None if best is None else self._counterpart_of(recognised, node, best[0], features[best[1]])

    def _is_wide(self, party: Sequence[_Vote], shown: Array) -> bool:
        """Whether a group is enough evidence beyond what it shows: many nodes, and more than one thing."""
        nodes_here, nodes_there = {vote.here.id for vote in party}, {vote.alike.other.id for vote in party}
        least = self._settings.least_around
        return len(nodes_here) >= least and len(nodes_there) >= least - 1 and extent(shown) >= THING_SIGMA

    def _observed(
        self, vote: _Vote, frame_from_node: Pose2, robot: Pose2, points: Array, node: Node
    ) -> NDArray[np.bool_]:
        """(K,) which points would have been observed in the other region, about as the robot sees them.

        A node with a few common landmarks at their predictions has observed them.

        Args:
            vote: gives the other region.
            frame_from_node: where the node is.
            robot: `frame_from_robot`, here.
            points: (K, 3) m, what it sees, in the frame here.
            node: that was recognised; its camera is used for all.
        """
        observed = np.ones(len(points), np.bool_)
        if not isinstance(vote.frame, int):
            return observed
        observed[:] = False
        there_from_here = vote.robot @ robot.inverse()
        points_there = there_from_here.apply(points)
        own, own_bearings = _ways(points_there, vote.robot.vector[None])
        for node_id, mean in zip(*self._nearby_nodes(vote.frame, vote.robot), strict=True):
            away, bearings = _ways(points_there, mean[None])
            inside = np.cos(bearings - mean[2]) > math.cos(WELL_INSIDE * node.camera.semi_aperture)
            alike = np.cos(bearings - own_bearings) > math.cos(ALIKE_TURN)
            alike &= (away < ALIKE_TIMES * own) & (own < ALIKE_TIMES * away)
            in_view = (inside & alike)[0]
            neighbour = self._node_of(node_id) if (in_view & ~observed).any() else None
            if neighbour is None:
                continue
            node_from_view = Pose2.from_vector(mean).inverse() @ there_from_here @ frame_from_node
            if self._alike.in_place(neighbour, node, node_from_view) < IN_COMMON:
                observed |= in_view
        return observed

    def _counterpart_of(
        self, recognised: NodeMatch, node: Node, party: Sequence[_Vote], features: NDArray[np.int64]
    ) -> Counterpart:
        """The counterpart that a group implies, by its node nearest to the robot."""
        chosen = min(party, key=lambda vote: (vote.robot.distance(vote.there), vote.alike.other.id))
        robot = recognised.recognition.node_from_robot
        if chosen.here.id != node.id:
            robot = self._way(chosen.here, node) @ robot
        pose = chosen.alike.other_from_node @ robot
        agreeing = len({vote.here.id for vote in party})
        return Counterpart(chosen.alike.other.id, pose, frozenset(features.tolist()), agreeing)

    def _around(
        self, node: Node, frame: Frame, robot: Pose2, points: Array, ranked: Sequence[NodeId]
    ) -> Iterator[Node]:
        """The node, then others near the robot, first those that observe most of the points that it sees."""
        if isinstance(frame, int):
            ids, means = self._nearby_nodes(frame, robot)
        else:
            same = [one for one in ranked if one.map == frame and self._merged.component_of(one) is None]
            nodes = [one for one in map(self._node_of, same) if one is not None]
            ids = [one.id for one in nodes]
            means = np.array([one.map_from_robot.mean.vector for one in nodes]).reshape(-1, 3)
        yield node
        bearings = _ways(points, means)[1] - means[:, 2:]
        in_view = np.cos(bearings) > math.cos(node.camera.semi_aperture)
        for k in np.argsort(-in_view.sum(axis=1), kind="stable")[:NODES].tolist():
            one = self._node_of(ids[k])
            if one is not None and one.id != node.id:
                yield one

    def _nearby_nodes(self, component: int, at: Pose2) -> tuple[list[NodeId], Array]:
        """The nodes nearest to a pose in a component, within reach, and (N, 3) their poses."""
        graph = self._merged.graphs[component]
        away = np.hypot(graph.means[:, 0] - at.x, graph.means[:, 1] - at.y)
        nearby = np.flatnonzero(away < REACH)
        nearby = nearby[np.argsort(away[nearby], kind="stable")][: 3 * NODES]
        return [graph.nodes[k] for k in nearby.tolist()], graph.means[nearby]

    def _votes(self, around: Iterable[Node], frame: Frame, robot: Pose2) -> list[_Vote]:
        """The motions that the aliases of nodes imply; none if too few nodes have any for a party.

        Those whose aliases are known come first: to search the aliases of one takes 10 ms in a large fleet.
        """
        nodes = list(around)
        votes: list[list[_Vote]] = [[] for _ in nodes]
        order = sorted(range(len(nodes)), key=lambda k: not self._alike.knows(nodes[k]))
        for asked, k in enumerate(order):
            if sum(map(bool, votes)) + len(nodes) - asked < self._settings.least_nodes:
                return []
            votes[k] = self._votes_of(nodes[k], frame, robot)
        return [vote for of_node in votes for vote in of_node]

    def _votes_of(self, neighbour: Node, frame: Frame, robot: Pose2) -> list[_Vote]:
        """The motions that the aliases of one node imply."""
        votes: list[_Vote] = []
        frame_from_neighbour = self._placed(neighbour)[1]
        for alike in self._aliases(neighbour):
            other_frame, frame_from_alias = self._placed(alike.other)
            robot_there = (
                frame_from_alias @ alike.other_from_node.mean @ frame_from_neighbour.inverse() @ robot
            )
            if other_frame == frame and same_place(robot_there, robot):
                continue
            shown = frame_from_neighbour.apply(neighbour.points_in_robot[alike.landmarks])
            shown = shown[np.isfinite(shown[:, 0])]
            votes.append(_Vote(neighbour, alike, other_frame, frame_from_alias, robot_there, shown))
        return votes

    def _parties(self, votes: Sequence[_Vote]) -> Iterator[list[_Vote]]:
        """Votes of enough nodes for about the same pose."""
        for vote in votes:
            party = [
                other_vote
                for other_vote in votes
                if other_vote.frame == vote.frame and same_place(other_vote.robot, vote.robot)
            ]
            if len({other_vote.here.id for other_vote in party}) >= self._settings.least_nodes:
                yield party

    def _placed(self, node: Node) -> tuple[Frame, Pose2]:
        """A node's frame, and `frame_from_node`."""
        component = self._merged.component_of(node.id)
        if component is None:
            return node.id.map, node.map_from_robot.mean
        return component, self._merged.pose(node.id)

    def _way(self, a: Node, b: Node) -> PoseGaussian:
        """`a_from_b` of two nodes in one frame; without covariance in a map that is not merged."""
        mean = self._placed(a)[1].inverse() @ self._placed(b)[1]
        relative = self._merged.relative(a.id, b.id)
        return relative or PoseGaussian.from_sigmas(mean, UNTOLD_XY, UNTOLD_HEADING)

    def _aliases(self, node: Node) -> list[AliasedNode]:
        return self._alike.of(node, self._index, self._node_of, partial(between, self._merged))


def _ways(points: Array, poses: Array) -> tuple[Array, Array]:
    """(N, K) m and rad, how far and in which direction (K, 3) points are from (N, 3) poses."""
    way = points[None, :, :2] - poses[:, None, :2]
    return np.hypot(way[..., 0], way[..., 1]), np.arctan2(way[..., 1], way[..., 0])
