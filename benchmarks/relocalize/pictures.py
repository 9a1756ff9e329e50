"""Pictures of simulated buildings with true depths, kept on disk: taken once, used by many runs.

The robot's own camera takes them (lens, exposure, noise) and its own eyes find the features; only that it
drives there is left out. What is kept is named by a digest of the sources that make it, so that nothing stale
is used.
"""

import hashlib
import math
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.images import surface_points as mapping_truth
from benchmarks.images.surface_points import Surfaces
from mapweave import sim, vision
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.descriptor import encode
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import View
from mapweave.sim.actors import FIGURES, figure_panels
from mapweave.sim.camera import CAMERAS
from mapweave.sim.imager import Imager
from mapweave.sim.robots import RobotSetup
from mapweave.sim.scene import Scene
from mapweave.sim.stage import upright
from mapweave.sim.texture import Image
from mapweave.sim.world import PanelSet, World
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Sift

FOLDER = Path(tempfile.gettempdir()) / "mapweave-relocalize"
VERSION = 1
"""Of what this file does; another version makes all pictures again."""


@dataclass(frozen=True, eq=False)
class RenderedPicture:
    """What is in one picture.

    Attributes:
        world_from_robot: where it was truly taken.
        camera: that took it.
        pixels: (N, 2) float32, undistorted px.
        sift: (N, 128) uint8, whole descriptors.
        depths: (N,) float32 m, true; NaN where a feature is no point of one surface.
    """

    world_from_robot: Pose2
    camera: Camera
    pixels: NDArray[np.float32]
    sift: NDArray[np.uint8]
    depths: NDArray[np.float32]

    def __len__(self) -> int:
        """How many features."""
        return len(self.pixels)

    @cached_property
    def view(self) -> View:
        """The view with which a robot would ask."""
        return View(self.pixels, encode(self.sift), self.camera)


@dataclass(frozen=True)
class ViewDisturbance:
    """What is between a robot and a good picture.

    Attributes:
        person: whether a person hides about a third of the view.
        gain: factor on the brightness.
        gamma: bend of the tone curve. The simulator's pictures are grey, and what another white balance does
            to a grey picture is another curve.
        turn_rate: of the robot while the shutter is open, rad/s.
        shutter: s.
        blur: sigma of what is out of focus, px.
    """

    person: bool = False
    gain: float = 1.0
    gamma: float = 1.0
    turn_rate: float = 0.0
    shutter: float = 0.0
    blur: float = 0.0


@dataclass(frozen=True)
class Wish:
    """One picture to be taken.

    Attributes:
        place: world_from_robot.
        disturbance: in its way.
        number: of the person, if there is one.
    """

    place: Pose2
    disturbance: ViewDisturbance = field(default_factory=ViewDisturbance)
    number: int = 0


class Photographer:
    """Takes pictures of one world with one camera."""

    def __init__(self, world: World, seed: Sequence[int], camera: str = "webcam") -> None:
        """Load the camera.

        Args:
            world: as it is furnished now.
            seed: of the camera's noise.
            camera: one of mapweave.sim.camera.CAMERAS.
        """
        self._world, self._seed = world, tuple(seed)
        self._setup = CAMERAS[camera]
        self.camera = self._setup.intrinsics
        body = RobotSetup("r0", self._setup).describe()
        self._lens = Lens(body.camera, body.distortion)
        self._eyes = Sift(self._lens)
        self._surfaces = Surfaces(world)
        self._still = PanelSet.of(world.panels)
        self._imagers: dict[float, Imager] = {}

    def image(self, wish: Wish) -> Image:
        """(H, W) grey."""
        sets, d = [self._still], wish.disturbance
        if d.person:
            sets.append(_person(wish.number))
        scene = Scene(sets)
        if d.person:
            scene.place(1, *upright(wish.place @ _before(self.camera, wish.number)))
        rotation, position = upright(wish.place)
        picture = self._imager(d.shutter).picture(scene, (position, rotation), 1.0, d.turn_rate, 0.0)
        if d.blur:
            picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), d.blur), np.uint8)
        if d.gain != 1.0 or d.gamma != 1.0:
            curve = 255.0 * np.clip(d.gain * (np.arange(256) / 255.0) ** d.gamma, 0.0, 1.0)
            picture = np.asarray(cv2.LUT(picture, np.rint(curve).astype(np.uint8)), np.uint8)
        return picture

    def take(self, wish: Wish) -> RenderedPicture:
        """Take one."""
        keypoints, descriptors = self._eyes.describe(self.image(wish))
        pixels = self._lens.undistort(np.array([k.pt for k in keypoints], dtype=np.float64).reshape(-1, 2))
        sift = np.rint(descriptors).astype(np.uint8)
        depths = np.zeros(0)
        if len(pixels):
            seen = self._surfaces.see(wish.place, self.camera, pixels)
            flat = self._surfaces.flat(wish.place, self.camera, pixels)
            depths = np.where(flat & np.isfinite(seen.depths), seen.depths, np.nan)
        return RenderedPicture(
            wish.place, self.camera, pixels.astype(np.float32), sift, depths.astype(np.float32)
        )

    def _imager(self, shutter: float) -> Imager:
        if shutter not in self._imagers:
            setup = self._setup
            if shutter:
                setup = replace(setup, exposure=replace(setup.exposure, seconds=shutter))
            self._imagers[shutter] = Imager(setup, self._world.background, (*self._seed, 0xCA))
        return self._imagers[shutter]


