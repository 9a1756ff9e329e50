"""The renderer against `Camera`, a ray caster and its textures: where things are, and what is in front."""

import math

import cv2
import numpy as np
import pytest

from mapweave import Camera, Pose2
from mapweave.sim.renderer import Renderer
from mapweave.sim.scene import Scene
from mapweave.sim.texture import Texture
from mapweave.sim.world import Panel, PanelSet, World, upright_panel

CAMERA = Camera(320, 240, 277.0, 271.0, 159.5, 118.0, mount_height=0.3, mount_forward=0.07)
COLUMNS, ROWS = 10, 8
"""Squares of the checkerboard."""
MARKS = np.array([(i / COLUMNS, j / ROWS) for j in range(1, ROWS) for i in range(1, COLUMNS)])
"""(63, 2) inner corners, as shares of the board's width and height."""
AROUND = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 13), np.linspace(-0.4, 0.4, 13)), axis=-1).reshape(-1, 2)
"""(169, 2) places around a mark, in squares."""


def pattern(places: np.ndarray) -> np.ndarray:
    """Grey of the board at (..., 2) shares: squares that fade into each other; pixels lose nothing."""
    waves = np.sin(places * [COLUMNS * np.pi, ROWS * np.pi])
    grey: np.ndarray = 127.5 + 120.0 * waves[..., 0] * waves[..., 1]
    return grey


def board(width_px: int, height_px: int) -> Texture:
    """The board at a resolution."""
    x, y = (np.arange(width_px) + 0.5) / width_px, (np.arange(height_px) + 0.5) / height_px
    return Texture.of(pattern(np.stack(np.meshgrid(x, y), axis=-1)).round().astype(np.uint8))


