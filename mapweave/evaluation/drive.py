"""A drive with odometry: one robot of its splits.toml maps as it does when carried, the others ask."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator

from mapweave.agent.drivers.replay import Replay
from mapweave.agent.mission import Carried
from mapweave.agent.observation import RobotDescription
from mapweave.agent.pipeline import Pipeline
from mapweave.agent.settings import AgentSettings
from mapweave.evaluation.asking_again import Asked, Trial, trials_of
from mapweave.evaluation.truth import Truth
from mapweave.evaluation.verdict import LEVELS, SURE, Verdict
from mapweave.hybridmap.change import Change
from mapweave.hybridmap.node import MapId
from mapweave.hybridmap.pose import Pose2, wrap_angle
from mapweave.hybridmap.query import Whereabouts
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.relocalization.relocalizer import Relocalizer
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Sift

REACH = 1.5
"""A place counts as mapped if the mapping robot has been this near to it, m,"""
TURN = math.radians(20.0)
"""and had that heading, within this, rad."""
NEAR = (LEVELS[-1][0], math.degrees(TURN))
"""A node is the right place if it is that near, m and degrees."""


class DriveMap:
    """What the mapping robot has left behind, and the places where it was.

    Attributes:
        description: of the robot.
        nodes: how many were made.
        covered: truth of all its images.
        trials: of the robots that have asked to their end.
    """

    def __init__(self, robot: Replay, truth: Truth, settings: AgentSettings, ticks: Iterable[int]) -> None:
        """Map.

        Args:
            robot: the recording of the first pass; read to its end.
            truth: for scoring alone.
            settings: of the pipeline.
            ticks: as many numbers as there are images; going through them shows progress.
        """
        self.description: RobotDescription = robot.describe()
        self.covered: list[Pose2] = []
        self.trials: list[Trial] = []
        map_id = MapId("map", 1)
        pipeline = Pipeline(map_id, self.description, settings)
        pipeline.set_mission(Carried())
        merger, sequence = Merger(), 0
        for _, observation in zip(ticks, iter(robot.sense, None), strict=False):
            assert observation is not None, "the recording ends the loop"
            if (pose := truth.at(observation.stamp_ns)) is not None:
                self.covered.append(pose)
            for change in pipeline.step(observation, ()).changes:
                sequence += 1
                merger.on_change(Change(map_id, sequence, observation.stamp_ns, change))
        merged = merger.merged()
        self.nodes = len(merged.poses)
        self._truth = truth
        self._merger = merger
        self._relocalizer = Relocalizer(merger.places, merger.node, merged)
        self._sift = Sift(Lens(self.description.camera, self.description.distortion))

    def questions(self, robot: Replay) -> Iterator[Verdict]:
        """Ask where each image of another pass was taken; at the end `trials` has what robots make of it."""
        asked, true_poses = list[Asked](), list[Pose2 | None]()
        odom_from_robot, way, turned = Pose2(), 0.0, 0.0
        while (observation := robot.sense()) is not None:
            assert observation.image is not None, "a recording has all its images"
            began = time.perf_counter()
            view = self._sift.extract(observation.image).view(self.description.camera)
            extracted = time.perf_counter()
            answer = self._relocalizer.answer(view)
            done = time.perf_counter()
            true = self._truth.at(observation.stamp_ns)
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
            yield Verdict(
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
        """Of the position, m, and of the heading, degrees; NaN without truth."""
        node = self._merger.node(place.node)
        at_node = None if node is None else self._truth.at(node.stamp_ns)
        if true is None or at_node is None:
            return math.nan, math.nan
        answered = at_node @ (place.node_from_robot.mean if place.distance_known else Pose2())
        return answered.distance(true), math.degrees(abs(wrap_angle(answered.heading - true.heading)))
