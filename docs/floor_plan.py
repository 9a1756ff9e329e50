"""Draws the picture of `floor-plan.md`: the map of three robots, laid under a plan by seven clicked pairs.

`make docs` runs it; by itself: `python docs/floor_plan.py`.
"""

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.drawing.plan_picture import draw_plan
from mapweave.formats.plan_export import plan_words
from mapweave.hybridmap.floor_plan import FloorPlan, PlanImage, PlanPair
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.mapserver.floor_plans import placed_plan
from mapweave.mapserver.merging.merger import Merger
from mapweave.merge.pose_graph.merged_map import MergedMap
from synthetic.building import DEPTH, PITCH, WIDTH, Building

SCALE = 0.025
"""Of the plan, m/px."""
MARGIN = 1.5
"""Around the rooms, m."""
CLICKS = 0.06
"""How far a person clicks beside a place, m."""
PATH = Path(__file__).with_name("floor-plan.png")
VISIBLE = 8
"""Grey levels; runs differ by 2."""


def merged_map(building: Building) -> MergedMap:
    """What a map server makes of the robots' maps."""
    merger = Merger()
    for robot in range(building.robots):
        for map_id, body in building.log(robot):
            merger.apply(map_id, body)
    return merger.merged()


def plan_of(building: Building) -> tuple[NDArray[np.uint8], Pose2]:
    """A drawing of the rooms, as an architect has it, and `plan_from_world`: the building lies across."""
    cells = np.round((building.truth[:, :, :2] - (WIDTH / 2, DEPTH / 2)) / PITCH)
    corners = PITCH * np.unique(cells.reshape(-1, 2), axis=0)
    low, high = np.min(corners, axis=0) - MARGIN, np.max(corners, axis=0) + np.array([WIDTH, DEPTH]) + MARGIN
    plan_from_world = Pose2(float(high[1]), float(-low[0]), np.pi / 2.0)
    width, height = (int(length / SCALE) for length in (high[1] - low[1], high[0] - low[0]))
    image = np.full((height, width, 3), 255, np.uint8)
    for number, corner in enumerate(corners, 101):
        outline = corner + np.array([[0.0, 0.0], [WIDTH, 0.0], [WIDTH, DEPTH], [0.0, DEPTH]])
        pixels = to_pixels(plan_from_world.apply(outline), height)
        cv2.fillPoly(image, [np.rint(pixels).astype(np.int32)], (238, 243, 246))
        cv2.polylines(image, [np.rint(pixels).astype(np.int32)], True, (60, 60, 60), 5)
        x, y = pixels.min(axis=0)
        cv2.putText(image, str(number), (int(x) + 12, int(y) + 38), 0, 1.0, (150, 150, 150), 2, cv2.LINE_AA)
    return image, plan_from_world


def to_pixels(points: Array, height: int) -> Array:
    """Metres in the frame of the plan as pixels."""
    return np.asarray(points) / SCALE * (1.0, -1.0) + np.array([0.0, height])


def looks_the_same(drawn: Path, kept: Path) -> bool:
    """Whether two pictures differ by less than an eye sees: threads of the solver add in any order."""
    one, other = cv2.imread(str(drawn)), cv2.imread(str(kept))
    if other is None or one.shape != other.shape:
        return False
    return bool(cv2.absdiff(one, other).max() <= VISIBLE)


def main(path: Path = PATH) -> None:
    """Draw; a picture that would look the same stays as it is."""
    rng = np.random.default_rng(3)
    building = Building.draw(3, 48, seed=2)
    merged = merged_map(building)
    image, plan_from_world = plan_of(building)
    height, width = image.shape[:2]
    pairs = []
    for robot, number in ((0, 0), (0, 12), (0, 30), (1, 5), (1, 40), (2, 20), (2, 44)):
        node = NodeId(f"r{robot}", 1, 2 * number)
        place = plan_from_world @ building.world_from(node)
        u, v = to_pixels(np.array([place.x, place.y]) + rng.normal(0.0, CLICKS, 2), height)
        pairs.append(PlanPair(node, 0.0, 0.0, float(u), float(v)))
    plan = FloorPlan(tuple(pairs), PlanImage("0" * 64, width, height, "office.png"), SCALE)
    placed = placed_plan("office", plan, merged)
    print("\n".join(plan_words(placed)))
    with TemporaryDirectory() as folder:
        drawn = Path(folder) / path.name
        draw_plan(placed, placed.part(), image[:, :, ::-1], merged, drawn)
        if not looks_the_same(drawn, path):
            shutil.copyfile(drawn, path)


if __name__ == "__main__":
    main()
