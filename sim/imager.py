"""Images of a robot's camera: the ideal picture, distorted, blurred, exposed, and noisy."""

import math
from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array
from mapweave.sim.camera import CameraSetup, undistorted
from mapweave.sim.renderer import Renderer
from mapweave.sim.scene import Scene
from mapweave.sim.texture import Image
from mapweave.vision.equidistant import Equidistant
from mapweave.vision.lens import NO_DISTORTION, Distortion

MARGIN_PX = 2
"""The ideal picture reaches so far beyond what the lens shows, for interpolation."""
SPARE_PX = (96, 192)
"""Rows and columns by which the field of noise is larger than a picture: each cuts another piece of it."""
STEPS_PER_OCTAVE = 4
"""The strength of noise goes with the gain in steps of this share of a doubling."""
FARTHEST_TANGENT = 3.0
"""Tangent of the angle from the axis beyond which a fisheye's picture is black."""
LEAST_BLUR_PX = 0.5
"""Less motion than this while the shutter is open cannot be seen."""
MOST_LAYERS = 8
"""A blurred picture is the mean of at most so many."""


class Imager:
    """Takes a robot's pictures. Each robot has its own, so pictures may be taken in several threads."""

    def __init__(self, setup: CameraSetup, background: int, seed: Sequence[int]) -> None:
        """Load the camera.

        Args:
            setup: of the robot.
            background: grey without panels.
            seed: of its noise, its dropped frames, and how it differs from its kind.
        """
        self.setup = setup
        camera = setup.intrinsics
        self._lens = _lens(camera, setup.distortion) if setup.distortion != NO_DISTORTION else None
        self._ideal = Renderer(camera if self._lens is None else self._lens[0], background)
        self._drops = np.random.default_rng([*seed, 1])
        self._cuts = np.random.default_rng([*seed, 2])
        own = np.random.default_rng([*seed, 3])
        self._sensitivity = max(0.2, 1.0 + setup.exposure.gain_error * float(own.standard_normal()))
        shape = (camera.height + SPARE_PX[0], camera.width + SPARE_PX[1])
        self._grain = own.standard_normal(shape, dtype=np.float32)
        self._rounded: dict[int, tuple[Image, Image]] = {}
        self._falloff = _falloff(camera, setup.exposure.vignetting) if setup.exposure.vignetting else None
        self._log_gain = 0.0
        self._mean: float | None = None

    @property
    def gain(self) -> float:
        """The gain of the automatic exposure, 1 at the beginning."""
        return math.exp(self._log_gain)

    def drops(self) -> bool:
        """Whether this tick's frame is dropped, at random. Call once a tick."""
        return self.setup.dropped > 0.0 and bool(self._drops.random() < self.setup.dropped)

    def picture(
        self,
        scene: Scene,
        pose: tuple[NDArray[np.float64], NDArray[np.float64]],
        lamps: float,
        turn_rate: float,
        seconds: float,
        covered: int | None = None,
    ) -> Image:
        """Take a picture.

        Args:
            scene: all there is to see.
            pose: (3,) m of the robot's origin, and (3, 3) rotation of its axes, in world.
            lamps: brightness, 1 as painted.
            turn_rate: of the robot, rad/s.
            seconds: since the picture before, s.
            covered: grey of what is held before the lens, if anything is.

        Returns:
            (H, W) grey, as the robot gets it.
        """
        position, rotation = pose
        self._adapt(seconds)
        camera = self.setup.intrinsics
        if covered is not None:
            image = np.full((camera.height, camera.width), covered, np.uint8)
        else:
            image = self._ideal.render(scene, rotation, position)
            image = self._blurred(image, turn_rate * self.setup.exposure.seconds)
            if self._lens is not None:
                image = np.asarray(cv2.remap(image, *self._lens[1:], cv2.INTER_LINEAR), dtype=np.uint8)
        image = self._exposed(image, lamps * self._sensitivity * self.gain)
        image = self._noisy(image)
        if self.setup.exposure.automatic:
            self._mean = float(cv2.mean(image)[0])
        return image

    def _adapt(self, seconds: float) -> None:
        """Update the automatic gain, by the mean of the last picture."""
        if self._mean is None or seconds <= 0.0:
            return
        e = self.setup.exposure
        off = math.log(e.wanted / max(self._mean, 1.0))
        if abs(off) > e.band:
            share = 1.0 - math.exp(-seconds / e.lag) if e.lag > 0 else 1.0
            self._log_gain += share * (off - math.copysign(e.band, off))
            self._log_gain = min(max(self._log_gain, math.log(e.lowest)), math.log(e.highest))

    def _blurred(self, image: Image, turned: float) -> Image:
        """The mean of what is seen while the robot turns by an angle, half of it before the stamp."""
        camera = self._ideal.camera
        moved = abs(turned) * camera.fx
        if moved <= LEAST_BLUR_PX:
            return image
        layers = min(MOST_LAYERS, max(2, math.ceil(moved)))
        intrinsics = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
        total = np.zeros(image.shape, np.uint16)
        for angle in turned * ((np.arange(layers) + 0.5) / layers - 0.5):
            c, s = math.cos(angle), math.sin(angle)
            # A robot that turns left by an angle sees things move right.
            homography = intrinsics @ [[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]] @ np.linalg.inv(intrinsics)
            layer = cv2.warpPerspective(
                image, homography, (camera.width, camera.height),
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE,
            )  # fmt: skip
            cv2.add(total, layer, dst=total, dtype=cv2.CV_16U)
        return np.asarray(cv2.convertScaleAbs(total, alpha=1.0 / layers), dtype=np.uint8)

    def _exposed(self, image: Image, factor: float) -> Image:
        if self._falloff is not None:
            lit = cv2.multiply(image, self._falloff, scale=factor, dtype=cv2.CV_8U)
            return np.asarray(lit, dtype=np.uint8)
        if abs(factor - 1.0) < 1e-9:
            return image
        return np.asarray(cv2.convertScaleAbs(image, alpha=factor), dtype=np.uint8)

    def _noisy(self, image: Image) -> Image:
        """Add the noise of reading out and of the light itself, saturating."""
        setup = self.setup
        if not setup.read_noise and not setup.shot_noise:
            return image
        top = int(self._cuts.integers(SPARE_PX[0] + 1))
        left = int(self._cuts.integers(SPARE_PX[1] + 1))
        cut = (slice(top, top + image.shape[0]), slice(left, left + image.shape[1]))
        step = round(STEPS_PER_OCTAVE * self._log_gain / math.log(2.0))
        gain = 2.0 ** (step / STEPS_PER_OCTAVE)
        read = setup.read_noise * gain
        if setup.shot_noise:
            greys = np.arange(256, dtype=np.float64)
            sigmas = np.sqrt(read**2 + setup.shot_noise**2 * gain * greys / 255.0).astype(np.float32)
            noise = cv2.multiply(cv2.LUT(image, sigmas), self._grain[cut])
            return np.asarray(cv2.add(image, noise, dtype=cv2.CV_8U), dtype=np.uint8)
        if step not in self._rounded:
            # Pixels are whole numbers, so rounded noise added is the same as noise added and rounded.
            whole = np.rint(self._grain * np.float32(read))
            self._rounded[step] = (
                np.clip(whole, 0, 255).astype(np.uint8),
                np.clip(-whole, 0, 255).astype(np.uint8),
            )
        more, less = self._rounded[step]
        return np.asarray(cv2.subtract(cv2.add(image, more[cut]), less[cut]), dtype=np.uint8)


