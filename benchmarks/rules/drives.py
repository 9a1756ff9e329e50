"""Drives with faults of images and wheels, mapped with all rules on frames, and without one."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.rules.frame_faults import FAULTS, Drive, Sensed
from benchmarks.rules.switches import ALL, FRAME_RULES, switched_off
from mapweave.agent.mission import Carried, Explore
from mapweave.agent.observation import Command, RobotDescription
from mapweave.agent.pipeline import Pipeline
from mapweave.evaluation.map_score import align
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.pose import Pose2, wrap_angle
from mapweave.sim.robots import RobotSetup
from mapweave.sim.simulation import Simulation
from mapweave.sim.worlds.catalog import make_world

ROBOT = "r0"
SECONDS = 90.0
"""Of a drive."""
WRONG = 0.1, math.radians(3.0)
"""An edge that is off by more, m or rad, is wrong. Right ones are off by a few mm."""
TRIALS: Mapping[str, Sequence[str]] = {
    "images that come twice": ("repeated images",),
    "other things": ("strange images",),
    "black images": ("images that show nothing",),
    "lamps": ("images in another light",),
    "spinning wheels": ("odometry against images",),
    "carried": ("strange images",),
}
"""Rules that each fault needs."""


def recorded(seed: int, seconds: float = SECONDS) -> tuple[RobotDescription, Drive]:
    """A robot explores an office."""
    robot, out = RobotSetup(ROBOT), list[Sensed]()
    with Simulation(make_world("office", seed), [robot], seed) as simulation:
        description, command = simulation.describe(ROBOT), Command()
        pipeline = _pipeline(Pipeline(MapId("map", 1), description), Explore())
        for _ in range(round(seconds / description.tick)):
            out.append(Sensed(simulation.step({ROBOT: command})[ROBOT], simulation.truth(ROBOT)))
            if pipeline.lost:
                pipeline = _pipeline(Pipeline(MapId("map", 1), description), Explore())
            command = pipeline.step(out[-1].observation).command
    return description, out


def mapped(description: RobotDescription, drive: Drive) -> dict[str, float]:
    """What comes of a drive, mapped as a robot does that is moved by others.

    Returns:
        Ticks and those that were used, maps, edges and those that are wrong, root mean square error of the
        poses and of those by the wheels alone, m.
    """
    pipeline = _pipeline(Pipeline(MapId("map", 1), description), Carried())
    here, first_from_map, reckoned = Pose2(), Pose2(), Pose2()
    maps: list[HybridMap] = []
    believed, by_wheels, used = [], [], 0
    for observation, _ in drive:
        moved = observation.odometry.motion()
        here, reckoned = here @ moved, reckoned @ moved
        if pipeline.lost:
            # As an agent does: the next map begins where the wheels have brought the robot.
            maps.append(_finished(pipeline))
            number, calibration = len(maps) + 1, pipeline.calibration
            pipeline = Pipeline(MapId("map", number), description, calibration=calibration)
            pipeline, first_from_map = _pipeline(pipeline, Carried()), here
        status = pipeline.step(observation).status
        if not status.relocalizing and not pipeline.lost and status.doing != "standing still":
            here, used = first_from_map @ status.map_from_robot, used + 1
        believed.append(here)
        by_wheels.append(reckoned)
    maps.append(_finished(pipeline))
    truth = {one.observation.stamp_ns: one.truth for one in drive}
    true = [one.truth for one in drive]
    wrong = [_is_wrong(one, truth) for one in maps]
    return {
        "ticks": len(drive), "used": used, "maps": len(maps),
        "edges": sum(map(len, wrong)), "wrong_edges": sum(map(sum, wrong)),
        "error_m": _error(believed, true), "wheels_m": _error(by_wheels, true),
    }  # fmt: skip


def drives(seed: int, count: int, step: Callable[[], None]) -> dict[str, dict[str, dict[str, float]]]:
    """What comes of so many drives with each fault, with all rules and without those that it needs."""
    found: dict[str, dict[str, list[dict[str, float]]]] = {}
    for run in range(count):
        description, plain = recorded(seed + run)
        for fault, rules in TRIALS.items():
            drive = FAULTS[fault](plain, np.random.default_rng([seed, run]))
            for name in (ALL, *rules):
                with switched_off(FRAME_RULES.get(name, ())):
                    row = mapped(description, drive)
                found.setdefault(fault, {}).setdefault(name, []).append(row)
                step()
    return {fault: {name: _total(rows) for name, rows in by.items()} for fault, by in found.items()}


def _total(rows: Sequence[dict[str, float]]) -> dict[str, Any]:
    """Sums over drives; of errors the median, and the share of the ticks that was used."""
    out: dict[str, Any] = {
        key: sum(row[key] for row in rows) for key in ("ticks", "used", "maps", "edges", "wrong_edges")
    }
    out["used_share"] = round(out["used"] / out["ticks"], 4)
    out |= {key: round(float(np.median([row[key] for row in rows])), 4) for key in ("error_m", "wheels_m")}
    return out


def _pipeline(pipeline: Pipeline, mission: Carried | Explore) -> Pipeline:
    pipeline.set_mission(mission)
    return pipeline


def _finished(pipeline: Pipeline) -> HybridMap:
    pipeline.finish()
    return pipeline.map


def _is_wrong(one: HybridMap, truth: Mapping[int, Pose2]) -> list[bool]:
    """Whether each edge of a map is wrong."""
    out = []
    for edge in one.edges.values():
        if edge.a not in one.nodes or edge.b not in one.nodes:
            continue
        first, second = (truth[one.nodes[node].stamp_ns] for node in (edge.a, edge.b))
        off = (first.inverse() @ second).inverse() @ edge.a_from_b.mean
        out.append(math.hypot(off.x, off.y) > WRONG[0] or abs(wrap_angle(off.heading)) > WRONG[1])
    return out


def _error(estimated: Sequence[Pose2], true: Sequence[Pose2]) -> float:
    """Root mean square distance of positions after one rigid alignment, m."""
    at, there = (np.array([[pose.x, pose.y] for pose in poses]) for poses in (estimated, true))
    return float(np.sqrt(((align(at, there).apply(at) - there) ** 2).sum(axis=1).mean()))
