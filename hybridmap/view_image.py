"""The image of which a node was made, as people are shown it. Maps have no images."""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.ids import NodeId

MAX_SIDE = 640
"""px; larger images are made smaller."""
MAX_BYTES = 2**16
"""Of a file."""


def view_size(camera: Camera) -> tuple[int, int]:
    """Width and height of the image of a node, px: of its camera, in proportion, at most 640 px a side."""
    scale = min(1.0, MAX_SIDE / max(camera.width, camera.height))
    return max(1, round(scale * camera.width)), max(1, round(scale * camera.height))


@dataclass(frozen=True, slots=True)
class ViewRequest:
    """Asks a robot for the image of one of its nodes.

    Attributes:
        node: of the robot.
    """

    node: NodeId


@dataclass(frozen=True, slots=True)
class ViewImage:
    """The image of a node.

    Attributes:
        node: that was asked for.
        jpeg: a grey JPEG file of `view_size`, without lens distortion.
    """

    node: NodeId
    jpeg: Annotated[bytes, Meta(max_length=MAX_BYTES)]
