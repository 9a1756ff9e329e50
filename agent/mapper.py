"""Mapping: observations in, nodes and edges out. Who drives, explorer or person, is not its business."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from agent.ekf.mapping import FilterSettings, MappingFilter
from agent.ekf.triangulation import triangulate
from agent.observation import Observation, RobotDescription
from agent.track_history import TrackHistory
from agent.vision.lens import Lens
from agent.vision.sift import Features, Sift, SiftSettings
from agent.vision.tracker import Tracker, TrackerSettings
from hybridmap.change import ChangeBody, EdgePut, NodePut
from hybridmap.hybrid_map import HybridMap
from hybridmap.node import Edge, EdgeKind, Landmarks, MapId, Node, NodeId
from hybridmap.pose import Array, Pose2, PoseGaussian
from hybridmap.recognition import register

TURN_ONLY = 0.15
"""m; between two views nearer than this the robot has turned on the spot rather than driven."""


@dataclass(frozen=True)
class MapperSettings:
    """How nodes are made.

    Attributes:
        sift: features of a view.
        tracker: tracks between views.
        filter: the mapping EKF.
        filtered: landmarks in the EKF; further tracks are triangulated against its trajectory.
        least_filtered: with fewer landmarks in view the wheels are trusted alone.
        least_spread: likewise if they cover less than this share of the image's width.
        most_landmarks: landmarks that a node keeps.
        least_landmarks: a view with fewer becomes no node.
        edge_floor: what an edge's posture is never better than, m and rad: tracks err alike for a while,
            which the filter, for which pixels err independently, does not know.
        edge_share: likewise as a share of the way and of the turn: wheels are never quite round.
        depth_floor: what a depth is never better than: m, and share of the depth.
        depth_share: a landmark is kept if its depth's sigma is below this share of the depth.
        depths_per_height: assumed depth of an unknown feature as a multiple of the camera's height (the
            paper's "assumed common height").
        associate_px: a feature this near to a track is the same point.
        strikes: a track that the filter refuses this often in a row is given up.
        loop_reach: nodes of the own map nearer than this are tried for a loop closure, m.
        loop_turn: and turned by less than this, rad.
        loop_sigma: a loop closure known no better than this is left to the server, m.
        loop_tries: at most this many, nearest first.
    """

    sift: SiftSettings = field(default_factory=SiftSettings)
    tracker: TrackerSettings = field(default_factory=TrackerSettings)
    filter: FilterSettings = field(default_factory=FilterSettings)
    filtered: int = 36
    least_filtered: int = 5
    least_spread: float = 0.2
    most_landmarks: int = 150
    least_landmarks: int = 6
    edge_floor: tuple[float, float] = (0.002, 0.004)
    edge_share: tuple[float, float] = (0.005, 0.01)
    depth_floor: tuple[float, float] = (0.01, 0.015)
    depth_share: float = 0.25
    depths_per_height: float = 8.0
    associate_px: float = 1.5
    strikes: int = 3
    loop_reach: float = 1.2
    loop_turn: float = 0.7
    loop_tries: int = 4
    loop_sigma: float = 0.12


@dataclass(eq=False)
class KeptView:
    """An image that will become a node once its landmarks are known.

    Attributes:
        stamp_ns: when it was taken.
        anchor_from_view: posture relative to the anchor view; identity for the anchor itself.
        features: its features.
        tracks: (N,) id of the track of each feature, -1 where it has none.
    """

    stamp_ns: int
    anchor_from_view: PoseGaussian
    features: Features
    tracks: NDArray[np.int64]


class Mapper:
    """Tracks features, filters, and turns views into nodes and edges of one map.

    The filter's posture is relative to the *anchor*, the view where the current episode began, with zero
    covariance there (the paper's P_0^r = 0). So its covariance at the next anchor is that of the edge.

    Attributes:
        map: what was mapped so far.
        episode: number of episodes finished.
    """

    def __init__(
        self, map_id: MapId, description: RobotDescription, settings: MapperSettings | None = None
    ) -> None:
        """Start an empty map where the robot stands."""
        self.map = HybridMap()
        self.episode = 0
        self._map_id = map_id
        self._description = description
        self._settings = settings or MapperSettings()
        lens = Lens(description)
        self._sift = Sift(lens, self._settings.sift)
        self._tracker = Tracker(lens, self._settings.tracker)
        self._filter = MappingFilter(
            description.camera, description.axle, description.wheel_noise, self._settings.filter
        )
        self._history = TrackHistory()
        self._strikes: dict[int, int] = {}
        self._anchor: KeptView | None = None
        self._leaves: list[KeptView] = []
        self._map_from_anchor = PoseGaussian(Pose2(), np.zeros((3, 3)))
        self._last: _Emitted | None = None
        self._next_number = 1
        self._next_track = 1
        self._rng = np.random.default_rng(0)
        self._prior_depth = self._settings.depths_per_height * max(description.camera.mount_height, 0.05)

    # What an explorer or a person's passenger needs to know

    @property
    def started(self) -> bool:
        """Whether there is an anchor view to map from."""
        return self._anchor is not None

    @property
    def anchor_from_robot(self) -> Pose2:
        """Posture since the anchor view."""
        return self._filter.pose.mean

    @property
    def map_from_robot(self) -> PoseGaussian:
        """Posture in the agent's map."""
        return self._map_from_anchor @ self._filter.pose

    @property
    def tracked(self) -> int:
        """Tracks alive."""
        return len(self._tracker.ids)

    @property
    def anchored(self) -> int:
        """Features of the anchor view that are still tracked."""
        if self._anchor is None:
            return 0
        return int(np.isin(self._tracker.ids, self._anchor.tracks).sum())

    @property
    def anchor_features(self) -> int:
        """Features that the anchor view had."""
        return 0 if self._anchor is None else len(self._anchor.features)

    @property
    def bearings(self) -> Array:
        """(N,) rad, bearings of the tracks, positive to the left."""
        return self._description.camera.bearings(self._tracker.pixels)

    @property
    def converged_share(self) -> float:
        """Share of the filter's landmarks whose depth has converged; 0 without landmarks."""
        converged = self._filter.converged()
        return float(converged.mean()) if len(converged) else 0.0

    @property
    def typical_depth(self) -> float:
        """Median depth of the last node's landmarks, m; before there is one, the assumed depth."""
        return self._prior_depth

    # One tick

    def step(self, observation: Observation) -> None:
        """Predict by the wheels, follow the tracks, correct by what they show."""
        self._filter.predict(observation.odometry)
        if observation.image is None:
            return
        self._tracker.track(observation.image, self._expected(observation))
        pixels = self._tracker.pixels
        in_filter = np.isin(self._tracker.ids, self._filter.ids)
        # A landmark whose track is lost stays out: what it taught is in the posture already.
        self._filter.remove(self._filter.ids[~np.isin(self._filter.ids, self._tracker.ids)])
        if self._trusted(pixels[in_filter]):
            ids = self._tracker.ids[in_filter]
            report = self._filter.update(ids, pixels[in_filter])
            self._judge(ids, report.accepted)
        self._history.record(self._filter.pose.mean, self._tracker.ids, self._tracker.pixels)

    def _trusted(self, pixels: Array) -> bool:
        """Whether landmarks are enough, and far enough apart, to correct the wheels.

        A few points in one corner may all lie on the same edge, slide along it together and agree.
        """
        s = self._settings
        spread = float(np.ptp(pixels[:, 0])) if len(pixels) else 0.0
        return len(pixels) >= s.least_filtered and spread >= s.least_spread * self._description.camera.width

    def _expected(self, observation: Observation) -> Array:
        """(N, 2) px where the tracks should be now: by the filter, else by the turn alone."""
        camera = self._description.camera
        before = self._tracker.pixels
        bearing = np.tan(camera.bearings(before))
        turn = np.tan(observation.odometry.turn)
        turned = (bearing - turn) / (1 + bearing * turn)
        expected = before.copy()
        expected[:, 0] = camera.cx - camera.fx * turned
        ids = self._filter.ids
        if len(ids):
            predicted = self._filter.predict_pixels()
            order = np.argsort(ids)
            place = np.clip(np.searchsorted(ids[order], self._tracker.ids), 0, len(ids) - 1)
            hit = ids[order][place] == self._tracker.ids
            rows = predicted[order[place]]
            hit &= camera.contains(rows)
            expected[hit] = rows[hit]
        return expected

    def _judge(self, ids: NDArray[np.int64], accepted: NDArray[np.bool_]) -> None:
        """Give up tracks that the filter keeps refusing: they are on something that moves, or have slid."""
        given_up = []
        for track, good in zip(ids.tolist(), accepted.tolist(), strict=True):
            strikes = 0 if good else self._strikes.get(track, 0) + 1
            self._strikes[track] = strikes
            if strikes >= self._settings.strikes:
                given_up.append(track)
        if given_up:
            gone = np.array(given_up, np.int64)
            self._filter.remove(gone)
            self._tracker.keep(~np.isin(self._tracker.ids, gone))

    # Episodes

    def begin(self, observation: Observation) -> None:
        """Take the first view: the anchor of the first episode."""
        if observation.image is not None:
            self._tracker.track(observation.image)
            self._anchor = self._take(observation, PoseGaussian(Pose2(), np.zeros((3, 3))))
            self._follow(self._anchor)

    def leaf(self, observation: Observation) -> None:
        """Keep the current image as a node beside the anchor, for example at the far end of a drive."""
        if observation.image is not None and self._anchor is not None:
            self._history.record(self._filter.pose.mean, self._tracker.ids, self._tracker.pixels, force=True)
            self._leaves.append(self._take(observation, self._filter.pose))

    def finish(self, observation: Observation) -> list[ChangeBody]:
        """End the episode: its views become nodes, and the current image becomes the next anchor.

        Returns:
            The changes to the map, already applied to `map`. Empty without an image.
        """
        if observation.image is None or self._anchor is None:
            return []
        self._history.record(self._filter.pose.mean, self._tracker.ids, self._tracker.pixels, force=True)
        changes = self._emit_episode(self._anchor, self._leaves)
        for change in changes:
            self.map.apply(change)
        new_anchor = self._take(observation, PoseGaussian(Pose2(), np.zeros((3, 3))))
        moved = self._sober(self._filter.reanchor())
        self._map_from_anchor = self._map_from_anchor @ moved
        if self._last is not None:
            self._last.node_from_anchor = self._last.node_from_anchor @ moved
        self._history.reanchor(moved.mean, self._tracker.ids)
        self._anchor, self._leaves = new_anchor, []
        self._follow(new_anchor)
        self.episode += 1
        return changes

    def _take(self, observation: Observation, anchor_from_view: PoseGaussian) -> KeptView:
        """Extract the image's features and tell which of them are tracks."""
        assert observation.image is not None
        features = self._sift.extract(observation.image)
        tracks = np.full(len(features), -1, np.int64)
        if len(features) and len(self._tracker.ids):
            distance = np.linalg.norm(features.raw[:, None] - self._tracker.raw[None], axis=2)
            nearest = distance.argmin(axis=1)
            own = distance.argmin(axis=0)[nearest] == np.arange(len(features))
            same = own & (distance.min(axis=1) <= self._settings.associate_px)
            tracks[same] = self._tracker.ids[nearest[same]]
        return KeptView(observation.stamp_ns, anchor_from_view, features, tracks)

    def _follow(self, view: KeptView) -> None:
        """Make tracks of a view's features that have none, and give the filter an even choice of them."""
        new = view.tracks < 0
        ids = np.arange(self._next_track, self._next_track + int(new.sum()), dtype=np.int64)
        self._next_track += len(ids)
        view.tracks[new] = ids
        self._tracker.add(ids, view.features.raw[new])
        self._strikes = {int(t): 0 for t in self._tracker.ids}
        room = self._settings.filtered - len(self._filter.ids)
        if room > 0 and len(ids):
            chosen = _even_choice(view.features.pixels[new], self._filter_pixels(), room)
            wanted = np.full(len(chosen), 1.0 / self._prior_depth)
            self._filter.add(ids[chosen], view.features.pixels[new][chosen], wanted, 0.6 * wanted)
        self._history.record(self._filter.pose.mean, self._tracker.ids, self._tracker.pixels, force=True)

    def _filter_pixels(self) -> Array:
        return self._tracker.pixels[np.isin(self._tracker.ids, self._filter.ids)]

    # Nodes and edges

    def _number(self) -> NodeId:
        number = NodeId(self._map_id.agent, self._map_id.epoch, self._next_number)
        self._next_number += 1
        return number

    def _emit_episode(self, anchor: KeptView, leaves: list[KeptView]) -> list[ChangeBody]:
        changes: list[ChangeBody] = []
        emitted = self._emit(anchor, changes)
        if emitted is None:
            return changes
        if self._last is not None:
            changes.append(EdgePut(self._edge(self._last, emitted, self._last.node_from_anchor)))
        changes += self._close_loops(emitted)
        self._last = emitted
        for leaf in leaves:
            beside = self._emit(leaf, changes)
            if beside is not None:
                changes.append(EdgePut(self._edge(emitted, beside, self._sober(leaf.anchor_from_view))))
        depths = emitted.node.landmarks.depths
        self._prior_depth = float(np.median(depths))
        return changes

    def _emit(self, view: KeptView, changes: list[ChangeBody]) -> _Emitted | None:
        """Make a node of a view, unless too little of it is known."""
        landmarks, tracks = self._landmarks(view)
        if len(landmarks) < self._settings.least_landmarks:
            return None
        node = Node(
            self._number(), view.stamp_ns, self._map_from_anchor @ view.anchor_from_view,
            self._description.camera, landmarks,
        )  # fmt: skip
        changes.append(NodePut(node))
        return _Emitted(node, tracks, PoseGaussian(Pose2(), np.zeros((3, 3))))

    def _landmarks(self, view: KeptView) -> tuple[Landmarks, NDArray[np.int64]]:
        """The view's features with depth in the view: by the filter, else triangulated."""
        s, camera = self._settings, self._description.camera
        view_from_anchor = view.anchor_from_view.mean.inverse()
        poses, pixels = self._history.sightings(view.tracks)
        count = len(view.tracks)
        depths, sigmas = np.full(count, np.nan), np.full(count, np.nan)
        if len(poses) >= 2 and count:
            solved = triangulate(poses, pixels, camera, reference=view.anchor_from_view.mean.vector)
            fits = solved.chi2 < 4.0
            depths[fits], sigmas[fits] = solved.depths[fits], solved.depth_sigmas[fits]
        ids, points, covariances, _, _ = self._filter.landmarks()
        if len(ids):
            in_view = (view_from_anchor @ self._filter.pose.mean).apply(points)
            turn = (view_from_anchor @ self._filter.pose.mean).rotation[0]
            spread = np.einsum("i,nij,j->n", turn, covariances[:, :2, :2], turn)
            seat = {int(t): k for k, t in enumerate(view.tracks)}
            for row, track in enumerate(ids.tolist()):
                if track in seat and in_view[row, 0] > camera.mount_forward + 0.05:
                    depths[seat[track]] = in_view[row, 0] - camera.mount_forward
                    sigmas[seat[track]] = np.sqrt(max(spread[row], 1e-12))
        with np.errstate(invalid="ignore"):
            good = np.flatnonzero((depths > 0.05) & (sigmas < s.depth_share * depths))[: s.most_landmarks]
        # Tracks err alike for a while, which neither filter nor triangulation knows.
        sigmas = np.hypot(sigmas, s.depth_floor[0] + s.depth_floor[1] * depths)
        landmarks = Landmarks(
            view.features.pixels[good].astype(np.float32), view.features.codes[good],
            depths[good].astype(np.float32), sigmas[good].astype(np.float32),
        )  # fmt: skip
        return landmarks, view.tracks[good]

    def _edge(self, a: _Emitted, b: _Emitted, a_from_b: PoseGaussian) -> Edge:
        _, in_a, in_b = np.intersect1d(a.tracks, b.tracks, return_indices=True)
        driven = float(np.hypot(a_from_b.mean.x, a_from_b.mean.y))
        kind = EdgeKind.TURNED if driven < TURN_ONLY else EdgeKind.MAPPED
        shared = np.stack([in_a, in_b], axis=1).astype(np.int64)
        return Edge(
            self._number(), a.node.id, b.node.id, a_from_b, kind, shared, {"shared": float(len(shared))}
        )

    def _sober(self, moved: PoseGaussian) -> PoseGaussian:
        """A posture of the filter with the uncertainty that the filter cannot know."""
        s = self._settings
        way, turn = float(np.hypot(moved.mean.x, moved.mean.y)), abs(moved.mean.heading)
        position = s.edge_floor[0] + s.edge_share[0] * way
        heading = s.edge_floor[1] + s.edge_share[1] * turn
        more = np.diag([position**2, position**2, heading**2])
        return PoseGaussian(moved.mean, moved.covariance + more)

    def _close_loops(self, emitted: _Emitted) -> list[ChangeBody]:
        """Recognise places of the own map (paper, section 5): each gives a new edge."""
        s, node = self._settings, emitted.node
        near = []
        for other in self.map.nodes.values():
            between = other.map_from_robot.mean.inverse() @ node.map_from_robot.mean
            reach = float(np.hypot(between.x, between.y))
            if reach < s.loop_reach and abs(between.heading) < s.loop_turn:
                near.append((reach, other))
        changes: list[ChangeBody] = []
        for _, other in sorted(near, key=lambda pair: pair[0])[: s.loop_tries]:
            if self._last is not None and other.id == self._last.node.id:
                continue
            found = register(other, node, None, self._rng)
            if found is not None and found.evidence["sigma_xy"] < s.loop_sigma:
                edge = Edge(
                    self._number(),
                    other.id,
                    node.id,
                    found.node_from_robot,
                    EdgeKind.LOOP,
                    found.pairs,
                    found.evidence,
                )
                changes.append(EdgePut(edge))
        return changes


@dataclass(eq=False)
class _Emitted:
    """The last node that was made, and where the current anchor stands from it."""

    node: Node
    tracks: NDArray[np.int64]
    node_from_anchor: PoseGaussian


def _even_choice(candidates: Array, taken: Array, most: int) -> NDArray[np.int64]:
    """Choose pixels far from each other and from those taken, by farthest-point sampling.

    Args:
        candidates: (N, 2) px, strongest first.
        taken: (M, 2) px.
        most: how many to choose.

    Returns:
        (K,) indices of the candidates.
    """
    distance = np.full(len(candidates), np.inf)
    if len(taken):
        distance = np.linalg.norm(candidates[:, None] - taken[None], axis=2).min(axis=1)
    chosen: list[int] = []
    while len(chosen) < min(most, len(candidates)):
        best = int(distance.argmax()) if np.isfinite(distance).all() else int(np.isinf(distance).argmax())
        chosen.append(best)
        distance = np.minimum(distance, np.linalg.norm(candidates - candidates[best], axis=1))
        distance[best] = -1.0
    return np.array(chosen, np.int64)
