"""A robot among the photographs, with rangers that see invisible walls, and its pipeline."""

import math

import numpy as np

from mapweave import Camera, MapId, Observation, Odometry, Pose2, RobotDescription
from mapweave.agent.pipeline import Pipeline, TickResult
from mapweave.wire.codec import encode_body

MAP = MapId("r0", 1)
BEARINGS = tuple(np.linspace(-math.pi, math.pi, 24, endpoint=False).tolist())
ROOM = (-1.2, 1.8, -1.5, 1.5)
"""x0, x1, y0, y1 m: invisible walls that only rangers see, before the pictures."""
BODY = RobotDescription(
    Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.3), ranger_bearings=BEARINGS, ranger_reach=3.0
)
"""The robot of the photographs, with rangers."""


def rangers(pose: Pose2) -> np.ndarray:
    """(K,) m, free way in the room."""
    angle = pose.heading + np.array(BEARINGS)
    c, s = np.cos(angle), np.sin(angle)
    with np.errstate(divide="ignore"):
        x = np.where(c > 0, (ROOM[1] - pose.x) / c, (ROOM[0] - pose.x) / c)
        y = np.where(s > 0, (ROOM[3] - pose.y) / s, (ROOM[2] - pose.y) / s)
    return np.clip(np.minimum(np.abs(x), np.abs(y)) - BODY.radius, 0.0, BODY.ranger_reach)


def live(walls, pipeline: Pipeline, ticks: int) -> tuple[list[Observation], list[TickResult], list[Pose2]]:
    """Let a pipeline drive a base that executes its commands exactly."""
    pose, moved = Pose2(), Odometry(0.0, 0.0)
    observations, steps, poses = [], [], []
    for tick in range(ticks):
        observation = Observation(tick * 100_000_000, moved, walls.render(pose), rangers(pose))
        step = pipeline.step(observation)
        moved = Odometry(step.command.forward * BODY.tick, step.command.turn * BODY.tick)
        pose = pose @ moved.motion()
        observations.append(observation)
        steps.append(step)
        poses.append(pose)
    return observations, steps, poses


def on(mission, settings=None, body=BODY) -> Pipeline:
    """A pipeline with something to do."""
    pipeline = Pipeline(MAP, body, settings)
    pipeline.set_mission(mission)
    return pipeline


def essence(step: TickResult) -> tuple[object, ...]:
    """All of a step, to the last bit."""
    return (step.command, [encode_body(change) for change in step.changes], step.questions, step.status)


def still(walls, pose=None, tick=0, **other) -> Observation:
    """What a robot senses that has not moved."""
    pose = pose or Pose2()
    other = {"proximity": rangers(pose)} | other
    return Observation(tick * 100_000_000, Odometry(0.0, 0.0), walls.render(pose), **other)
