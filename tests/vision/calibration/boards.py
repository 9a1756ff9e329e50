"""Views of the printed target: its PDF is read back, drawn, and seen through a known camera."""

import re
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array
from mapweave.vision.calibration.target import CalibrationTarget
from mapweave.vision.calibration.views import BoardView, placement_of

POINTS = 72.0 / 25.4
SIZE = (640, 480)
PINHOLE = np.array([560.0, 562.0, 322.0, 238.0, -0.3, 0.12, 0.001, -0.0005, -0.02])
FISHEYE = np.array([230.0, 231.0, 318.0, 241.0, -0.02, 0.004, -0.003, 0.0005])


@dataclass(frozen=True)
class Page:
    """What a PDF of one page shows.

    Attributes:
        size: mm.
        rectangles: (N, 4) mm x, y of the lower left corner, width, height, from the page's lower left corner.
        lines: (M, 4) mm, ends.
        texts: in order.
    """

    size: tuple[float, float]
    rectangles: Array
    lines: Array
    texts: list[str]


def read_page(data: bytes) -> Page:
    """Read a PDF without compression: its cross-reference table, its box, and its drawing operators."""
    assert data.startswith(b"%PDF-1.")
    start = int(re.findall(rb"startxref\n(\d+)\n%%EOF\n$", data)[0])
    places = [int(entry) for entry in re.findall(rb"(\d{10}) 00000 n ", data[start:])]
    for number, place in enumerate(places, 1):
        assert data[place:].startswith(b"%d 0 obj\n" % number), "the table says where each object begins"
    box = [float(v) for v in re.findall(rb"/MediaBox \[([^\]]*)\]", data)[0].split()]
    length = int(re.findall(rb"/Length (\d+)", data)[0])
    begin = data.index(b"stream\n") + 7
    assert data[begin + length :].startswith(b"\nendstream")
    operands: list[str] = []
    scale, rectangles, lines, at = 1.0, [], [], (0.0, 0.0)
    content = data[begin : begin + length].decode("ascii")
    texts = re.findall(r"\(((?:\\.|[^()\\])*)\)", content)
    for word in re.sub(r"\((?:\\.|[^()\\])*\)", "", content).split():
        numbers = [float(v) for v in operands if re.fullmatch(r"-?[\d.]+", v)]
        if word == "cm":
            scale = numbers[0]
            assert numbers == [scale, 0, 0, scale, 0, 0]
        elif word == "re":
            rectangles.append(numbers)
        elif word == "m":
            at = numbers[0], numbers[1]
        elif word == "l":
            lines.append([*at, *numbers])
        if re.fullmatch(r"[A-Za-z]+", word):
            operands = []
        else:
            operands.append(word)
    mm = scale / POINTS
    size = box[2] / POINTS, box[3] / POINTS
    return Page(size, mm * np.array(rectangles), mm * np.array(lines), texts)


def bitmap(page: Page, per_mm: float = 8.0) -> tuple[NDArray[np.uint8], Array]:
    """The page's black rectangles, and target_from_bitmap (3, 3): m on the target from px."""
    width, height = (round(per_mm * side) for side in page.size)
    image = np.full((height, width), 255, np.uint8)
    for x, y, w, h in page.rectangles:
        top, low = round(per_mm * (page.size[1] - y - h)), round(per_mm * (page.size[1] - y))
        image[top:low, round(per_mm * x) : round(per_mm * (x + w))] = 0
    left = page.rectangles[:, 0].min()
    top = page.size[1] - (page.rectangles[:, 1] + page.rectangles[:, 3]).max()
    m = 1e-3 / per_mm
    # The middle of pixel 0 is half a pixel from the page's edge.
    return image, np.array([[m, 0, m / 2 - 1e-3 * left], [0, m, m / 2 - 1e-3 * top], [0, 0, 1]])


def pose(rng: np.random.Generator, target: CalibrationTarget, focal: float) -> Array:
    """camera_from_target (6,): somewhere in the image, tilted by up to 40 degrees."""
    turn = rng.uniform(-0.7, 0.7, 3) * [1.0, 1.0, 0.3]
    rotation, _ = cv2.Rodrigues(turn)
    distance = rng.uniform(0.24, 0.55) * focal / 480.0
    middle = np.array([*rng.uniform(-0.4, 0.4, 2) * SIZE / focal, 1.0])
    width, height = target.size
    return np.concatenate([turn, distance * middle - rotation @ [width / 2, height / 2, 0.0]])