@lru_cache(maxsize=16)
def _person(number: int) -> PanelSet:
    return figure_panels("person", (number, 0x9E50))


def _before(camera: Camera, number: int) -> Pose2:
    """`robot_from_person`: broadside, so near that a third of the picture is hidden, somewhere in it."""
    away = FIGURES["person"].width * camera.fx / (camera.width / 3.0)
    bearing = float(np.random.default_rng([number, 0x51DE]).uniform(-0.6, 0.6)) * camera.semi_aperture
    return Pose2(away, away * math.tan(bearing), math.pi)


def taken(
    name: str,
    photographer: Callable[[], Photographer],
    wishes: Sequence[Wish],
    progress: Callable[[], None] = lambda: None,
) -> list[RenderedPicture]:
    """Pictures from the folder, or else from a photographer.

    Args:
        name: of world, seed and camera: all that makes the photographer.
        photographer: is only made if it is needed.
        wishes: what to take.
        progress: called once a picture.
    """
    key = hashlib.sha256(f"{_sources()} {name} {list(wishes)}".encode()).hexdigest()[:32]
    path = FOLDER / f"{key}.npz"
    try:
        with path.open("rb") as file, np.load(file) as kept:
            made = _unpack(wishes, kept)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile):
        artist = photographer()
        made = []
        for wish in wishes:
            made.append(artist.take(wish))
            progress()
        FOLDER.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=FOLDER, suffix=".part", delete=False) as part:
            np.savez(part, **_pack(made))
        Path(part.name).replace(path)
        return made
    for _ in wishes:
        progress()
    return made


def _pack(pictures: Sequence[RenderedPicture]) -> dict[str, Any]:
    return {
        "counts": np.array([len(one) for one in pictures], np.int64),
        "camera": np.array(astuple(pictures[0].camera) if pictures else ()),
        "pixels": np.concatenate([np.zeros((0, 2), np.float32), *(one.pixels for one in pictures)]),
        "sift": np.concatenate([np.zeros((0, 128), np.uint8), *(one.sift for one in pictures)]),
        "depths": np.concatenate([np.zeros(0, np.float32), *(one.depths for one in pictures)]),
    }


def _unpack(wishes: Sequence[Wish], kept: Any) -> list[RenderedPicture]:
    """The pictures; ValueError if what is kept is not of these wishes."""
    ends = np.cumsum(kept["counts"])
    if not len(wishes):
        return []
    width, height, *rest = kept["camera"].tolist()
    camera = Camera(int(width), int(height), *rest)
    parts = [np.split(kept[name], ends[:-1]) for name in ("pixels", "sift", "depths")]
    return [
        RenderedPicture(wish.place, camera, pixels, sift, depths)
        for wish, pixels, sift, depths in zip(wishes, *parts, strict=True)
    ]


@lru_cache(maxsize=1)
def _sources() -> str:
    """Digest of all that makes a picture: simulator, eyes, truth, and the version of this file."""
    digest = hashlib.sha256(bytes([VERSION]))
    folders = [Path(package.__path__[0]) for package in (sim, vision)]
    files = [path for folder in folders for path in sorted(folder.rglob("*.py"))]
    for path in [*files, Path(mapping_truth.__file__)]:
        digest.update(path.read_bytes())
    return digest.hexdigest()
