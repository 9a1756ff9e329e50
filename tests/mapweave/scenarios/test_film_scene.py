"""Frames: what is in them, where, and that they are quick."""

import itertools
import math
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.drawing.map_picture import COLOURS, colours_of
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Pose2
from mapweave.scenarios.film_frame import ACTOR, FLOOR, NO_IMAGE, PAPER, SOLID, FilmFrame, lay_out
from mapweave.sim.floorplan import BuildingPlan, Rectangle
from mapweave.sim.snapshot import Snapshot

PLAN = BuildingPlan(
    (Rectangle.spanning(0, 0, 8, 4, "hall"),),
    (
        Rectangle.spanning(-0.2, -0.2, 8.2, 0), Rectangle.spanning(-0.2, 4, 8.2, 4.2),
        Rectangle.spanning(-0.2, 0, 0, 4), Rectangle.spanning(8, 0, 8.2, 4),
    ),
)  # fmt: skip
TABLE = Rectangle(6.0, 3.0, 1.0, 0.6, 0.0, "table")


def snapshot(tick: int = 0, poses=None, actors=(), furniture=(), images=None) -> Snapshot:
    poses = {"r0": Pose2(2.0, 2.0)} if poses is None else poses
    return Snapshot(tick, tick * 100_000_000, poses, actors, furniture, images or {})


def bgr(colour: str) -> tuple[int, ...]:
    return tuple(int(colour[k : k + 2], 16) for k in (5, 3, 1))


def at(scene: FilmFrame, frame: np.ndarray, x: float, y: float) -> tuple[int, ...]:
    """The colour at a place in the world, by the layout's own words."""
    x0, _, _, y1 = PLAN.bounds
    column = scene.layout.left + (x - x0) * scene.layout.scale
    row = scene.layout.top + (y1 - y) * scene.layout.scale
    return tuple(int(v) for v in frame[round(row), round(column)])


def count(frame: np.ndarray, colour: tuple[int, ...]) -> int:
    return int((frame == np.array(colour, np.uint8)).all(axis=2).sum())


def test_everything_is_where_it_is_in_the_world():
    scene = FilmFrame(PLAN, ["r0"])
    person = Rectangle(4.0, 1.0, 0.45, 0.3, 0.3, "person")
    frame = scene.draw(snapshot(actors=(person,), furniture=(TABLE,)))
    assert frame.shape == (720, 1280, 3)
    assert frame.dtype == np.uint8
    assert at(scene, frame, 2.0, 2.1) == bgr(COLOURS[0]), "the robot"
    assert at(scene, frame, 2.08, 2.0) == PAPER, "looks along x"
    assert at(scene, frame, 6.3, 2.8) == SOLID
    assert at(scene, frame, 8.1, 2.0) == SOLID
    assert at(scene, frame, 4.0, 1.0) == ACTOR
    assert at(scene, frame, 5.0, 3.5) == FLOOR


def test_furniture_that_was_moved_is_drawn_where_it_is_now():
    scene = FilmFrame(PLAN, ["r0"])
    before = scene.draw(snapshot(furniture=(TABLE,)))
    moved = scene.draw(snapshot(1, furniture=(Rectangle(6.0, 1.0, 1.0, 0.6),)))
    assert (at(scene, before, 6, 3), at(scene, before, 6, 1)) == (SOLID, FLOOR)
    assert (at(scene, moved, 6, 3), at(scene, moved, 6, 1)) == (FLOOR, SOLID)


def test_a_frame_belongs_to_the_caller():
    scene = FilmFrame(PLAN, ["r0"])
    first = scene.draw(snapshot())
    first[:] = 7
    assert at(scene, scene.draw(snapshot()), 5.0, 3.5) == FLOOR


