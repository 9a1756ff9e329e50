"""The features of an image, with which a robot or a person asks. The base installation has all for it."""

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.query import View
from mapweave.vision.lens import NO_DISTORTION, Distortion, Lens
from mapweave.vision.sift import Sift


def view_of(image: NDArray[np.uint8], camera: Camera, distortion: Distortion = NO_DISTORTION) -> View:
    """The features of an image, for `Relocalizer.answer`.

    Args:
        image: (H, W) grey, as it comes from the camera.
        camera: that took it; its mount says where on the robot it is.
        distortion: of its lens.
    """
    return Sift(Lens(camera, distortion)).extract(image).view(camera)
