"""A trial as pictures: the building from above next to the robots' camera images."""

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.drawing.map_picture import colours_of
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim.floorplan import BuildingPlan, Rectangle
from mapweave.sim.snapshot import Snapshot

Frame = NDArray[np.uint8]
Colour = tuple[int, int, int]

PAPER: Colour = (255, 255, 255)
INK: Colour = (60, 56, 50)
FLOOR: Colour = (236, 243, 246)
SOLID: Colour = (186, 200, 207)
ACTOR: Colour = (70, 60, 200)
NO_IMAGE: Colour = (90, 86, 80)
"""Blue, green, red, as OpenCV has them; the first ones as in `mapweave.drawing.map_picture`."""
BAR = 34
"""Height of the line of text above the plan, and of the one below, px."""
LABEL = 20
"""Height of the label below a camera's image, px."""
LARGEST = 300
"""Height of a camera's image at most, px: the simulator's cameras have hardly more."""
GAP = 6
"""px."""
TRAJECTORY = 30.0
"""Of each robot's way, this much is shown, simulated s."""
FASTEST = 1.0
"""m/s; no robot drives faster: it was carried, and its trajectory is cut."""
ROBOT_RADIUS = 0.17
"""m."""
NO_NODES: Array = np.zeros((0, 3))
FONT = cv2.FONT_HERSHEY_SIMPLEX
SHIFT = 4
"""Fractional bits of the coordinates that OpenCV draws at."""


@dataclass(frozen=True)
class FrameLayout:
    """Where each part of a film's frame is drawn.

    Attributes:
        scale: of the plan, px per m.
        left: x of the plan's left edge, px.
        top: y of the plan's top edge, px.
        columns: of camera images.
        cell: (width, height) of a camera's image, px, without its label.
        corners: top left corner of each camera's image, px.
    """

    scale: float
    left: int
    top: int
    columns: int
    cell: tuple[int, int]
    corners: tuple[tuple[int, int], ...]


