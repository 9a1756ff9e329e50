"""People and boxes that move about: solid to robots and their rangers, textured to their cameras."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim import surface
from mapweave.sim.floorplan import Rectangle, distances_to
from mapweave.sim.image_noise import clouds
from mapweave.sim.placement import Points
from mapweave.sim.texture import Image, Texture
from mapweave.sim.world import Block, PanelSet, block_panels

AHEAD = 0.5
"""An actor stops when a robot is nearer than this ahead, m."""
PATIENCE_TICKS = 20
"""After waiting this long an actor turns back, s."""
GAP = 0.05
"""No actor comes nearer to a robot's side than this, m."""
TEXELS_PER_METRE = 300
"""Of an actor's textures: at 1 m a camera of 277 px focal length sees one in a pixel."""


@dataclass(frozen=True, slots=True)
class Figure:
    """Size of an actor.

    Attributes:
        length: along the way, m.
        width: across, m.
        height: m.
    """

    length: float
    width: float
    height: float

    @property
    def radius(self) -> float:
        """The radius of the way that it needs, also where it turns, m."""
        return math.hypot(self.length, self.width) / 2


FIGURES = {"person": Figure(0.3, 0.45, 1.75), "box": Figure(0.4, 0.4, 0.4)}


class Actor:
    """A person or thing that moves to and fro on a path.

    Attributes:
        what: a name of `FIGURES`.
        path: ((x m, y m), ...) in world.
        until: the last tick in which it is there.
        pose: world_from_actor, x along the way.
    """

    def __init__(
        self, kind: str, path: Points, speed: float, until: int, robots: Array, radius: float
    ) -> None:
        """Appear at the first place of the path where no robot is.

        Args:
            kind: a name of `FIGURES`.
            path: ((x m, y m), ...) in world, at least two different points.
            speed: m/s.
            until: the last tick.
            robots: (R, 2) m, in world.
            radius: of the robots, m.

        Raises:
            InvalidValue: robots stand all along the path.
        """
        self.what = kind
        self.path = tuple(path)
        self.until = until
        self.figure = FIGURES[kind]
        self._speed = speed
        self._radius = radius
        self._lengths = [math.dist(a, b) for a, b in pairwise(self.path)]
        self._ends = list(accumulate(self._lengths))
        self._way = 0.0
        self._forth = True
        self._waited = 0
        self.pose = self._at(0.0, True)
        while not self._has_room(self.pose, robots):
            self._way += 0.1
            if self._way > self._ends[-1]:
                raise InvalidValue("walk: robots stand all along the path")
            self.pose = self._at(self._way, True)

    @property
    def rectangle(self) -> Rectangle:
        """What it covers of the floor."""
        return self._covered(self.pose)

    def walk(self, seconds: float, robots: Array) -> None:
        """Go on, or wait for robots (R, 2) m, in world, that are in the way."""
        way, forth = self._way + (1 if self._forth else -1) * self._speed * seconds, self._forth
        # At an end of the path it turns; a path that is shorter than a step is gone to its end.
        if not 0.0 <= way <= self._ends[-1]:
            way, forth = min(max(way, 0.0), self._ends[-1]), not forth
        pose = self._at(way, self._forth)
        if self._has_room(pose, robots) and not self._sees(pose, robots):
            self._way, self._forth, self._waited, self.pose = way, forth, 0, pose
            return
        self._waited += 1
        if self._waited > PATIENCE_TICKS:
            self._forth, self._waited = not self._forth, 0
            turned = self._at(self._way, self._forth)
            if self._has_room(turned, robots):
                self.pose = turned

    def _at(self, way: float, forth: bool) -> Pose2:
        """Where it is after so many m of the path, looking forth or back."""
        leg = next((k for k, end in enumerate(self._ends) if way <= end), len(self._ends) - 1)
        (x0, y0), (x1, y1) = self.path[leg], self.path[leg + 1]
        share = min(1.0, 1.0 - (self._ends[leg] - way) / self._lengths[leg])
        heading = math.atan2(y1 - y0, x1 - x0) + (0.0 if forth else math.pi)
        return Pose2(x0 + share * (x1 - x0), y0 + share * (y1 - y0), heading)

    def _covered(self, pose: Pose2) -> Rectangle:
        return Rectangle(pose.x, pose.y, self.figure.length, self.figure.width, pose.heading, self.what)

    def _has_room(self, pose: Pose2, robots: Array) -> bool:
        gaps = distances_to([self._covered(pose)], robots)
        return bool((gaps >= self._radius + GAP).all())

    def _sees(self, pose: Pose2, robots: Array) -> bool:
        """Whether a robot is too near ahead."""
        length = AHEAD + self.figure.length / 2
        ahead = pose @ Pose2(length / 2, 0.0, 0.0)
        zone = Rectangle(ahead.x, ahead.y, length, self.figure.width, pose.heading)
        return bool((distances_to([zone], robots) < self._radius).any())


