"""A robot's own map over many drives, made by the agent's own parts of views that are not rendered.

At the beginning of a drive the robot recognises a place of its map, as one that was switched on. From there
each view is tied to the one before by odometry, and to nodes nearby by loop closures.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapweave import HybridMap, MapId, Node, NodeId, Pose2, PoseGaussian, RobotDescription
from mapweave.agent.mapping.anchored_keyframe import AnchoredKeyframe
from mapweave.agent.mapping.keyframe_builder import KeyframeBuilder
from mapweave.hybridmap.change import ChangeBody
from mapweave.registration.recognition import register
from mapweave.registration.selection import SelectionSettings
from synthetic.world import CAMERA, Sensing, World, take_node

SENSING = Sensing(unknown_depth=0.0)
"""A robot keeps only landmarks whose depth it knows."""
PAUSE = 20_000_000_000
"""Between two views of a drive, ns."""
SIGMAS = 0.01, 0.01, 0.01
"""Of the odometry between two views, m, m and rad."""
NEAR, TURNED = 1.2, 0.7
"""Nodes that the robot tries to recognise at first, m and rad."""


class SurveyedMap:
    """A robot's map, and where its nodes truly are.

    Attributes:
        builder: makes it.
        truth: `world_from_robot` of the nodes that it has ever had.
        times: s, what each of them took.
    """

    def __init__(self, map_id: MapId, rng: np.random.Generator) -> None:
        """Begin with an empty map."""
        self.builder = KeyframeBuilder(map_id, RobotDescription(CAMERA), SelectionSettings())
        self.truth: dict[NodeId, Pose2] = {}
        self.times: list[float] = []
        self._rng = rng
        self._tracks = 0

    @property
    def map(self) -> HybridMap:
        """As it is now."""
        return self.builder.map

    def drive(self, world: World, tour: Sequence[Pose2], begin_ns: int) -> tuple[ChangeBody, ...]:
        """Map once more; returns what was changed.

        Args:
            world: what there is to see.
            tour: `world_from_robot` of the views. Those before the first at which a place is recognised
                become no nodes.
            begin_ns: the robot's clock.
        """
        before: Pose2 | None = None
        for number, here in enumerate(tour):
            stamp_ns = begin_ns + number * PAUSE
            if before is not None:
                noise = self._rng.normal(0.0, SIGMAS)
                step = before.inverse() @ here @ Pose2.from_vector(noise)
                self.builder.move_anchor(PoseGaussian.from_sigmas(step, SIGMAS[0], SIGMAS[2]))
            elif self.map.nodes and not self._resumed(world, here):
                continue
            before = here
            node = take_node(
                world, self.builder.new_id(), here, self.builder.map_from_anchor, self._rng, SENSING
            )
            self.truth[node.id] = here
            began = time.perf_counter()
            self.builder.join(AnchoredKeyframe(replace(node, stamp_ns=stamp_ns), self._new_tracks(node)))
            self.builder.finish_pending()
            self.times.append(time.perf_counter() - began)
        return self.builder.take_changes()

    def _resumed(self, world: World, here: Pose2) -> bool:
        """Whether a place is recognised from which the map goes on."""
        nothing = PoseGaussian(Pose2(), np.zeros((3, 3)))
        view = take_node(world, NodeId("view", 0, 1), here, nothing, self._rng, SENSING)
        for node in self.map.nodes.values():
            between = self.truth[node.id].inverse() @ here
            if math.hypot(between.x, between.y) < NEAR and abs(between.heading) < TURNED:
                recognition = register(node, view, None, self._rng)
                if recognition is not None:
                    self.builder.recognise(node, self._new_tracks(view), recognition)
                    return True
        return False

    def _new_tracks(self, node: Node) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
        """Tracks of a view's features, that no view before had."""
        self._tracks += len(node.landmarks)
        return np.arange(self._tracks - len(node.landmarks), self._tracks)
