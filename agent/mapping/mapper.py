"""Mapping: observations in, nodes and edges out. Who drives, explorer or person, is not its business."""

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.arrays import among, median
from mapweave.agent.edge_measurement.traverse import Traverse
from mapweave.agent.ekf.landmark_estimates import LandmarkEstimates
from mapweave.agent.ekf.update_report import Health
from mapweave.agent.mapping.anchored_keyframe import HERE
from mapweave.agent.mapping.episode import EpisodeRequest
from mapweave.agent.mapping.keyframe_builder import KeyframeBuilder
from mapweave.agent.mapping.node_retirement import NodeRetirement, Released, alone
from mapweave.agent.mapping.tracking import Tracking
from mapweave.agent.mapping.trajectory_recorder import TrajectoryRecorder
from mapweave.agent.mapping.view import PendingKeyframe, RawImage
from mapweave.agent.mapping.way_correction import WayCorrection
from mapweave.agent.observation import Observation, RobotDescription
from mapweave.agent.settings import AgentSettings
from mapweave.agent.vision.track_quality import TrackQuality
from mapweave.hybridmap.change import ChangeBody
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Landmarks, Node
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.registration.recognition import Recognition
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Features, Sift

DEPTHS_PER_HEIGHT = 8.0
"""Assumed depth of an unknown feature before there is any node, as a multiple of the camera's height (the
paper's "assumed common height")."""


