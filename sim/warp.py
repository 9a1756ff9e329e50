"""A flat texture as it is seen at a slant, filtered for its size there."""

import math

import cv2
import numpy as np

from mapweave.hybridmap.pose import Array
from mapweave.sim.texture import Image, Texture


def warped(
    texture: Texture, forms: Array, centre: tuple[float, float], box: tuple[int, int, int, int]
) -> Image:
    """A texture as it is seen in a part of the image.

    Args:
        texture: of the panel.
        forms: (3, 3) rows p / z, q / z, 1 / z as linear forms of (u, v, 1).
        centre: (u, v) px, where its size is taken.
        box: left, top, width and height of the part, px.
    """
    (pu, pv, p1), (qu, qv, q1), (wu, wv, w1) = forms.tolist()
    u, v = centre
    w = wu * u + wv * v + w1
    p, q = (pu * u + pv * v + p1) / w, (qu * u + qv * v + q1) / w
    across = math.hypot(pu - p * wu, pv - p * wv) / abs(w) * texture.width_px
    down = math.hypot(qu - q * wu, qv - q * wv) / abs(w) * texture.height_px
    source = texture.level(_halvings(across, texture.width_px), _halvings(down, texture.height_px))
    left, top, width, height = box
    p1, q1, w1 = p1 + pu * left + pv * top, q1 + qu * left + qv * top, w1 + wu * left + wv * top
    high, wide = source.shape
    # Pixel centres are whole numbers, OpenCV's convention: half a texel less.
    to_texture = np.array(
        [
            [wide * pu - 0.5 * wu, wide * pv - 0.5 * wv, wide * p1 - 0.5 * w1],
            [high * qu - 0.5 * wu, high * qv - 0.5 * wv, high * q1 - 0.5 * w1],
            [wu, wv, w1],
        ]
    )
    return np.asarray(
        cv2.warpPerspective(
            source,
            to_texture,
            (width, height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        ),
        dtype=np.uint8,
    )


def _halvings(texels_per_pixel: float, size_px: int) -> int:
    """How often to halve a texture so that about one texel falls on one pixel."""
    wanted = round(math.log2(max(texels_per_pixel, 1.0)))
    return min(wanted, size_px.bit_length() - 1)
