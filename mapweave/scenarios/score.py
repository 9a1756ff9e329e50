"""From what a trial left behind to its figures."""

import hashlib
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from mapweave.evaluation.map_score import is_false, link_recall, pose_error, score_map
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.pose import Pose2
from mapweave.scenarios.coverage import explored_share, longest_loop
from mapweave.scenarios.expectations import ExpectationResult
from mapweave.scenarios.figures import Figures, RobotFigures, measured
from mapweave.scenarios.recording import Lost, RobotRecord, TrialRecording, TrialTrajectory
from mapweave.scenarios.trajectories import score_trajectory

FOUND_M, FOUND_DEG = 0.25, 5.0
"""A first answer that is off by more does not count as found."""
REACHED_M, REACHED_DEG = 0.05, 3.0
"""A robot farther from its goal has not reached it."""
HALF_TICK_NS = 50_000_000


@dataclass(frozen=True, eq=False)
class TrialResult:
    """What came of a trial."""

    recording: TrialRecording
    figures: Figures
    verdicts: tuple[ExpectationResult, ...]

    def as_dict(self) -> dict[str, Any]:
        """The run for JSON."""
        return {
            "scenario": self.recording.scenario,
            "seed": self.recording.seed,
            "passed": self.passed,
            "figures": self.figures.as_dict(),
            "verdicts": [asdict(verdict) for verdict in self.verdicts],
        }

    @property
    def passed(self) -> bool:
        """Whether every expectation was met."""
        return all(verdict.good for verdict in self.verdicts)


def score(recording: TrialRecording) -> Figures:
    """Judge a trial by the truth.

    Raises:
        InvalidValue: the recording does not belong together: a node was made by no robot of it, or at a time
            that was not simulated.
        SettingsError: evo is not installed.
    """
    whole = HybridMap(recording.merged.changes)
    truth = node_truth(recording)
    links = [e for e in whole.edges.values() if e.kind is EdgeKind.MERGED]
    own = [e for e in whole.edges.values() if e.a.map == e.b.map and e.a in truth and e.b in truth]
    loops = [e for e in own if e.kind is EdgeKind.LOOP]
    paths = {name: record.truth for name, record in recording.robots.items()}
    stamps = {node: whole.nodes[node].stamp_ns for node in truth}
    places = np.array([[pose.x, pose.y] for pose in truth.values()]).reshape(-1, 2)
    merged = score_map({n: (c, p.mean) for n, (c, p) in recording.merged.poses.items()}, links, truth)
    robots = {name: _score_robot(name, record, truth) for name, record in recording.robots.items()}
    falls = [_score_lost(lost, recording.robots[lost.robot].truth, truth) for lost in recording.lost]
    goals = [fall for fall in falls if fall.has_goal]
    minutes = len(robots) * recording.sim_s / 60.0
    map_bytes = sum(r.map_bytes for r in robots.values())
    wire_bytes = sum(r.wire_bytes for r in robots.values())
    return Figures(
        components=merged.components,
        maps=len({n.map for n in truth}),
        nodes=len(truth),
        edges=len(own),
        false_edges=_false(own, truth),
        loops=len(loops),
        false_loops=_false(loops, truth),
        links=merged.links,
        false_links=merged.false_links,
        longest_loop_m=longest_loop([e for e in loops if e.a.agent in paths], truth, paths, stamps),
        explored_share=explored_share(recording.plan, places),
        link_precision=1.0 - merged.false_links / merged.links if merged.links else None,
        link_recall=link_recall(links, truth, recording.plan.walls),
        merged_ate_m=measured(merged.ate),
        # A robot that never mapped (a visitor) makes the others' trajectories no worse.
        trajectory_ate_m=_most(r.trajectory_ate_m for r in robots.values()),
        rpe_m=_most(r.rpe_m for r in robots.values()),
        rpe_deg=_most(r.rpe_deg for r in robots.values()),
        collisions=sum(r.collisions for r in robots.values()),
        found=all(fall.found for fall in falls) if falls else None,
        found_error_m=_worst(fall.found_error_m for fall in falls),
        found_error_deg=_worst(fall.found_error_deg for fall in falls),
        found_s=_worst(fall.found_s for fall in falls),
        reached=all(fall.reached for fall in goals) if goals else None,
        goal_error_m=_worst(fall.goal_error_m for fall in goals),
        goal_error_deg=_worst(fall.goal_error_deg for fall in goals),
        goal_s=_worst(fall.goal_s for fall in goals),
        unsaved_changes=sum(r.unsaved_changes for r in robots.values()),
        **_lies(recording),
        troubles=sum(moment.trouble for moment in recording.moments),
        recovery_s=max(recording.recoveries_s, default=None),
        bytes_per_node=map_bytes / len(truth) if truth else None,
        map_bytes_per_robot_minute=map_bytes / minutes if minutes else None,
        wire_bytes_per_robot_minute=wire_bytes / minutes if minutes else None,
        map_hash=fleet_hash({name: r.map_hash for name, r in robots.items()}),
        sim_s=recording.sim_s,
        wall_s=recording.wall_s,
        real_time_factor=recording.sim_s / recording.wall_s if recording.wall_s else None,
        robots=robots,
    )  # fmt: skip