def lay_out(size: tuple[int, int], extent: tuple[float, float], robots: int) -> FrameLayout:
    """Share a frame between the plan, on the left, and a grid of camera images, on the right.

    Of all numbers of columns, the one with the largest product of the plan's area and the images' area.

    Args:
        size: width and height of the frame, px.
        extent: width and height of the building, m.
        robots: how many cameras.
    """
    width, height = size

    def arrange(columns: int) -> tuple[float, FrameLayout]:
        rows = math.ceil(robots / columns)
        cell_height = min((height - GAP) // rows - LABEL - GAP, int(0.6 * width / columns * 3 / 4), LARGEST)
        cell = max(cell_height * 4 // 3, 4), max(cell_height, 3)
        grid = columns * (cell[0] + GAP) + GAP
        free = max(width - grid - 2 * GAP, 8), max(height - 2 * BAR, 8)
        scale = min(free[0] / extent[0], free[1] / extent[1])
        left = GAP + int((free[0] - extent[0] * scale) / 2)
        top = BAR + int((free[1] - extent[1] * scale) / 2)
        used = rows * (cell[1] + LABEL + GAP)
        corners = tuple(
            (width - grid + GAP + (k % columns) * (cell[0] + GAP),
             (height - used) // 2 + (k // columns) * (cell[1] + LABEL + GAP))
            for k in range(robots)
        )  # fmt: skip
        product = (scale * scale * extent[0] * extent[1]) * (cell[0] * cell[1] * robots)
        return product, FrameLayout(scale, left, top, columns, cell, corners)

    return max((arrange(columns) for columns in range(1, robots + 1)), key=lambda found: found[0])[1]


class FilmFrame:
    """Draws moments of one trial, in order; remembers only the robots' trajectories.

    Attributes:
        size: width and height of a frame, px.
        layout: where what is drawn.
    """

    def __init__(
        self, plan: BuildingPlan, robots: Sequence[str], title: str = "", size: tuple[int, int] = (1280, 720)
    ) -> None:
        """Draw what does not move.

        Args:
            plan: rooms and walls; furniture comes with each snapshot.
            robots: names, in the order of their cameras.
            title: at the top left.
            size: width and height, px; even, for video.

        Raises:
            InvalidValue: no robots, or a frame too small to show anything.
        """
        if not robots or min(size) < 120:
            raise InvalidValue("a scene needs a robot and at least 120 by 120 pixels")
        self.size = size
        self._title = title
        self._robots = tuple(robots)
        self._colours = {name: _bgr(colour) for name, colour in colours_of(robots).items()}
        x0, y0, x1, y1 = plan.bounds
        self._origin = x0, y1
        self.layout = lay_out(size, (x1 - x0, y1 - y0), len(robots))
        self._bare: Frame = np.full((size[1], size[0], 3), PAPER, np.uint8)
        self._fill(self._bare, plan.rooms, FLOOR)
        self._fill(self._bare, plan.walls, SOLID)
        self._furniture: tuple[Rectangle, ...] = ()
        self._nodes: list[Array] = [NO_NODES for _ in robots]
        self._furnished = self._bare
        self._trajectories: dict[str, deque[tuple[float, float, float]]] = {name: deque() for name in robots}

    def draw(
        self,
        snapshot: Snapshot,
        nodes: Mapping[str, Array] | None = None,
        statuses: Mapping[str, str] | None = None,
        caption: str = "",
    ) -> Frame:
        """One frame, (H, W, 3) uint8 blue, green, red; it is the caller's.

        Args:
            snapshot: the moment.
            nodes: places by robot, (N, 3) [x m, y m, heading rad], in world.
            statuses: what each robot is doing, a few words.
            caption: the present event, one line below the plan.
        """
        frame = self._background(snapshot.furniture, nodes or {}).copy()
        statuses = statuses or {}
        for name, pose in snapshot.robots.items():
            if name in self._trajectories:
                self._draw_trajectory(frame, name, pose, snapshot.stamp_ns / 1e9)
        self._fill(frame, snapshot.actors, ACTOR)
        for actor in snapshot.actors:
            x, y = self._pixel(actor.x, actor.y)
            self._label(frame, actor.name, (x + 12, y - 12), ACTOR)
        for name, pose in snapshot.robots.items():
            if name in self._colours:
                self._draw_robot(frame, name, pose)
        for name, corner in zip(self._robots, self.layout.corners, strict=True):
            self._draw_camera(frame, name, corner, snapshot.images.get(name), statuses.get(name, ""))
        self._write(frame, f"{snapshot.stamp_ns / 1e9:.1f} s   {self._title}", (GAP + 2, 23), INK, 0.55)
        self._write(frame, caption, (GAP + 2, self.size[1] - 12), INK, 0.5)
        return frame

    def _background(self, furniture: tuple[Rectangle, ...], nodes: Mapping[str, Array]) -> Frame:
        """The building and the places in it; drawn again only when something of it is another."""
        shown = [nodes.get(name, NO_NODES) for name in self._robots]
        same = all(np.array_equal(a, b) for a, b in zip(shown, self._nodes, strict=True))
        if furniture != self._furniture or not same:
            # Copies: who calls may go on to fill the same arrays.
            self._furniture, self._nodes = furniture, [np.array(poses, np.float64) for poses in shown]
            self._furnished = self._bare.copy()
            self._fill(self._furnished, furniture, SOLID)
            for name, poses in zip(self._robots, self._nodes, strict=True):
                self._draw_nodes(self._furnished, poses, self._colours[name])
        return self._furnished

    def _draw_nodes(self, frame: Frame, poses: Array, colour: Colour) -> None:
        """Dots with a tick for the heading, all in two calls."""
        if not len(poses):
            return
        reach = 0.16 * np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)
        lines = self._subpixels(np.stack([poses[:, :2], poses[:, :2] + reach], axis=1))
        dots = np.repeat(lines[:, :1], 2, axis=1)
        cv2.polylines(frame, list(lines), False, colour, 1, cv2.LINE_AA, SHIFT)
        cv2.polylines(frame, list(dots), False, colour, 4, cv2.LINE_AA, SHIFT)

    def _draw_trajectory(self, frame: Frame, name: str, pose: Pose2, now: float) -> None:
        trajectory = self._trajectories[name]
        if trajectory and math.dist((pose.x, pose.y), trajectory[-1][1:]) > FASTEST * max(
            now - trajectory[-1][0], 0.0
        ):
            trajectory.clear()
        trajectory.append((now, pose.x, pose.y))
        while trajectory[0][0] < now - TRAJECTORY:
            trajectory.popleft()
        if len(trajectory) > 1:
            line = self._subpixels(np.array(trajectory)[:, 1:])
            cv2.polylines(frame, [line], False, _mixed(self._colours[name], 0.4), 1, cv2.LINE_AA, SHIFT)

    def _draw_robot(self, frame: Frame, name: str, pose: Pose2) -> None:
        colour = self._colours[name]
        x, y = (int(v) for v in self._subpixels(np.array([pose.x, pose.y])))
        radius = max(round(ROBOT_RADIUS * self.layout.scale * 2**SHIFT), 5 << SHIFT)
        cv2.circle(frame, (x, y), radius, colour, -1, cv2.LINE_AA, SHIFT)
        cv2.circle(frame, (x, y), radius, PAPER, 1, cv2.LINE_AA, SHIFT)
        nose = round(x + radius * math.cos(pose.heading)), round(y - radius * math.sin(pose.heading))
        cv2.line(frame, (x, y), nose, PAPER, 2, cv2.LINE_AA, SHIFT)
        self._label(frame, name, ((x + radius) >> SHIFT, (y - radius) >> SHIFT), colour)

    def _draw_camera(
        self, frame: Frame, name: str, corner: tuple[int, int], image: NDArray[np.uint8] | None, status: str
    ) -> None:
        (x, y), (width, height), colour = corner, self.layout.cell, self._colours[name]
        cell = frame[y : y + height, x : x + width]
        cell[:] = NO_IMAGE
        if image is None:
            self._write(frame, "no image", (x + 8, y + height // 2), PAPER, 0.45)
        else:
            # Cameras have different shapes: what does not fill the cell is framed.
            scale = min(width / image.shape[1], height / image.shape[0])
            w, h = max(int(image.shape[1] * scale), 1), max(int(image.shape[0] * scale), 1)
            small = cv2.resize(
                image, (w, h), interpolation=cv2.INTER_AREA if scale < 0.6 else cv2.INTER_LINEAR
            )
            dy, dx = (height - h) // 2, (width - w) // 2
            cell[dy : dy + h, dx : dx + w] = cv2.cvtColor(small, cv2.COLOR_GRAY2BGR)
        cv2.rectangle(frame, (x - 2, y - 2), (x + width + 1, y + height + LABEL), colour, 2)
        frame[y + height : y + height + LABEL, x : x + width] = PAPER
        self._write(frame, name, (x + 4, y + height + 14), colour, 0.45, 2)
        begin = 12 + _width(name, 0.45, 2)
        self._write(frame, _shortened(status, width - begin, 0.4), (x + begin, y + height + 14), INK, 0.4)

    def _fill(self, frame: Frame, boxes: Iterable[Rectangle], colour: Colour) -> None:
        for box in boxes:
            cv2.fillConvexPoly(frame, self._subpixels(box.corners), colour, cv2.LINE_AA, SHIFT)

    def _label(self, frame: Frame, text: str, at: tuple[int, int], colour: Colour) -> None:
        """Text that can be read on anything."""
        self._write(frame, text, at, PAPER, 0.45, 3)
        self._write(frame, text, at, colour, 0.45)

    def _write(
        self, frame: Frame, text: str, at: tuple[int, int], colour: Colour, scale: float, weight: int = 1
    ) -> None:
        # Older OpenCV's letters are ASCII; for others it draws question marks, several for each.
        plain = text.encode("ascii", "replace").decode()
        cv2.putText(frame, plain, at, FONT, scale, colour, weight, cv2.LINE_AA)

    def _subpixels(self, points: NDArray[Any]) -> NDArray[np.int32]:
        """(..., 2) m in world to fixed-point px."""
        x = self.layout.left + (points[..., 0] - self._origin[0]) * self.layout.scale
        y = self.layout.top + (self._origin[1] - points[..., 1]) * self.layout.scale
        fixed: NDArray[np.int32] = np.round(np.stack([x, y], axis=-1) * 2**SHIFT).astype(np.int32)
        return fixed

    def _pixel(self, x: float, y: float) -> tuple[int, int]:
        px, py = self._subpixels(np.array([x, y])) >> SHIFT
        return int(px), int(py)


def _width(text: str, scale: float, weight: int = 1) -> int:
    """The width of a text, px."""
    return int(cv2.getTextSize(text, FONT, scale, weight)[0][0])


def _shortened(text: str, room: int, scale: float) -> str:
    """So much of a text as there is room for, px; an ellipsis marks the rest."""
    if _width(text, scale) <= room:
        return text
    shorter = text[: int(len(text) * room / _width(text, scale))] if room > 0 else ""
    while shorter and _width(shorter + "..", scale) > room:
        shorter = shorter[:-1]
    return shorter + ".." if shorter else ""


def _bgr(colour: str) -> Colour:
    """A colour like `#1f77b4` as OpenCV has it."""
    return int(colour[5:7], 16), int(colour[3:5], 16), int(colour[1:3], 16)


def _mixed(colour: Colour, white: float) -> Colour:
    """A lighter colour."""
    b, g, r = (round(c + (255 - c) * white) for c in colour)
    return b, g, r