class Mapper:
    """Cuts a drive into episodes. Each begins at a view, the *anchor*, and ends at the next.

    The filter's pose is relative to the anchor, with zero covariance there (the paper's P_0^r = 0). So
    its covariance at the next anchor is that of the edge between the two nodes.

    Attributes:
        typical_depth: median depth of the last node's landmarks, m; before there is one, an assumed depth.
    """

    def __init__(
        self,
        map_id: MapId,
        description: RobotDescription,
        settings: AgentSettings | None = None,
        contents: Sequence[ChangeBody] = (),
        next_number: int = 1,
        lens: Lens | None = None,
        released: Released = alone,
    ) -> None:
        """Start an empty map at the robot's pose, or resume one; see KeyframeBuilder and NodeRetirement."""
        settings = settings or AgentSettings()
        self.typical_depth = DEPTHS_PER_HEIGHT * max(description.camera.mount_height, 0.05)
        self._description = description
        self._settings = settings
        self._lens = lens or Lens(description.camera, description.distortion)
        # What `recalibrate` was given, until the episode ends.
        self._next_geometry: tuple[RobotDescription, Lens, Pose2, float] | None = None
        self._way_moved: WayCorrection | None = None
        # rad, by which the robot has turned further since the anchor view than the filter says.
        self._missed_turn = 0.0
        self._sift = Sift(self._lens, settings.sift)
        self._tracking = Tracking(description, self._lens, settings)
        self._keyframes = KeyframeBuilder(map_id, description, settings.landmarks, contents, next_number)
        self._retirement = NodeRetirement(self._keyframes.map, released)
        self._trajectory = TrajectoryRecorder(description)
        # Many ask for `map_from_robot` in a tick: it is kept, behind the three values of which it was made.
        self._composed = HERE, HERE, 0.0, HERE
        self._anchor: PendingKeyframe | None = None
        self._further: list[PendingKeyframe] = []
        # A thread extracts features, which are used when the next tick begins, by waiting for them: no result
        # depends on speed. Those of the next anchor are used earlier if a behaviour asks for its features:
        # episodes that begin a tick later cost a robot a quarter of its nodes.
        self._extraction = ThreadPoolExecutor(1, "features")
        self._extracting: tuple[Future[Features], Callable[[Features], None]] | None = None

    # What behaviours read

    @property
    def map(self) -> HybridMap:
        """What was mapped so far."""
        return self._keyframes.map

    @property
    def last(self) -> NodeId | None:
        """The node from which the map goes on: the newest, or the one that was recognised; None if lost."""
        return self._keyframes.last

    @property
    def started(self) -> bool:
        """Whether there is an anchor view to map from."""
        return self._anchor is not None

    @property
    def astray(self) -> bool:
        """Whether there is a map and the robot does not know where on it it is: it must recognise a place."""
        return self._anchor is None and bool(self.map.nodes)

    @property
    def doubtful(self) -> bool:
        """Whether the last image shows nothing of what it should, or none comes: no time to map."""
        return self._tracking.acceptance.doubtful or self._tracking.contradicted

    @property
    def doubt(self) -> str:
        """Why, in words."""
        images = self._tracking.acceptance
        if images.strange:
            return "the image shows something else than a moment ago"
        if images.blank:
            return "the image shows nothing: is it dark, or the lens covered?"
        if images.doubtful:
            return "the camera gives no new image"
        return "the image shows another motion than the wheels" if self._tracking.contradicted else ""

    @property
    def health(self) -> str:
        """What is wrong with the estimate of the pose, in words; empty if nothing is.

        That depths are unknown before the robot has moved goes without saying.
        """
        health, reason = self._tracking.health
        return reason if self.started and health is not Health.NO_PARALLAX else ""

    @property
    def anchor_from_robot(self) -> Pose2:
        """Pose since the anchor view."""
        return self._tracking.pose.mean

    @property
    def since_anchor(self) -> PoseGaussian:
        """Pose since the anchor view, and how well it is known."""
        return self._tracking.pose

    @property
    def map_from_robot(self) -> PoseGaussian:
        """Pose in the agent's map."""
        anchor, moved, turn = self._keyframes.map_from_anchor, self._tracking.pose, self._missed_turn
        if self._composed[0] is not anchor or self._composed[1] is not moved or self._composed[2] != turn:
            self._composed = anchor, moved, turn, anchor @ _turned_further(moved, turn)
        return self._composed[3]

    @property
    def description(self) -> RobotDescription:
        """The robot as it is mapped with now."""
        return self._description

    @property
    def tracks(self) -> tuple[object, NDArray[np.int64], Array]:
        """Whose tracks, their (N,) ids and (N, 2) px in the real image; see `tracked`."""
        return (self._tracking, *self._tracking.raw_tracks)

    @property
    def turned(self) -> float:
        """How far the robot has turned since the tracks began, by the filter, rad, but for whole turns."""
        return self._tracking.turned

    @property
    def tracked(self) -> int:
        """Tracks alive; in the tick that ends an episode perhaps still without the next anchor's features."""
        return len(self._tracking.ids)

    @property
    def track_report(self) -> TrackQuality:
        """Age of the tracks, how well they agree with the filter, and how much of the image they cover."""
        return self._tracking.report

    @property
    def anchored(self) -> int:
        """Features of the anchor view that are still tracked."""
        self._use_extracted()
        return 0 if self._anchor is None else int(among(self._tracking.ids, self._anchor.tracks).sum())

    @property
    def anchor_features(self) -> int:
        """Features that the anchor view had."""
        self._use_extracted()
        return 0 if self._anchor is None else len(self._anchor.features)

    @property
    def bearings(self) -> Array:
        """(N,) rad, bearings of the tracks, positive to the left."""
        self._use_extracted()
        return self._description.camera.bearings(self._tracking.pixels)

    @property
    def converged_share(self) -> float:
        """Share of the filter's landmarks whose depth has converged; 0 without landmarks."""
        return self._tracking.converged_share

    @property
    def landmarks(self) -> LandmarkEstimates:
        """The filter's landmarks, in robot."""
        return self._tracking.landmarks()

    def take_changes(self) -> tuple[ChangeBody, ...]:
        """What was changed in the map since the last call; the only way by which nodes and edges leave."""
        return self._keyframes.take_changes()

    def take_images(self) -> tuple[tuple[NodeId, RawImage], ...]:
        """The images of the nodes that were made since the last call."""
        return self._keyframes.take_images()

    def take_way_moved(self) -> WayCorrection | None:
        """How the way until now continues in that from now on; None unless the geometry has changed since
        the last call.

        When it becomes known that the axle is elsewhere below the camera, the camera keeps its place on the
        map, so `map_from_robot` jumps. The way is that of an axle all along: wheels do not go sideways, and
        the filter let it go as they do. So what came before is moved as a whole, and scaled as the map is.
        """
        moved, self._way_moved = self._way_moved, None
        return moved

    def drove(self, traverse: Traverse | None, refined: Node | None) -> None:
        """Take in what was measured on a drive while nothing was mapped; see KeyframeBuilder."""
        self._keyframes.drove(traverse, refined)

    def retire_superseded(self, now_ns: int) -> None:
        """Let a node go that newer ones have superseded for long, if there is one; call it once a tick.

        Not while a drive to a goal may use it.
        """
        last = self.last
        node = self._retirement.next(now_ns, () if last is None else (last,))
        if node is not None:
            self._keyframes.retire(node)

    def finish_pending(self) -> None:
        """Make what is left of the last episode: its nodes and loop closures.

        The ticks that follow do it else, piece by piece.
        """
        self._keyframes.finish_pending()

    # One tick, and what ends an episode

    def step(self, observation: Observation) -> None:
        """Take in what the robot senses. Call once a tick, before anything below."""
        self._keyframes.continue_pending()
        self._use_extracted()
        self._tracking.step(observation)
        if self._tracking.acceptance.carried_off or self._tracking.disputed:
            self.lose()
            self._tracking.step(observation)
        elif self._anchor is not None and not self.doubtful:
            self._trajectory.step(observation, self._tracking.pose.mean)

    def recalibrate(
        self, description: RobotDescription, lens: Lens, old_from_new: Pose2, scale: float = 1.0
    ) -> None:
        """Know the robot's geometry better from the next node on.

        Args:
            description: of the robot.
            lens: of its camera.
            old_from_new: of the robot's frame: the axle is elsewhere, as seen from the camera.
            scale: of the wheels: true over assumed way, since the map was begun or this was last called.
        """
        self._next_geometry = description, lens, old_from_new, scale

    def correct_turn(self, turn: float) -> None:
        """Know that the robot has turned further than the filter says, rad.

        `map_from_robot` has it at once, and the next edge; what is relative to the anchor is the filter's.
        """
        self._missed_turn += turn

    def doubt_lever(self, error: float) -> None:
        """Know that the camera may stand so far from where it is assumed on the robot, m, for this episode.

        In turns image and wheels are then apart without either being wrong.
        """
        self._tracking.doubt_lever(error)

    def forget_clock(self) -> None:
        """The clock has jumped: see KeyframeBuilder."""
        self._keyframes.forget_clock()

    def meet(self, request: EpisodeRequest, observation: Observation) -> None:
        """Do what a behaviour asks for, with the observation of the last step."""
        match request:
            case EpisodeRequest.BEGIN:
                self.begin(observation)
            case EpisodeRequest.ADD_VIEW:
                self.add_view(observation)
            case EpisodeRequest.FINISH:
                self.finish(observation)

    def begin(self, observation: Observation) -> None:
        """Take the first view: the anchor of the first episode."""
        if observation.image is not None:
            features = self._extract(observation.image, observation.left_out).result()
            self._begin_at(self._tracking.take(observation, features, HERE))

    def lose(self) -> None:
        """The robot's pose is lost. Observations since the anchor view are dropped.

        With nodes it is astray and must `resume`; without any it may `begin` again.
        """
        self._missed_turn = 0.0
        self._keyframes.lose(self._tracking.pose)
        self._take_up_geometry()
        self._tracking = Tracking(self._description, self._lens, self._settings)
        self._anchor, self._further = None, []
        self._extracting = None

    def resume(
        self, observation: Observation, features: Features, node: Node, recognition: Recognition
    ) -> None:
        """Go on from an image in which a node of the own map was recognised: it is the next anchor.

        Args:
            observation: with the image.
            features: of that image.
            node: of `map`.
            recognition: of the node in the features.
        """
        self.lose()
        self._tracking.step(observation)
        anchor = self._tracking.take(observation, features, HERE)
        self.typical_depth = median(node.landmarks.depths[node.landmarks.has_depth])
        self._begin_at(anchor)
        self._keyframes.recognise(node, anchor.tracks, recognition)

    def _begin_at(self, anchor: PendingKeyframe) -> None:
        self._tracking.reanchor()
        self._anchor = anchor
        self._trajectory.clear(anchor.stamp_ns)
        self._tracking.follow(anchor)
        self._tracking.fill(self.typical_depth)

    def add_view(self, observation: Observation) -> None:
        """Keep the current image as a further node, for example at the far end of a drive."""
        if observation.image is None:
            return
        pose = self._tracking.pose
        self._tracking.remember(force=True)

        def take(features: Features) -> None:
            self._further.append(self._tracking.take(observation, features, pose))

        self._use_extracted()
        self._extracting = self._extract(observation.image, observation.left_out), take

    def finish(self, observation: Observation) -> None:
        """End the episode: its views become nodes in the ticks after, the current image the next anchor.

        Without an image nothing is done.
        """
        self._use_extracted()
        self.finish_pending()
        if observation.image is None or self._anchor is None:
            return
        features = self._extract(observation.image, observation.left_out)
        tracking, anchor, further = self._tracking, self._anchor, self._further
        tracking.remember(force=True)
        estimate = tracking.estimate
        moved = _turned_further(tracking.reanchor(), self._missed_turn)
        self._missed_turn = 0.0

        def take(features: Features) -> None:
            self._anchor = tracking.take(observation, features, HERE)
            tracking.follow(self._anchor)

        self._extracting, self._further = (features, take), []

        def known(landmarks: Landmarks | None) -> None:
            self._use_extracted()
            if landmarks is None:
                self._trajectory.move_anchor(moved.mean)
            else:
                self.typical_depth = median(landmarks.depths)
                self._trajectory.clear(observation.stamp_ns)
            tracking.fill(self.typical_depth)

        # The tick that waits for the features leaves the landmarks to the next one.
        self._keyframes.place(anchor, further, estimate, self._trajectory, moved, known)
        if self._next_geometry is not None:
            self._use_extracted()
        if self._take_up_geometry():
            # Tracks and features of another lens are of no use to a filter of this one.
            self._tracking = Tracking(self._description, self._lens, self._settings)
            self._tracking.step(observation)
            self.begin(observation)

    def _extract(self, image: NDArray[np.uint8], left_out: Array) -> Future[Features]:
        """Have the features of an image extracted, without those of some regions."""
        return self._extraction.submit(self._sift.extract, image, left_out)

    def _use_extracted(self) -> None:
        """Use the features of the image before. Nothing was tracked since."""
        if self._extracting is not None:
            (features, take), self._extracting = self._extracting, None
            take(features.result())

    def _take_up_geometry(self) -> bool:
        """Change to another geometry, between two episodes; returns whether there was any."""
        if self._next_geometry is None:
            return False
        self._description, self._lens, old_from_new, scale = self._next_geometry
        self._next_geometry = None
        self._sift = Sift(self._lens, self._settings.sift)
        way = self._keyframes.recalibrate(self._description, old_from_new, scale)
        self.typical_depth *= scale
        after = self._keyframes.map_from_anchor.mean
        self._way_moved = WayCorrection(after @ old_from_new @ after.inverse() @ way.moved, way.scale)
        self._trajectory.rescale(scale)
        self._trajectory.move_anchor(old_from_new)
        return True


def _turned_further(moved: PoseGaussian, turn: float) -> PoseGaussian:
    """A way along which the robot has turned further by so much, rad, evenly."""
    if not turn:
        return moved
    half = Pose2(0.0, 0.0, 0.5 * turn)
    return PoseGaussian(half @ moved.mean @ half, moved.covariance)