def test_cameras_show_their_images_in_their_shape():
    scene = FilmFrame(PLAN, ["r0", "r1", "r2"])
    narrow = np.full((100, 100), 200, np.uint8)
    ramp = np.tile((np.arange(320) // 2).astype(np.uint8), (240, 1))
    frame = scene.draw(snapshot(images={"r0": ramp, "r1": narrow, "r2": None}))
    width, height = scene.layout.cell
    cells = [frame[y : y + height, x : x + width] for x, y in scene.layout.corners]
    middle = cells[0][height // 2, :, 0].astype(int)
    assert (np.diff(middle) >= 0).all()
    assert middle[-1] - middle[0] > 140
    assert tuple(cells[1][height // 2, width // 2]) == (200, 200, 200)
    assert tuple(cells[1][height // 2, 1]) == NO_IMAGE, "what is not square is framed"
    assert count(cells[2], NO_IMAGE) > 0.9 * width * height


def test_robots_have_the_colours_of_the_map():
    names = [f"r{k}" for k in range(16)]
    poses = {name: Pose2(0.4 + 0.45 * k, 2.0) for k, name in enumerate(names)}
    scene = FilmFrame(PLAN, names)
    frame = scene.draw(snapshot(poses=poses))
    colours = colours_of(reversed(names))
    assert colours["r2"] == COLOURS[2], "r2 comes before r10"
    for name, pose in poses.items():
        assert at(scene, frame, pose.x, pose.y + 0.1) == bgr(colours[name])
    assert len(set(colours.values())) == 16


def test_trajectories_grow_fade_out_and_end_where_a_robot_is_carried():
    scene = FilmFrame(PLAN, ["r0"])
    for tick in range(100):
        frame = scene.draw(snapshot(tick, {"r0": Pose2(1.0 + 0.03 * tick, 1.0)}))
    assert at(scene, frame, 2.0, 1.0) not in (FLOOR, PAPER)
    carried = scene.draw(snapshot(100, {"r0": Pose2(1.0, 3.0)}))
    assert at(scene, carried, 2.0, 1.0) == FLOOR
    for tick in range(101, 450):
        frame = scene.draw(snapshot(tick, {"r0": Pose2(min(1.0 + 0.02 * (tick - 101), 5.0), 3.0)}))
    assert at(scene, frame, 1.3, 3.0) == FLOOR, "older than half a minute"
    assert at(scene, frame, 4.0, 3.0) not in (FLOOR, PAPER)


def test_a_robot_with_rare_poses_has_a_trajectory_too():
    scene = FilmFrame(PLAN, ["r0"])
    for tick in range(0, 100, 20):
        frame = scene.draw(snapshot(tick, {"r0": Pose2(1.0 + 0.03 * tick, 1.0)}))
    assert at(scene, frame, 2.0, 1.0) not in (FLOOR, PAPER)


def test_places_are_drawn_also_when_an_array_is_filled_in_place():
    scene = FilmFrame(PLAN, ["r0", "r1"])
    poses = np.array([[5.0, 3.0, 0.0], [5.0, 1.0, 0.0]])
    frame = scene.draw(snapshot(), {"r1": poses})
    assert at(scene, frame, 5.0, 3.0) not in (FLOOR, PAPER)
    poses[0, 0] = 7.0
    moved = scene.draw(snapshot(1), {"r1": poses})
    assert at(scene, moved, 5.0, 3.0) == FLOOR
    assert at(scene, moved, 7.0, 3.0) == at(scene, frame, 5.0, 1.0)
    assert at(scene, scene.draw(snapshot(2)), 7.0, 3.0) == FLOOR


def test_words_are_written_and_never_outside_of_their_cell():
    scene, again = (FilmFrame(PLAN, ["r0", "r1"]) for _ in range(2))
    silent = scene.draw(snapshot())
    text = again.draw(snapshot(), statuses={"r0": "looks for itself " * 30}, caption="r0 is kidnapped — now")
    changed = np.argwhere((silent != text).any(axis=2))
    (x, y), (width, height) = scene.layout.corners[0], scene.layout.cell
    in_label = (changed[:, 0] >= y + height) & (changed[:, 0] < y + height + 20)
    in_label &= (changed[:, 1] >= x) & (changed[:, 1] < x + width)
    in_caption = (changed[:, 0] > 720 - 34) & (changed[:, 1] < x)
    assert (in_label | in_caption).all()
    assert in_label.sum() > 100
    assert in_caption.sum() > 100


@given(
    st.integers(1, 16), st.floats(0.5, 60), st.floats(0.5, 60),
    st.sampled_from([(1280, 720), (640, 480), (320, 240), (1920, 1080)]),
)  # fmt: skip
def test_layouts_fit_and_nothing_overlaps(robots, length, width, size):
    layout = lay_out(size, (length, width), robots)
    right, bottom = layout.left + length * layout.scale, layout.top + width * layout.scale
    boxes = [(x, y, x + layout.cell[0], y + layout.cell[1] + 20) for x, y in layout.corners]
    assert len(boxes) == robots
    for box in [(layout.left, layout.top, right, bottom), *boxes]:
        assert box[0] >= 0
        assert box[1] >= 0
        assert box[2] <= size[0]
        assert box[3] <= size[1]
    assert all(box[0] >= right for box in boxes)
    for a, b in itertools.combinations(boxes, 2):
        assert a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]


@pytest.mark.parametrize(("robots", "size"), [([], (1280, 720)), (["r0"], (100, 720))])
def test_impossible_kidnappings_are_refused(robots, size):
    with pytest.raises(InvalidValue, match="a scene needs"):
        FilmFrame(PLAN, robots, size=size)


def test_the_same_moments_give_the_same_frames():
    def frames():
        scene = FilmFrame(PLAN, ["r0"])
        return [scene.draw(snapshot(k, {"r0": Pose2(1 + 0.02 * k, 2, 0.1 * k)})) for k in range(9)]

    assert all(np.array_equal(a, b) for a, b in zip(frames(), frames(), strict=True))


def test_a_frame_costs_little():
    """The best of several: other programs may want the processor too. About 2 ms on an ordinary core."""
    names = ["r0", "r1", "r2"]
    rng = np.random.default_rng(0)
    nodes = {name: rng.uniform([0, 0, -3], [8, 4, 3], (80, 3)) for name in names}
    images = {name: rng.integers(0, 255, (240, 320)).astype(np.uint8) for name in names}
    scene, best = FilmFrame(PLAN, names), math.inf
    for tick in range(20):
        poses = {name: Pose2(1 + k + 0.02 * tick, 2) for k, name in enumerate(names)}
        began = time.thread_time()
        scene.draw(snapshot(tick, poses, images=images), nodes, dict.fromkeys(names, "explores"), "a caption")
        best = min(best, time.thread_time() - began)
    assert best < 0.01
