"""Pictures of maps: a PNG with what was asked for in it."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave import Edge, EdgeKind, NodeId, Pose2, PoseGaussian
from mapweave.drawing import map_picture
from mapweave.drawing.map_picture import (
    COLOURS,
    DrawnDrive,
    MapPicture,
    Outline,
    bounds_of,
    draw_map,
    outline_of,
)
from mapweave.drawing.names import CELL, NamePlacement
from mapweave.sim.floorplan import BuildingPlan, Rectangle
from tests.quick import first_quick

NODES = {
    NodeId(agent, 1, k): Pose2(k, i, 0.2 * k) for i, agent in enumerate(("r0", "r1")) for k in range(1, 5)
}


def edge(number: int, a: NodeId, b: NodeId, kind: EdgeKind) -> Edge:
    return Edge(NodeId("s0", 1, number), a, b, PoseGaussian.from_sigmas(Pose2(), 0.1, 0.1), kind)


EDGES = [
    edge(1, NodeId("r0", 1, 1), NodeId("r0", 1, 2), EdgeKind.MAPPED),
    edge(2, NodeId("r0", 1, 1), NodeId("r0", 1, 4), EdgeKind.LOOP),
    edge(3, NodeId("r0", 1, 2), NodeId("r1", 1, 3), EdgeKind.MERGED),
    edge(4, NodeId("r0", 1, 2), NodeId("r7", 1, 3), EdgeKind.MERGED),
]


def drawn(tmp_path, picture: MapPicture) -> np.ndarray:
    """The picture as pixels, (H, W, 3) RGB."""
    path = tmp_path / "made" / "for it" / "map.png"
    draw_map(picture, path)
    assert path.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    return cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)


def share_of(image: np.ndarray, colour: str) -> float:
    """How much of an image has about a colour like `#1f77b4`."""
    wanted = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)])
    return float((np.abs(image.astype(int) - wanted).max(axis=2) < 12).mean())


def test_nodes_edges_and_links_are_in_the_picture(tmp_path):
    image = drawn(tmp_path, MapPicture("a map", NODES, EDGES))
    assert image.shape[0] > 500
    assert image.shape[1] > 800
    for colour in COLOURS[:2]:
        assert share_of(image, colour) > 1e-4, "each robot has its colour"
    assert share_of(image, COLOURS[2]) == 0
    assert share_of(image, "#e6007e") > 0 or share_of(image, "#e81a8b") > 1e-4, "links are visible"
    assert share_of(image, "#ffffff") < 0.995


def test_the_title_is_written(tmp_path):
    first, second = (
        drawn(tmp_path, MapPicture(title, NODES, [])) for title in ("", "seed 3: 12 nodes, ATE 0.1 m")
    )
    dark = [int((image < 100).all(axis=2).sum()) for image in (first, second)]
    assert dark[1] > dark[0] + 500


@pytest.mark.parametrize(
    "title", first_quick(["87 nodes, 4 maps, 2 components\ndrawn: component 0", "87 nodes, 4 maps", ""], 1)
)
@pytest.mark.parametrize(("width", "height"), [(1, 1), (24, 3), (24, 11), (10, 9), (3, 24)])
def test_nothing_is_cut_at_the_edge(tmp_path, title, width, height):
    """Half of the first line of a title of two lines was outside a picture twice as wide as high."""
    nodes = {NodeId(f"r{k}", 1, k): Pose2(k % 2 * width, k // 2 * height) for k in range(4)}
    image = drawn(tmp_path, MapPicture(title, nodes, [], starts={node.agent: nodes[node] for node in nodes}))
    edges = image[0], image[-1], image[:, 0], image[:, -1]
    assert all((edge == 255).all() for edge in edges)


@pytest.mark.parametrize("name", [r"$\frac{$", "$" + "{" * 60 + "$", "[/b] <svg onload=x>"])
def test_names_are_no_formulas(tmp_path, name):
    """What people call a place or a room ended in a traceback: `$` begins a formula for matplotlib."""
    outline = Outline(((name, np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 2.0], [0.0, 2.0]])),), ())
    assert drawn(tmp_path, MapPicture(name, NODES, EDGES, outline, places={name: (1.5, 0.5)})).size


def test_the_floor_the_landmarks_and_the_drive_are_drawn(tmp_path):
    plan = BuildingPlan(
        (Rectangle.spanning(0, -1, 6, 3, "room 0"), Rectangle.spanning(6, 0, 6.2, 1, "door 0")),
        (Rectangle.spanning(0, 3, 6, 3.2),),
        (Rectangle(4.5, 2.2, 1.0, 0.6, 0.4, "table"),),
    )
    outline = outline_of(plan)
    assert [name for name, _ in outline.rooms] == ["room 0", ""], "doors have no name to be written"
    assert len(outline.solids) == 2
    drive = DrawnDrive(
        np.array([[1.0, 0.0], [2.0, 2.0], [4.0, 1.0]]), Pose2(1, 0), Pose2(4, 1), "drive of r0"
    )
    landmarks = np.random.default_rng(0).uniform([0, -1], [6, 3], (500, 2))
    bare = drawn(tmp_path, MapPicture("a map", NODES, EDGES))
    full = drawn(tmp_path, MapPicture("a map", NODES, EDGES, outline, [drive], landmarks))
    for colour, least in (("#f6f3ec", 0.1), ("#cfc8ba", 0.01), ("#ffd700", 1e-4)):
        assert share_of(full, colour) > least > share_of(bare, colour)


@pytest.mark.parametrize("nodes", [{}, {NodeId("r0", 1, 1): Pose2()}])
def test_small_maps_are_drawn_too(tmp_path, nodes):
    """A map of nothing is no mistake, nor a reason for a warning."""
    assert drawn(tmp_path, MapPicture("nothing", nodes, EDGES, Outline())).size


def test_ten_robots_have_colours(tmp_path):
    nodes = {NodeId(f"r{k}", 1, 1): Pose2(k, k) for k in range(10)}
    assert drawn(tmp_path, MapPicture("many", nodes, [])).size


def overlapping(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    """Whether two boxes (left, bottom, right, top) have room in common."""
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


MARK = st.tuples(st.floats(0, 400), st.floats(0, 300))
WORD = st.tuples(MARK, st.floats(5, 90), st.floats(5, 20), st.booleans())


@given(st.lists(MARK, min_size=1, max_size=30), st.lists(WORD, min_size=1, max_size=30))
def test_names_cover_no_other_name_and_marks_only_if_they_must(marks, words):
    placement = NamePlacement(400, 300)
    placement.cover(np.array(marks), 4.0)
    boxes = []
    for (x, y), width, height, must in words:
        place = placement.place(x, y, width, height, 4.0, must)
        if place is None:
            continue
        left, bottom = place
        box = left, bottom, left + width, bottom + height
        assert left >= 0 and bottom >= 0 and box[2] <= 400 and box[3] <= 300
        assert not any(overlapping(box, other) for other in boxes)
        inside = [box[0] < u < box[2] and box[1] < v < box[3] for u, v in marks]
        assert must or not any(inside)
        # Beside its mark: no further away than the mark's radius, a gap and a cell.
        assert max(box[0] - x, x - box[2], box[1] - y, y - box[3]) <= 4.0 + 2.0 + CELL
        boxes.append(box)


def test_places_robots_and_nodes_are_named_without_overlap(tmp_path, monkeypatch):
    """Read off the figure itself, whose letters another library has laid out."""
    rng = np.random.default_rng(1)
    nodes = {NodeId(f"r{k % 3}", 1, k): Pose2(*rng.uniform(0, 12, 2), rng.uniform(-3, 3)) for k in range(120)}
    places = {"kitchen": (6.0, 6.0), "Ladestation": (6.05, 6.05)}
    figures = []
    real = map_picture.draw_names
    monkeypatch.setattr(
        map_picture, "draw_names", lambda axes, *more: (figures.append(axes), real(axes, *more))
    )
    draw_map(MapPicture("many", nodes, [], places=places), tmp_path / "map.png")
    (axes,) = figures
    boxes = {text.get_text(): text.get_window_extent().extents for text in axes.texts if text.get_text()}
    assert {"r0", "r1", "r2", "kitchen", "Ladestation"} <= boxes.keys()
    assert len(boxes.keys() & set(map(str, nodes))) > 40
    named = [boxes[name] for name in boxes if not name.endswith(" m")]
    # What is drawn has the letters' room, and a pixel of spacing around it.
    shrunk = [(left + 1, bottom + 1, right - 1, top - 1) for left, bottom, right, top in named]
    assert not any(overlapping(a, b) for k, a in enumerate(shrunk) for b in shrunk[:k])
    window = axes.get_window_extent().extents
    assert all(a[0] >= window[0] and a[1] >= window[1] and a[2] <= window[2] for a in shrunk)


def test_one_stray_landmark_does_not_stretch_the_picture_and_all_nodes_are_in_it():
    landmarks = np.random.default_rng(0).uniform([0, -1], [6, 3], (100, 2))
    near = bounds_of(MapPicture("", NODES, [], landmarks=landmarks))
    assert near[0] <= landmarks[:, 0].min() and near[1] >= landmarks[:, 0].max(), "what is spread is all in"
    far = bounds_of(MapPicture("", NODES, [], landmarks=np.vstack([landmarks, [900.0, -70.0]])))
    assert far[1] - far[0] < 1.3 * (near[1] - near[0]) and far[3] - far[2] < 1.3 * (near[3] - near[2])
    # A node is no landmark: far off as it is, it is in the picture.
    left, right, bottom, top = bounds_of(
        MapPicture("", {**NODES, NodeId("r2", 1, 1): Pose2(50, -20)}, [], landmarks=landmarks)
    )
    assert right > 50 and bottom < -20 and left < 0 and top > 3
