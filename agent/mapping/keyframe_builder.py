"""Views become nodes, and what joins them becomes edges."""

import logging
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.edge_measurement.driven_edge import driven_edge
from mapweave.agent.edge_measurement.traverse import Traverse
from mapweave.agent.ekf.triangulation import triangulate
from mapweave.agent.mapping.anchored_keyframe import HERE, AnchoredKeyframe
from mapweave.agent.mapping.loop_closures import LoopClosures
from mapweave.agent.mapping.rescaling import rescaled, rescaled_edge, rescaled_node
from mapweave.agent.mapping.tracking import EpisodeEstimate
from mapweave.agent.mapping.trajectory_recorder import TrajectoryRecorder
from mapweave.agent.mapping.view import PendingKeyframe, RawImage
from mapweave.agent.mapping.way_correction import WayCorrection
from mapweave.agent.observation import RobotDescription
from mapweave.hybridmap.change import ChangeBody, EdgePut, NodePut, NodeRetired
from mapweave.hybridmap.edge_limits import unmeasurable
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Landmarks, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.quantization import settle
from mapweave.hybridmap.trajectory_segment import TrajectorySegment
from mapweave.registration.recognition import Recognition
from mapweave.registration.selection import SelectionSettings, choose, worth

log = logging.getLogger(__name__)

MOST_LANDMARKS = 150
"""Landmarks that a node keeps."""
LEAST_LANDMARKS = 6
"""A view with fewer becomes no node."""
DEPTH_SHARE = 0.25
"""A landmark is kept if its depth's sigma is below this share of the depth."""
DEPTH_FLOOR = (0.01, 0.015)
"""Smallest standard deviation of a depth: m, and share of the depth."""
MOST_CHI2 = 4.0
"""A triangulated track fits if its mean squared residual is below this; 1 is expected."""
EDGE_FLOOR = (0.002, 0.004)
"""Smallest standard deviation of an edge's pose, m and rad: tracks err alike for a while, which the filter,
for which pixels err independently, does not know."""
EDGE_SHARE = (0.005, 0.01)
"""What is added to that, as a share of the way and of the turn: wheels are never quite round."""
TURN_ONLY = 0.15
"""m; between two views nearer than this the robot has turned on the spot rather than driven."""