def figure_panels(kind: str, seed: Sequence[int]) -> PanelSet:
    """What a figure looks like, in its own frame."""
    figure = FIGURES[kind]
    painter = clothes if kind == "person" else surface.crate
    height_px = round(figure.height * TEXELS_PER_METRE)
    widths = (figure.width, figure.length, figure.width, figure.length)
    sides = [
        Texture(round(width * TEXELS_PER_METRE), height_px, (*seed, k), painter)
        for k, width in enumerate(widths)
    ]
    size = [round(side * TEXELS_PER_METRE) for side in (figure.length, figure.width)]
    top = Texture(size[0], size[1], (*seed, 4), surface.crate)
    block = Block(Rectangle(0.0, 0.0, figure.length, figure.width), 0.0, figure.height)
    return PanelSet.of(block_panels(block, sides, top if kind == "box" else None))


def clothes(rng: np.random.Generator, width_px: int, height_px: int) -> Image:
    """A person: shoes, trousers with creases, a patterned jacket, a head."""
    grain = clouds(rng, width_px, height_px, 1.4)
    canvas: NDArray[np.float32] = np.full((height_px, width_px), 90.0, np.float32)
    head, waist, shoes = (round(share * height_px) for share in (0.14, 0.53, 0.95))
    canvas[waist:shoes] = rng.uniform(35, 100)
    canvas[shoes:] = rng.uniform(15, 45)
    canvas[head:waist] = _cloth(rng, width_px, waist - head)
    # Folds run down the legs and across the belly.
    for _ in range(14):
        x, y = int(rng.integers(width_px)), int(rng.integers(head, shoes))
        lean, length = int(rng.integers(-18, 19)), int(rng.integers(20, 90))
        shade = float(canvas[y, x] + rng.choice([-25.0, -18.0, 16.0]))
        cv2.line(canvas, (x, y), (x + lean, y + length), shade, 2, cv2.LINE_AA)
    middle = width_px // 2
    cv2.line(canvas, (middle, waist), (middle, shoes), 12.0, 5)  # between the legs
    canvas[waist : waist + 9] = 25.0  # belt
    cv2.rectangle(canvas, (middle - 8, waist), (middle + 8, waist + 9), 200.0, -1)
    canvas[:head] = 200.0
    cv2.ellipse(canvas, (middle, head // 2), (width_px // 4, head // 2), 0, 0, 360, 150.0, -1, cv2.LINE_AA)
    return np.clip(canvas + 7.0 * grain, 0, 255).astype(np.uint8)


def _cloth(rng: np.random.Generator, width_px: int, height_px: int) -> NDArray[np.float32]:
    """Checks, stripes or a print."""
    base, ink = float(rng.uniform(110, 200)), float(rng.uniform(40, 90))
    y, x = np.mgrid[0:height_px, 0:width_px].astype(np.float32)
    pattern, period = int(rng.integers(3)), float(rng.uniform(22, 44))
    across, down = (x % period) < period * 0.4, (y % period) < period * 0.4
    marks = (across & down, down, across ^ down)[pattern]
    cloth = np.where(marks, np.float32(ink), np.float32(base))
    for _ in range(5):  # buttons, pockets
        at = int(rng.integers(width_px)), int(rng.integers(height_px))
        cv2.circle(cloth, at, int(rng.integers(4, 14)), float(rng.uniform(20, 250)), -1, cv2.LINE_AA)
    return np.asarray(cloth, dtype=np.float32)