def mark_shifts(image: np.ndarray, pixels: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(N, 2) px by which each mark is away from where it should be, by least squares on the greys around it.

    Args:
        image: what was drawn.
        pixels: (N, K, 2) px where the places around each mark should be seen.
        places: (N, K, 2) those places on the board.
    """
    u, v = np.moveaxis(pixels.astype(np.float32), -1, 0)
    grey = image.astype(np.float32)
    slopes = [cv2.Sobel(grey, cv2.CV_32F, *order, ksize=3, scale=1 / 8) for order in ((1, 0), (0, 1))]
    seen, across, down = (cv2.remap(x, u, v, cv2.INTER_CUBIC) for x in (grey, *slopes))
    shifts = []
    for k in range(len(pixels)):
        design = -np.column_stack([across[k], down[k]])
        shifts.append(np.linalg.lstsq(design, seen[k] - pattern(places[k]), rcond=None)[0])
    return np.array(shifts)


@pytest.mark.parametrize("size_px", [(400, 320), (1230, 987)])
@pytest.mark.parametrize("slant_deg", [0, 35, -60])
@pytest.mark.parametrize("distance", [0.9, 1.4, 2.2])
def test_marks_agree_with_the_camera_model(
    distance: float, slant_deg: float, size_px: tuple[int, int], stand
):
    """Corners of a board at known places, for any resolution of the board."""
    robot = Pose2(2.0, -1.0, 0.7)
    frame = robot @ Pose2(CAMERA.mount_forward + distance, 0.03, math.radians(slant_deg))
    width, height = 1.0, 0.8
    ends = frame.apply(np.array([[0.0, width / 2], [0.0, -width / 2]]))
    bottom = CAMERA.mount_height - height / 2 + 0.02
    panel = upright_panel(tuple(ends[0]), tuple(ends[1]), bottom, bottom + height, board(*size_px))
    places = MARKS[:, None] + AROUND / [COLUMNS, ROWS]
    points = panel.corner + places[..., :1] * panel.along + places[..., 1:] * panel.down
    pixels = CAMERA.project(robot.inverse().apply(points))
    inside = CAMERA.contains(pixels, 6.0).all(axis=1)
    image = Renderer(CAMERA, 128).render(PanelSet.of([panel]), *stand(robot))
    shifts = mark_shifts(image, pixels[inside], places[inside])
    assert len(shifts) >= 20
    assert np.abs(shifts.mean(axis=0)).max() < 0.03
    assert np.linalg.norm(shifts, axis=1).max() < 0.1


@pytest.mark.parametrize("size_px", [(1600, 1280), (1230, 987)])
def test_levels_of_a_texture_lie_on_each_other(size_px: tuple[int, int]):
    """Each mark is at the same share of the width and height at every level."""
    texture = board(*size_px)
    places = MARKS[:, None] + AROUND / [COLUMNS, ROWS]
    for across, down in [(0, 0), (1, 0), (0, 2), (2, 1), (3, 3)]:
        image = texture.level(across, down)
        size = np.array(image.shape[::-1])
        assert size.tolist() == [size_px[0] >> across, size_px[1] >> down]
        shifts = mark_shifts(image, places * size - 0.5, places)
        assert np.abs(shifts.mean(axis=0)).max() < 0.02
        assert np.abs(shifts).max() < 0.1


def test_textures_stop_at_one_texel():
    """Halving never makes an empty image, and a grey stays that grey."""
    level = Texture.plain(99).level(7, 9)
    assert level.shape == (1, 1)
    assert level[0, 0] == 99


def grey_of(panel):
    """A grey for each panel; neighbours in number differ much."""
    return 5 + 83 * panel % 251


def random_panels(rng: np.random.Generator, count: int) -> PanelSet:
    """Parallelograms of different plain greys ahead of a robot, at any slant, many behind one another."""
    panels = []
    for k in range(count):
        middle = rng.uniform(0.3, 5.0) * np.array([1.0, *rng.uniform(-0.6, 0.6, 2)])
        along, down = rng.normal(0, 0.3 * middle[0] + 0.1, (2, 3))
        if np.cross(along, down) @ middle < 0 and rng.random() < 0.7:
            along, down = down, along
        panels.append(Panel(middle - along / 2 - down / 2, along, down, Texture.plain(grey_of(k))))
    return PanelSet.of(panels)


def placed(panels: PanelSet, rotation: np.ndarray, position: np.ndarray) -> PanelSet:
    """Panels of an object at a pose: (3, 3) turns its vectors, and (3,) m is where it lies."""
    corner = panels.corner @ rotation.T + position
    return PanelSet(corner, panels.along @ rotation.T, panels.down @ rotation.T, panels.textures)


@pytest.mark.parametrize(("seed", "count"), [*((seed, 28) for seed in range(6)), (6, 150), (7, 150)])
def test_the_nearest_surface_is_the_first_hit_of_a_ray(seed: int, count: int, caster):
    """Every pixel of a world in disorder, seen by a tilted camera; of many panels most are hidden."""
    rng = np.random.default_rng(seed)
    camera = Camera(80, 60, 60.0, 62.0, 41.0, 28.5, mount_height=0.3, mount_forward=0.1)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    position = rng.uniform(-5, 5, 3)
    panels = placed(random_panels(rng, count), rotation, position)
    image = Renderer(camera, 3).render(panels, rotation, position)
    v, u = np.mgrid[0:60, 0:80]
    pixels = np.column_stack([u.ravel(), v.ravel()]).astype(float)
    truth = caster.cast(panels, camera, rotation, position, pixels)
    greys = np.where(truth.panel >= 0, grey_of(truth.panel), 3).reshape(60, 80)
    sure = ~truth.doubtful.reshape(60, 80)
    assert sure.mean() > 0.98
    assert len(np.unique(greys)) > 5
    np.testing.assert_array_equal(image[sure], greys[sure])


def test_a_scene_of_moved_sets_is_the_scene_of_their_places(office: World, stand):
    """Sets that are placed later look as if they had been built there."""
    rng = np.random.default_rng(8)
    crates = [random_panels(rng, 6) for _ in range(3)]
    scene = Scene([PanelSet.of(office.panels), *crates])
    room = office.plan.rooms[1]
    rotation, position = stand(Pose2(room.x, room.y, 0.3))
    there = []
    for number, crate in enumerate(crates):
        pose = stand(Pose2(room.x, room.y, float(rng.uniform(-1, 1))))
        scene.place(number + 1, *pose)
        there.append(placed(crate, *pose))
    whole = PanelSet.joined([PanelSet.of(office.panels), *there])
    images = [Renderer(CAMERA, 9).render(panels, rotation, position) for panels in (scene, whole)]
    np.testing.assert_array_equal(*images)
    alone = Renderer(CAMERA, 9).render(PanelSet.of(office.panels), rotation, position)
    assert (images[0] != alone).mean() > 0.02


def test_nothing_in_view_is_background(stand):
    """Behind, too near, too far, from the back, and no panel at all."""
    renderer = Renderer(CAMERA, 77)
    rotation, position = stand(Pose2())
    grey = Texture.plain(10)
    behind = upright_panel((-1.0, -1.0), (-1.0, 1.0), 0.0, 1.0, grey)
    back = upright_panel((2.0, -1.0), (2.0, 1.0), 0.0, 1.0, grey)
    near = upright_panel((0.08, 0.5), (0.08, -0.5), 0.0, 1.0, grey)
    far = upright_panel((70.0, 50.0), (70.0, -50.0), 0.0, 50.0, grey)
    for panels in ([], [behind], [back], [near], [far]):
        assert (renderer.render(PanelSet.of(panels), rotation, position) == 77).all()
    front = upright_panel((2.0, 1.0), (2.0, -1.0), 0.0, 1.0, grey)
    assert (renderer.render(PanelSet.of([front]), rotation, position) == 10).any()