class KeyframeBuilder:
    """Makes the nodes and edges of one map.

    Attributes:
        map: what was made so far.
        map_from_anchor: pose of the current anchor.
    """

    def __init__(
        self,
        map_id: MapId,
        description: RobotDescription,
        selection: SelectionSettings,
        contents: Sequence[ChangeBody] = (),
        next_number: int = 1,
    ) -> None:
        """Start an empty map whose frame is the first anchor's, or go on with one.

        Args:
            map_id: of the map.
            description: of the robot.
            selection: which landmarks a node keeps.
            contents: of a map that was begun.
            next_number: the first that no node or edge has ever had.
        """
        self.map = HybridMap(contents)
        self.map_from_anchor = HERE
        self._map_id = map_id
        self._description = description
        self._camera = description.camera
        self._selection = selection
        self._last: AnchoredKeyframe | None = None
        self._next_number = next_number
        known = (node.stamp_ns for node in self.map.nodes.values() if node.clock == description.clock)
        self._begun_ns = max(known, default=0)
        self._new: list[ChangeBody] = []
        # What was begun by another process may have been measured with other wheels.
        self._one_scale = not contents
        self._images: list[tuple[NodeId, RawImage]] = []
        self._pending: deque[Callable[[], None]] = deque()
        self._loops = LoopClosures(self.map, self.new_id)

    def recalibrate(
        self, description: RobotDescription, old_from_new: Pose2, scale: float = 1.0
    ) -> WayCorrection:
        """Make nodes with another camera from now on; those made before keep theirs.

        All lengths of the map are by the wheels, so it is put again where these went further, or less far,
        than they said. The robot keeps its place on it, as floor and behaviours around it know that.

        Args:
            description: of the robot.
            old_from_new: of its frame.
            scale: of the wheels: true over assumed way.

        Returns:
            How poses of before are to be seen from now on; the move by `old_from_new` is no part of it.
        """
        self.finish_pending()
        way = WayCorrection()
        if scale != 1.0 and self._one_scale:
            way = WayCorrection.about(self.map_from_anchor.mean, scale)
            self._rescale(way)
        clock = self._description.clock
        self._description, self._camera = replace(description, clock=clock), description.camera
        self._move(PoseGaussian(old_from_new, np.zeros((3, 3))))
        return way

    def _rescale(self, way: WayCorrection) -> None:
        """Put all nodes and edges again, with other lengths."""
        self._write(
            *(rescaled_node(node, way) for node in self.map.nodes.values()),
            *(rescaled_edge(edge, way.scale) for edge in self.map.edges.values()),
        )
        self.map_from_anchor = rescaled(self.map_from_anchor, way)
        last = self._last
        if last is not None:
            last.node = self.map.nodes.get(last.node.id, last.node)
            last.node_from_anchor = rescaled(last.node_from_anchor, WayCorrection(scale=way.scale))

    def forget_clock(self) -> None:
        """The clock has jumped: times of nodes made from now on are not to be compared with other robots'."""
        if self._description.clock:
            self._description = replace(self._description, clock="")

    def take_changes(self) -> tuple[ChangeBody, ...]:
        """What was changed in the map since the last call, in order: it is to leave the robot."""
        new, self._new = tuple(self._new), []
        return new

    def take_images(self) -> tuple[tuple[NodeId, RawImage], ...]:
        """The images of the nodes that were made since the last call."""
        images, self._images = tuple(self._images), []
        return images

    def place(
        self,
        anchor: PendingKeyframe,
        further: list[PendingKeyframe],
        estimate: EpisodeEstimate,
        trajectory: TrajectoryRecorder,
        moved: PoseGaussian,
        known: Callable[[Landmarks | None], None],
    ) -> None:
        """Begin the next episode elsewhere; the last one's anchor becomes a node, with edges to those before.

        The landmarks, the node, those of further views and loop closures are left for `continue_pending`.

        Args:
            anchor: the view where the episode began.
            further: further views of the episode.
            estimate: what it is known by.
            trajectory: trajectory since the last node; it goes with the anchor, if that becomes a node.
            moved: `old_anchor_from_new`, by the filter.
            known: gets the landmarks of the anchor's node; None if it shows too little and becomes no node.
        """
        self.finish_pending()
        here = self.map_from_anchor
        self.map_from_anchor = here @ self._with_floor(moved)

        def make() -> None:
            landmarks, tracks = self._landmarks(anchor, estimate)
            self.map_from_anchor = here
            if len(landmarks) < LEAST_LANDMARKS:
                self.move_anchor(moved)
                known(None)
                return
            segment = trajectory.segment(anchor.stamp_ns, self._description.ranges(anchor.proximity))
            placed = AnchoredKeyframe(self._node(anchor, landmarks, here, segment), tracks)
            self.join(placed)
            for view in reversed(further):
                self._pending.appendleft(
                    partial(self._place_beside, placed, view, estimate, self.map_from_anchor)
                )
            self.move_anchor(moved)
            known(landmarks)

        self._pending.append(make)

    def _place_beside(
        self,
        placed: AnchoredKeyframe,
        view: PendingKeyframe,
        estimate: EpisodeEstimate,
        map_from_anchor: PoseGaussian,
    ) -> None:
        """Make a node of a further view of an episode whose anchor has become a node."""
        landmarks, tracks = self._landmarks(view, estimate)
        if len(landmarks) >= LEAST_LANDMARKS:
            beside = AnchoredKeyframe(self._node(view, landmarks, map_from_anchor), tracks)
            self._write(beside.node, self._edge(placed, beside, self._with_floor(view.anchor_from_view)))

    def join(self, placed: AnchoredKeyframe) -> None:
        """Put the node of an episode into the map, with edges to the one before and to known places."""
        self.finish_pending()
        last = self._last
        if last is not None and last.evidence:
            loops = self._loops.edges(placed.node)
            if loops:
                self._settle(placed, loops)
            joined = loops or [self._edge(last, placed, last.node_from_anchor)]
            self._write(placed.node, *joined)
        else:
            joined = [] if last is None else [self._edge(last, placed, last.node_from_anchor)]
            self._write(placed.node, *joined)
            before = None if last is None else last.node.id
            self._pending.append(partial(self._close_loops, placed.node, before))
        self._last = placed

    def continue_pending(self) -> None:
        """Do one piece of what is left of the last episode, if any.

        A tick for each: the one in which an anchor becomes a node takes long enough.
        """
        if self._pending:
            self._pending.popleft()()

    def finish_pending(self) -> None:
        """Do all that is left of the last episode."""
        while self._pending:
            self.continue_pending()

    def _close_loops(self, node: Node, before: NodeId | None) -> None:
        """Try earlier places one after the other, a tick each: a comparison takes as long as the tracks."""
        if node.id not in self.map.nodes:
            return
        tries = [partial(self._close_loop, earlier, node) for earlier in self._loops.nearby(node, before)]
        self._pending.extendleft(reversed(tries[1:]))
        for attempt in tries[:1]:
            attempt()

    def _close_loop(self, earlier: Node, node: Node) -> None:
        loop = self._loops.edge(earlier, node)
        if loop is not None:
            self._write(loop)

    def recognise(self, node: Node, view_tracks: NDArray[np.int64], recognition: Recognition) -> None:
        """The next episode begins at a view that shows a node of this map, however the robot came there.

        Args:
            node: of the map.
            view_tracks: (K,) of the features of the anchor view; all have one.
            recognition: of the node in the view's features.
        """
        self.finish_pending()
        tracks = np.full(len(node.landmarks), -1, np.int64)
        tracks[recognition.pairs[:, 0]] = view_tracks[recognition.pairs[:, 1]]
        self.map_from_anchor = node.map_from_robot @ recognition.node_from_robot
        self._last = AnchoredKeyframe(node, tracks, recognition.node_from_robot, recognition.evidence)

    def lose(self, moved: PoseGaussian) -> None:
        """The robot's pose is lost; `old_anchor_from_robot` is the last estimate.

        A map without nodes may begin anywhere.
        """
        self.finish_pending()
        self.map_from_anchor = self.map_from_anchor @ moved if self.map.nodes else HERE
        self._last = None

    def move_anchor(self, moved: PoseGaussian) -> None:
        """Begin the next episode at another anchor: `old_anchor_from_new`, by the filter."""
        self._move(self._with_floor(moved))

    def _move(self, moved: PoseGaussian) -> None:
        self.map_from_anchor = self.map_from_anchor @ moved
        if self._last is not None:
            self._last.node_from_anchor = self._last.node_from_anchor @ moved

    @property
    def last(self) -> NodeId | None:
        """The node to which the next one is tied."""
        return None if self._last is None else self._last.node.id

    def retire(self, node: NodeId) -> None:
        """Take a node out of the map, with its edges."""
        self.finish_pending()
        change = NodeRetired(node)
        self.map.apply(change)
        self._new.append(change)

    def drove(self, traverse: Traverse | None, refined: Node | None) -> None:
        """Write down what a drive has measured."""
        if refined is not None:
            self._write(refined)
        if traverse is not None:
            self._write(driven_edge(self.map, traverse, self.new_id))

    def _write(self, *elements: Node | Edge) -> None:
        """Put nodes and edges into the map.

        Servers refuse an edge of which a robot knows nothing, and the maps of robots that send such edges.
        """
        for element in elements:
            if isinstance(element, Edge) and (reason := unmeasurable(element)):
                log.warning("left out of the map: %s", reason)
                continue
            change = NodePut(element) if isinstance(element, Node) else EdgePut(element)
            self.map.apply(change)
            self._new.append(change)

    def new_id(self) -> NodeId:
        """An id that no node or edge of the map has had."""
        number = NodeId(self._map_id.agent, self._map_id.epoch, self._next_number)
        self._next_number += 1
        return number

    def _node(
        self,
        view: PendingKeyframe,
        landmarks: Landmarks,
        map_from_anchor: PoseGaussian,
        segment: TrajectorySegment | None = None,
    ) -> Node:
        if view.stamp_ns < self._begun_ns:
            # It was put back since another process began the map: a machine may start with an old time.
            self.forget_clock()
        pose, d = map_from_anchor @ view.anchor_from_view, self._description
        node = Node(
            self.new_id(), view.stamp_ns, pose, d.camera, landmarks, d.clock, d.radius,
            d.ranges(view.proximity), segment or TrajectorySegment(),
        )  # fmt: skip
        if view.image is not None:
            self._images.append((node.id, view.image))
        return node

    def _landmarks(
        self, view: PendingKeyframe, estimate: EpisodeEstimate
    ) -> tuple[Landmarks, NDArray[np.int64]]:
        """The view's features with depth in the view: by the filter, else triangulated; and their tracks."""
        camera = self._camera
        depths, sigmas = np.full(len(view.tracks), np.nan), np.full(len(view.tracks), np.nan)
        poses, pixels = estimate.history.observations(view.tracks)
        if len(poses) >= 2 and len(view.tracks):
            solved = triangulate(poses, pixels, camera, reference=view.anchor_from_view.mean.vector)
            fits = solved.chi2 < MOST_CHI2
            depths[fits], sigmas[fits] = solved.depths[fits], solved.depth_sigmas[fits]
        view_from_robot = view.anchor_from_view.mean.inverse() @ estimate.pose.mean
        estimates = estimate.landmarks
        shared, row, seat = np.intersect1d(estimates.ids, view.tracks, return_indices=True)
        if len(shared):
            ahead = view_from_robot.apply(estimates.points_in_robot[row])[:, 0] - camera.mount_forward
            axis = view_from_robot.rotation[0]
            spread = np.einsum("i,nij,j->n", axis, estimates.covariances_in_robot[row][:, :2, :2], axis)
            # Landmarks new to the filter are known better from all their observations.
            sure = (ahead > 0.05) & (np.sqrt(np.maximum(spread, 0.0)) < DEPTH_SHARE * ahead)
            depths[seat[sure]] = ahead[sure]
            sigmas[seat[sure]] = np.sqrt(np.maximum(spread[sure], 1e-12))
        with np.errstate(invalid="ignore"):
            good = np.flatnonzero((depths > 0.05) & (sigmas < DEPTH_SHARE * depths))
        # Tracks have common errors for a while, which neither filter nor triangulation models.
        sigmas = np.hypot(sigmas, DEPTH_FLOOR[0] + DEPTH_FLOOR[1] * depths)
        landmarks = Landmarks(
            view.features.pixels[good].astype(np.float32), view.features.codes[good],
            depths[good].astype(np.float32), sigmas[good].astype(np.float32),
        )  # fmt: skip
        visible_share = np.isfinite(pixels[:, good, 0]).mean(axis=0) if len(poses) else np.ones(len(good))
        likely = worth(visible_share, good / max(len(view.tracks), 1))
        kept = choose(landmarks, likely, camera, self._selection, MOST_LANDMARKS)
        # Rounded now, the robot works with the same numbers as all receivers of the node.
        landmarks, order = settle(landmarks.take(kept), camera)
        return landmarks, view.tracks[good[kept[order]]]

    def _edge(self, a: AnchoredKeyframe, b: AnchoredKeyframe, a_from_b: PoseGaussian) -> Edge:
        _, in_a, in_b = np.intersect1d(a.tracks, b.tracks, return_indices=True)
        driven = float(np.hypot(a_from_b.mean.x, a_from_b.mean.y))
        kind = EdgeKind.TURNED if driven < TURN_ONLY else EdgeKind.MAPPED
        if a.evidence:
            kind = EdgeKind.LOOP
        shared = np.stack([in_a, in_b], axis=1).astype(np.int64)
        evidence = a.evidence or {"shared": float(len(shared))}
        return Edge(self.new_id(), a.node.id, b.node.id, a_from_b, kind, shared, evidence)

    def _settle(self, placed: AnchoredKeyframe, loops: list[Edge]) -> None:
        """Correct where the first node after a recognition is, by the surest of its edges.

        The recognition knew depths in the old node only; an edge between two nodes has them on both sides,
        and is seldom off by as much.
        """
        best = min(loops, key=lambda edge: edge.evidence["sigma_xy"])
        self.map_from_anchor = self.map.nodes[best.a].map_from_robot @ best.a_from_b
        placed.node = replace(placed.node, map_from_robot=self.map_from_anchor)

    def _with_floor(self, moved: PoseGaussian) -> PoseGaussian:
        """A pose of the filter with the uncertainty that the filter cannot know."""
        way, turn = float(np.hypot(moved.mean.x, moved.mean.y)), abs(moved.mean.heading)
        position = EDGE_FLOOR[0] + EDGE_SHARE[0] * way
        heading = EDGE_FLOOR[1] + EDGE_SHARE[1] * turn
        more = np.diag([position**2, position**2, heading**2])
        return PoseGaussian(moved.mean, moved.covariance + more)
