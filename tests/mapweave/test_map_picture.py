"""Pictures of maps: a PNG with what was asked for in it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mapweave.drawing.map_picture import COLOURS, Drive, MapPicture, Outline, draw_map, outline_of
from mapweave.hybridmap.node import Edge, EdgeKind, NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.sim.floorplan import FloorPlan, Rectangle

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


def test_the_floor_the_landmarks_and_the_drive_are_drawn(tmp_path):
    plan = FloorPlan(
        (Rectangle.spanning(0, -1, 6, 3, "room 0"), Rectangle.spanning(6, 0, 6.2, 1, "door 0")),
        (Rectangle.spanning(0, 3, 6, 3.2),),
        (Rectangle(4.5, 2.2, 1.0, 0.6, 0.4, "table"),),
    )
    outline = outline_of(plan)
    assert [name for name, _ in outline.rooms] == ["room 0", ""], "doors have no name to be written"
    assert len(outline.solids) == 2
    drive = Drive(np.array([[1.0, 0.0], [2.0, 2.0], [4.0, 1.0]]), Pose2(1, 0), Pose2(4, 1), "drive of r0")
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