@lru_cache(maxsize=32)
def _lens(camera: Camera, distortion: Distortion) -> tuple[Camera, NDArray[np.int16], NDArray[np.uint16]]:
    """An ideal camera that sees all that the lens shows, and where in its picture each pixel is.

    Returns:
        The camera, with the same focal length, and cv2.remap's maps: each pixel of the real image samples
        the ideal ray that the lens shows there.
    """
    u, v = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2)
    if isinstance(distortion, Equidistant):
        rays = distortion.rays(pixels)
        rays[~(np.hypot(*rays.T) < FARTHEST_TANGENT)] = np.nan
    else:
        matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
        rays = undistorted(pixels[:, None], matrix, np.array(distortion))
    ideal: Array = rays * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    left, top = np.floor(np.nanmin(ideal, axis=0)).astype(int) - MARGIN_PX
    right, low = np.ceil(np.nanmax(ideal, axis=0)).astype(int) + MARGIN_PX
    larger = Camera(
        width=int(right - left + 1), height=int(low - top + 1), fx=camera.fx, fy=camera.fy,
        cx=camera.cx - float(left), cy=camera.cy - float(top),
        mount_height=camera.mount_height, mount_forward=camera.mount_forward,
    )  # fmt: skip
    # What is too far out is outside the picture: black.
    places = (
        np.nan_to_num(ideal - [left, top], nan=-10.0)
        .astype(np.float32)
        .reshape(camera.height, camera.width, 2)
    )
    whole, fraction = cv2.convertMaps(places[..., 0], places[..., 1], cv2.CV_16SC2)
    return larger, np.asarray(whole, np.int16), np.asarray(fraction, np.uint16)


def _falloff(camera: Camera, share: float) -> NDArray[np.float32]:
    """(H, W) what is left of the light, 1 on the axis, by the square of the distance from it."""
    u, v = np.meshgrid(np.arange(camera.width) - camera.cx, np.arange(camera.height) - camera.cy)
    square = u**2 + v**2
    return np.asarray(1.0 - share * square / square.max(), dtype=np.float32)