def pixels_of(intrinsics: Array, at: Array, points: Array) -> Array:
    """(N, 2) px by OpenCV; NaN behind the camera."""
    fx, fy, cx, cy = intrinsics[:4]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    project = cv2.fisheye.projectPoints if len(intrinsics) == 8 else cv2.projectPoints
    pixels, _ = project(points[:, None], at[:3], at[3:], matrix, intrinsics[4:])
    rotation, _ = cv2.Rodrigues(at[:3])
    ahead = (points @ rotation.T + at[3:])[:, 2] > 0.03
    return np.where(ahead[:, None], pixels.reshape(-1, 2), np.nan)


@lru_cache(maxsize=8)
def rays_of(intrinsics: tuple[float, ...], size: tuple[int, int], finer: int) -> Array:
    """(N, 3) rays of the pixels of an image that is finer by a factor, by OpenCV."""
    fine = np.stack(np.meshgrid(np.arange(finer * size[0]), np.arange(finer * size[1])), axis=-1)
    pixels = (fine.reshape(-1, 1, 2) + 0.5) / finer - 0.5
    fx, fy, cx, cy = intrinsics[:4]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    undistort = cv2.fisheye.undistortPoints if len(intrinsics) == 8 else cv2.undistortPoints
    rays = undistort(pixels.astype(np.float64), matrix, np.array(intrinsics[4:])).reshape(-1, 2)
    return np.column_stack([rays, np.ones(len(rays))])


def drawn_view(
    picture: NDArray[np.uint8], target_from_bitmap: Array, intrinsics: Array,
    at: Array, rng: np.random.Generator, size: tuple[int, int] = SIZE, finer: int = 2,
) -> NDArray[np.uint8]:  # fmt: skip
    """(H, W) grey: what the camera sees of the bitmap, with blur and noise."""
    width, height = finer * size[0], finer * size[1]
    rays = rays_of(tuple(intrinsics.tolist()), size, finer)
    rotation, _ = cv2.Rodrigues(at[:3])
    target_from_rays = np.linalg.inv(np.column_stack([rotation[:, :2], at[3:]]))
    spots = rays @ (np.linalg.inv(target_from_bitmap) @ target_from_rays).T
    spots = np.clip(np.nan_to_num(spots[:, :2] / spots[:, 2:], nan=-9.0), -9.0, 1e4).astype(np.float32)
    seen = cv2.remap(picture, spots.reshape(height, width, 2), None, cv2.INTER_AREA, borderValue=90)
    small = cv2.resize(seen.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    noisy = cv2.GaussianBlur(small, (0, 0), 0.7) * 0.7 + 30 + rng.normal(0.0, 2.0, small.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def corner_views(
    rng: np.random.Generator, intrinsics: Array, count: int, noise_px: float,
    target: CalibrationTarget | None = None, inside: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0),
) -> list[BoardView]:  # fmt: skip
    """Views as a perfect detector gives them, with Gaussian noise.

    Args:
        rng: of all.
        intrinsics: true.
        count: of views.
        noise_px: of each corner in each direction.
        target: the board.
        inside: part of the image where corners are seen: left, top, right, low, as shares.
    """
    target, views = target or CalibrationTarget(), []
    low, high = np.array(inside[:2]) * SIZE + 3.0, np.array(inside[2:]) * SIZE - 4.0
    while len(views) < count:
        pixels = pixels_of(intrinsics, pose(rng, target, float(intrinsics[0])), target.corners)
        seen = np.flatnonzero(((pixels > low) & (pixels < high)).all(axis=1))
        if len(seen) < 12 or len({*seen // (target.columns - 1)}) < 2:
            continue
        points, at = target.corners[seen], pixels[seen] + noise_px * rng.normal(size=(len(seen), 2))
        placement = placement_of(target, SIZE, points, at)
        if placement is not None:
            views.append(BoardView(SIZE, seen, points, at, placement))
    return views
