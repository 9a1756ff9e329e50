"""What an agent senses, estimates and decides, tick by tick, for logs that a thread writes."""

import contextlib
import logging
import math
import queue
import threading
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.agent.observation import Command, Observation
from mapweave.agent.occupancy_grid import GridCells
from mapweave.agent.pipeline import Pipeline, TickResult
from mapweave.hybridmap.agent_status import Status
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.node import Edge, EdgeKind, Node
from mapweave.hybridmap.pose import Array, PoseGaussian

log = logging.getLogger(__name__)

PATIENCE = 10.0
"""How long the end of the recording may take, s."""
QUEUED = 64
"""Ticks that wait to be written; beyond that ticks are left out, so that the robot never waits."""
FLOOR_EVERY = 10
"""Ticks between two occupancy grids."""
SIGMAS = 2.0
"""Of the ellipsoids."""
LARGEST = 3.0
"""m; larger ellipsoids, of landmarks that were just begun, would hide all others."""
QUALITY = 80
"""Of the JPEG images, %."""
STEP = 0.02
"""m between two points of the path."""
EDGE_COLOURS = {
    EdgeKind.MAPPED: (0.2, 0.7, 0.3), EdgeKind.TURNED: (0.6, 0.6, 0.6), EdgeKind.DRIVEN: (0.2, 0.5, 0.9),
    EdgeKind.LOOP: (0.95, 0.6, 0.1), EdgeKind.MERGED: (0.85, 0.2, 0.6),
}  # fmt: skip
"""Red, green and blue, 0 to 1."""


@dataclass(frozen=True, eq=False)
class LoggedTick:
    """What is written of one tick; nothing in it changes later.

    Attributes:
        stamp_ns: of the observation.
        image: (H, W) grey as the pipeline takes it; None without one.
        camera: that took it, ideal.
        tracks_px: (N, 2) px in the image: all tracks, or those of the node by which the robot is localized.
        bearings: (N,) rad, of the tracks, positive to the left.
        landmarks: (M, 3) m, in robot.
        covariances: (M, 3, 3) m^2, in robot.
        map_from_robot: None if the robot does not know where it is.
        status: of the pipeline.
        command: for the wheels.
        map: nodes and edges if they have changed, else None.
        floor: now and then, else None.
    """

    stamp_ns: int
    image: NDArray[np.uint8] | None
    camera: Camera
    tracks_px: Array
    bearings: Array
    landmarks: Array
    covariances: Array
    map_from_robot: PoseGaussian | None
    status: Status
    command: Command
    map: tuple[tuple[Node, ...], tuple[Edge, ...]] | None
    floor: GridCells | None

    @property
    def bearing_curves(self) -> dict[str, float]:
        """The outermost bearings of the tracks and the limit of the field of view, degrees; empty without
        tracks.
        """
        if not len(self.bearings):
            return {}
        limit = math.degrees(self.camera.semi_aperture)
        left, right = math.degrees(self.bearings.max()), math.degrees(self.bearings.min())
        return {
            "outermost_left": left, "limit_left": limit, "outermost_right": right, "limit_right": -limit,
        }  # fmt: skip