def _lies(recording: TrialRecording) -> dict[str, Any]:
    """The figures of lies, if a robot has lied."""
    return {} if recording.lies is None else recording.lies.figures()


def node_truth(recording: TrialRecording) -> dict[NodeId, Pose2]:
    """Where each node of the merged map truly is: `world_from_robot` when its image was taken.

    Raises:
        InvalidValue: a node was made by no robot of the recording, or at a time that was not simulated.
    """
    truth = {}
    for node in HybridMap(recording.merged.changes).nodes.values():
        if node.id in recording.photographed:
            truth[node.id] = recording.photographed[node.id]
            continue
        if node.id.agent not in recording.robots:
            raise InvalidValue(f"node {node.id} was made by no robot of this trial")
        truth[node.id] = pose_at(recording.robots[node.id.agent].truth, node.stamp_ns)
    return truth


def pose_at(trajectory: TrialTrajectory, stamp_ns: int) -> Pose2:
    """Where a robot was at a time.

    Raises:
        InvalidValue: more than half a tick away from any time that was simulated.
    """
    stamps = trajectory.stamps_ns
    after = int(np.searchsorted(stamps, stamp_ns - HALF_TICK_NS))
    nearest = (
        after + int(np.argmin(np.abs(stamps[after : after + 2] - stamp_ns))) if after < len(stamps) else 0
    )
    if not len(stamps) or abs(int(stamps[nearest]) - stamp_ns) > HALF_TICK_NS:
        raise InvalidValue(f"{stamp_ns} ns was not simulated: the truth does not know it")
    return Pose2.from_vector(trajectory.poses[nearest])


def fleet_hash(hashes: Mapping[str, str]) -> str:
    """SHA-256 over the robots' hashes in order of their names."""
    return hashlib.sha256("".join(f"{name} {hashes[name]}\n" for name in sorted(hashes)).encode()).hexdigest()


@dataclass(frozen=True)
class _Fall:
    """What became of one lost robot; errors are None where there is nothing to measure."""

    found: bool
    found_error_m: float | None
    found_error_deg: float | None
    found_s: float | None
    has_goal: bool
    reached: bool
    goal_error_m: float | None
    goal_error_deg: float | None
    goal_s: float | None


def _score_lost(lost: Lost, truth: TrialTrajectory, nodes: Mapping[NodeId, Pose2]) -> _Fall:
    error_m = error_deg = after_s = None
    if lost.fix is not None:
        after_s = (lost.fix.stamp_ns - lost.stamp_ns) / 1e9
        # A node outside the merged map has no truth: such an answer does not count.
        if lost.fix.node in nodes:
            answered = nodes[lost.fix.node] @ lost.fix.node_from_robot
            error_m, error_deg = _error(answered, pose_at(truth, lost.fix.stamp_ns))
    goal_m = goal_deg = goal_s = None
    if lost.goal is not None and lost.goal in nodes:
        end_ns = int(truth.stamps_ns[-1]) if lost.arrived_ns is None else lost.arrived_ns
        goal_m, goal_deg = _error(pose_at(truth, end_ns), nodes[lost.goal])
    if lost.arrived_ns is not None:
        goal_s = (lost.arrived_ns - lost.stamp_ns) / 1e9
    return _Fall(
        found=_within(error_m, error_deg, FOUND_M, FOUND_DEG),
        found_error_m=error_m,
        found_error_deg=error_deg,
        found_s=after_s,
        has_goal=lost.goal is not None,
        reached=goal_s is not None and _within(goal_m, goal_deg, REACHED_M, REACHED_DEG),
        goal_error_m=goal_m,
        goal_error_deg=goal_deg,
        goal_s=goal_s,
    )


def _score_robot(name: str, record: RobotRecord, truth: Mapping[NodeId, Pose2]) -> RobotFigures:
    scores = [score_trajectory(record.truth, e) for e in record.estimates.values() if len(e.stamps_ns)]
    nodes = [node for node in truth if node.agent == name]
    return RobotFigures(
        maps=len({node.map for node in nodes}),
        nodes=len(nodes),
        collisions=record.collisions,
        map_bytes=record.map_bytes,
        wire_bytes=record.wire_bytes,
        unsaved_changes=record.unsaved,
        map_hash=record.map_hash,
        trajectory_ate_m=_most(s.ate_m for s in scores),
        rpe_m=_most(s.rpe_m for s in scores),
        rpe_deg=_most(s.rpe_deg for s in scores),
    )


def _error(estimated: Pose2, true: Pose2) -> tuple[float, float]:
    """Distance in m and angle in degrees."""
    distance, angle = pose_error(estimated, true)
    return distance, math.degrees(angle)


def _within(metres: float | None, degrees: float | None, most_m: float, most_deg: float) -> bool:
    return metres is not None and degrees is not None and metres <= most_m and degrees <= most_deg


def _most(values: Iterable[float | None]) -> float | None:
    """The largest of those that are known."""
    return max((v for v in values if v is not None), default=None)


def _worst(values: Iterable[float | None]) -> float | None:
    """The largest; None as soon as one is not known: what did not happen at all is no good result."""
    every = list(values)
    return None if None in every else _most(every)


def _false(edges: Iterable[Edge], truth: Mapping[NodeId, Pose2]) -> int:
    return sum(is_false(edge, truth) for edge in edges)
