"""A drive with odometry whose robots ask a map: that which another robot makes when carried along, or any."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Mapping

from mapweave.agent.calibration.correction import OdometryCorrection, corrected, geometry_of
from mapweave.agent.drivers.replay import Replay
from mapweave.agent.mission import Carried
from mapweave.agent.pipeline import Pipeline
from mapweave.agent.settings import AgentSettings
from mapweave.evaluation.asking_again import Asked, LostDrive, trials_of
from mapweave.evaluation.truth import Truth
from mapweave.evaluation.verdict import LEVELS, SURE, JudgedAnswer
from mapweave.hybridmap.change import Change, ChangeBody
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Pose2, wrap_angle
from mapweave.hybridmap.query import Whereabouts
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.relocalization.relocalizer import Relocalizer
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.offline_relocalization import relocalizer_in
from mapweave.vision.sift import Sift

REACH = 1.5
"""A place counts as mapped if the mapping robot has been this near to it, m,"""
TURN = math.radians(20.0)
"""and had that heading, within this, rad."""


class DriveMap:
    """A map, and the places where its robots were.

    Attributes:
        nodes: how many the map has.
        covered: truth of the places that were mapped.
        trials: of the robots that have asked to their end.
    """

    def __init__(
        self, nodes: Mapping[NodeId, Node], relocalizer: Relocalizer, covered: list[Pose2], truth: Truth
    ) -> None:
        """Take a map."""
        self.nodes, self.covered = len(nodes), covered
        self.trials: list[LostDrive] = []
        self._nodes = nodes
        self._relocalizer, self._truth = relocalizer, truth

    @staticmethod
    def of_pass(robot: Replay, truth: Truth, settings: AgentSettings, ticks: Iterable[int]) -> DriveMap:
        """Map.

        Args:
            robot: the recording of the first pass; read to its end.
            truth: for scoring alone.
            settings: of the pipeline.
            ticks: as many numbers as there are images; going through them shows progress.
        """
        covered, camera = list[Pose2](), robot.describe().camera
        map_id = MapId("map", 1)
        pipeline = Pipeline(map_id, robot.describe(), settings)
        pipeline.set_mission(Carried())
        merger, bodies, stamp_ns = Merger(), list[ChangeBody](), 0
        for _, observation in zip(ticks, iter(robot.sense, None), strict=False):
            assert observation is not None, "the recording ends the loop"
            if (pose := truth.robot_at(observation.stamp_ns, camera)) is not None:
                covered.append(pose)
            bodies += pipeline.step(observation, ()).changes
            stamp_ns = observation.stamp_ns
        for sequence, body in enumerate([*bodies, *pipeline.finish()[0]], start=1):
            merger.on_change(Change(map_id, sequence, stamp_ns, body))
        merged = merger.merged()
        relocalizer = Relocalizer(merger.places, merger.node, merged)
        return DriveMap(merged.maps[map_id].nodes if merged.maps else {}, relocalizer, covered, truth)

    @staticmethod
    def of_map(merged: MergedMap, truth: Truth) -> DriveMap:
        """Take a map that is there. Where its nodes truly are follows from their stamps.

        Args:
            merged: the map.
            truth: of the same clock as the nodes' stamps, for scoring alone.
        """
        nodes = {node.id: node for one in merged.maps.values() for node in one.nodes.values()}
        true_poses = (truth.robot_at(node.stamp_ns, node.camera) for node in nodes.values())
        covered = [pose for pose in true_poses if pose is not None]
        return DriveMap(nodes, relocalizer_in(merged), covered, truth)

    def questions(self, robot: Replay) -> Iterator[JudgedAnswer]:
        """Ask where each image of another pass was taken; at the end `trials` has what robots make of it."""
        declared = robot.describe()
        geometry, wheels = geometry_of(declared), OdometryCorrection()
        # As an agent does: a camera that is declared to look up or aside is turned level.
        description, lens = corrected(declared, geometry)
        sift = Sift(lens)
        asked, true_poses = list[Asked](), list[Pose2 | None]()
        odom_from_robot, way, turned = Pose2(), 0.0, 0.0
        while (sensed := robot.sense()) is not None:
            observation = wheels.step(sensed, geometry)
            assert observation.image is not None, "a recording has all its images"
            began = time.perf_counter()
            view = sift.extract(observation.image).view(description.camera)
            extracted = time.perf_counter()
            answer = self._relocalizer.answer(view)
            done = time.perf_counter()
            true = self._truth.robot_at(observation.stamp_ns, description.camera)
            expected = None if true is None else self._covers(true)
            odom_from_robot = odom_from_robot @ observation.odometry.motion()
            way += abs(observation.odometry.forward)
            turned += abs(observation.odometry.turn)
            asked.append(Asked(answer, odom_from_robot, way, turned, expected))
            true_poses.append(true)
            error_m, error_deg, place = math.nan, math.nan, ""
            if answer.certainty in SURE:
                place = str(answer.candidates[0].node)
                error_m, error_deg = self._error(answer.candidates[0], true)
            yield JudgedAnswer(
                query=f"{observation.stamp_ns / 1e9:.3f} s",
                expected=expected,
                certainty=answer.certainty,
                place=place,
                right=self._is_right(answer.candidates[0], true) if answer.certainty in SURE else None,
                error_m=error_m,
                error_deg=error_deg,
                extract_ms=1e3 * (extracted - began),
                answer_ms=1e3 * (done - extracted),
            )
        self.trials += trials_of(asked, lambda k, place: self._is_right(place, true_poses[k]))

    def _covers(self, true: Pose2) -> bool:
        return any(
            pose.distance(true) <= REACH and abs(wrap_angle(pose.heading - true.heading)) <= TURN
            for pose in self.covered
        )

    def _is_right(self, place: Whereabouts, true: Pose2 | None) -> bool | None:
        """Whether a robot is at a place; None without truth."""
        error_m, error_deg = self._error(place, true)
        if not math.isfinite(error_m):
            return None
        most_m, most_deg = LEVELS[-1]
        return error_m <= most_m and error_deg <= (most_deg if place.distance_known else math.degrees(TURN))

    def _error(self, place: Whereabouts, true: Pose2 | None) -> tuple[float, float]:
        """The error of the position, m, and of the heading, degrees; NaN without truth."""
        node = self._nodes.get(place.node)
        at_node = None if node is None else self._truth.robot_at(node.stamp_ns, node.camera)
        if true is None or at_node is None:
            return math.nan, math.nan
        answered = at_node @ (place.node_from_robot.mean if place.distance_known else Pose2())
        return answered.distance(true), math.degrees(abs(wrap_angle(answered.heading - true.heading)))