class TickLog(ABC):
    """Takes ticks from the agent's loop, which only hands over, and writes them in a thread.

    Attributes:
        title: of the log, for people.
        left_out: ticks that were not written, since writing was slower than the robot.
    """

    title: ClassVar[str]

    def __init__(self, name: str) -> None:
        """Start the thread; what it writes to must be there."""
        self.left_out = 0
        self._pipeline: Pipeline | None = None
        self._stamp_ns = 0
        self._ticks = 0
        self._changed = True
        self._failed = ""
        self._waiting: queue.Queue[LoggedTick | None] = queue.Queue(QUEUED)
        self._thread = threading.Thread(target=self._serve, name=name, daemon=True)
        self._thread.start()

    def step(self, observation: Observation, step: TickResult, pipeline: Pipeline) -> None:
        """Take in a tick; never waits."""
        self._changed |= bool(step.changes) or pipeline is not self._pipeline
        self._pipeline, self._stamp_ns = pipeline, observation.stamp_ns
        if self._waiting.full():
            self.left_out += 1
            return
        tracks, bearings, landmarks, covariances = tracked_of(pipeline)
        # Only this thread puts, so there is room.
        self._waiting.put_nowait(
            LoggedTick(
                observation.stamp_ns,
                pipeline.image,
                pipeline.lens.camera,
                tracks,
                bearings,
                landmarks,
                covariances,
                pipeline.map_from_robot,
                step.status,
                step.command,
                _map_of(pipeline) if self._changed else None,
                pipeline.floor.taken() if self._ticks % FLOOR_EVERY == 0 else None,
            )
        )
        self._changed = False
        self._ticks += 1

    def close(self) -> str:
        """Write what waits, and end the recording; returns what is missing in it, in words."""
        with contextlib.suppress(queue.Full):
            self._waiting.put(None, timeout=PATIENCE)
        self._thread.join(PATIENCE)
        ended = not self._thread.is_alive()
        if self._pipeline is not None and ended and not self._failed:
            # Nodes that were made when the robot had stopped.
            self._write_map(self._stamp_ns, *_map_of(self._pipeline))
        missing = f"{self.left_out} ticks, since writing was too slow" if self.left_out else ""
        return self._end(ended) or self._failed or missing

    # In the thread of the log.

    def _serve(self) -> None:
        while (moment := self._waiting.get()) is not None:
            if self._failed:
                continue
            try:
                self._write(moment)
                if moment.map is not None:
                    self._write_map(moment.stamp_ns, *moment.map)
            except Exception as error:
                log.debug("a tick cannot be written", exc_info=True)
                self._failed = f"the end ({' '.join(str(error).split()) or type(error).__name__})"

    @abstractmethod
    def _write(self, moment: LoggedTick) -> None:
        """Write a tick without its map."""

    @abstractmethod
    def _write_map(self, stamp_ns: int, nodes: tuple[Node, ...], edges: tuple[Edge, ...]) -> None:
        """Write the map, when it has changed and in the end."""

    @abstractmethod
    def _end(self, ended: bool) -> str:
        """End the recording.

        Args:
            ended: whether the thread has ended; else nothing can be closed that it writes to.

        Returns:
            What is missing in it, in words.
        """


def ellipsoids(points: Array, covariances: Array) -> tuple[Array, Array, Array]:
    """Ellipsoids of `SIGMAS` of the landmarks that are known well enough to be drawn.

    Args:
        points: (M, 3) m.
        covariances: (M, 3, 3) m^2.

    Returns:
        (N, 3) m, centres; (N, 3) m, half axes; (N, 4) quaternions x, y, z, w, which turn x, y and z to them.
    """
    finite = np.isfinite(points).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2))
    variances, axes = np.linalg.eigh(covariances[finite])
    half_sizes = SIGMAS * np.sqrt(np.maximum(variances, 0.0))
    drawn = half_sizes.max(axis=1, initial=0.0) <= LARGEST
    # A rotation has no reflection.
    axes[np.linalg.det(axes) < 0.0, :, 0] *= -1.0
    turns = np.array([cv2.Rodrigues(matrix)[0].ravel() for matrix in axes[drawn]]).reshape(-1, 3)
    angles = np.linalg.norm(turns, axis=1, keepdims=True)
    units = np.divide(turns, angles, out=np.zeros_like(turns), where=angles > 0.0)
    quaternions = np.concatenate([units * np.sin(angles / 2.0), np.cos(angles / 2.0)], axis=1)
    return points[finite][drawn], half_sizes[drawn], quaternions


def tracked_of(pipeline: Pipeline) -> tuple[Array, Array, Array, Array]:
    """Tracks (px), their bearings, landmarks and covariances in robot: of the node that the robot drives by,
    else of the mapping filter.
    """
    lens, fix = pipeline.lens, pipeline.fix
    if fix is None:
        mapper = pipeline.mapper
        seen = mapper.landmarks
        return mapper.tracks[2], mapper.bearings, seen.points_in_robot, seen.covariances_in_robot
    if fix.localizer is None:
        return np.zeros((0, 2)), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3))
    known, robot_from_node = fix.localizer.landmarks, fix.node_from_robot.mean.inverse()
    rotation = np.eye(3)
    rotation[:2, :2] = robot_from_node.rotation
    points = np.column_stack([robot_from_node.apply(known.points[:, :2]), known.points[:, 2]])
    pixels = fix.localizer.pixels
    covariances = rotation @ known.covariances @ rotation.T
    return lens.distort(pixels), lens.camera.bearings(pixels), points, covariances


def _map_of(pipeline: Pipeline) -> tuple[tuple[Node, ...], tuple[Edge, ...]]:
    return tuple(pipeline.map.nodes.values()), tuple(pipeline.map.edges.values())
