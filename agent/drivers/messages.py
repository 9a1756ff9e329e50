"""Messages between an agent and a robot base in another process: MessagePack, validated field by field.

    describe    question: empty; answer: RobotDescription
    step        question: StepRequest; answer: Observation

A base refuses with a reason. Two reasons are part of the protocol: ENDED and AGAIN.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from mapweave.agent.observation import (
    FARTHEST,
    FASTEST,
    MAX_RANGERS,
    Command,
    Observation,
    Odometry,
    Reach,
    RobotDescription,
)
from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.limits import MAX_NUMBER, Share, Stamp
from mapweave.storage.image_file import decode_grey, image_size
from mapweave.wire import typed
from mapweave.wire.packing import Limit, pack, unpack

ENDED = "the base has ended"
"""Refusal: there will be no more observations, and that is no failure."""

AGAIN = "ask again later"
"""A refusal that contains this is answered by asking the same again (the bus says so when it is full)."""

MAX_IMAGE_BYTES = 16 * 2**20
"""Of an image: 16 megapixels, grey."""
MAX_SIDE_PX = 16384
"""Of an image; as for `[robot.camera]`."""
MAX_SMALL_BYTES = 16384
"""Longest message without an image."""

MOST_WAY = 10.0
"""No robot drives farther between two observations, m: 3 m/s over the longest silence before a question is
asked again."""
MOST_TURN = 20.0
"""Nor does it turn by more, rad: a turn a second over the same time."""
RAW = "raw"
COMPRESSED = ("jpeg", "png")

STEP = Limit("step", MAX_SMALL_BYTES)
OBSERVATION = Limit("observation", MAX_IMAGE_BYTES + MAX_SMALL_BYTES)
DESCRIPTION = Limit("robot description", MAX_SMALL_BYTES)

Rate = Annotated[float, Meta(ge=-FASTEST, le=FASTEST)]
Way = Annotated[float, Meta(ge=-FARTHEST, le=FARTHEST)]
Side = Annotated[int, Meta(ge=1, le=MAX_SIDE_PX)]


@dataclass(frozen=True, slots=True)
class StepRequest:
    """Apply a command for one tick, then return an observation.

    Attributes:
        sequence: 1 begins a conversation; each further step is one more. The same number again asks for the
            same answer again, and moves nothing.
        command: what the wheels shall do.
    """

    sequence: int
    command: Command


class _Step(msgspec.Struct):
    sequence: Annotated[int, Meta(ge=1, le=MAX_NUMBER)] = msgspec.field(name="q")
    command: tuple[Rate, Rate] = msgspec.field(name="c")


class _Observation(msgspec.Struct):
    stamp_ns: Stamp = msgspec.field(name="t")
    odometry: tuple[Way, Way] = msgspec.field(name="u")
    proximity: Annotated[list[Reach], Meta(max_length=MAX_RANGERS)] = msgspec.field(name="r")
    bumped: bool = msgspec.field(name="b")
    kidnapped: bool = msgspec.field(name="k", default=False)
    size: tuple[Side, Side] = msgspec.field(name="s", default=(1, 1))
    encoding: str = RAW
    image: bytes | None = msgspec.field(name="i", default=None)
    battery: Share | None = None


def encode_step(step: StepRequest) -> bytes:
    """Encode a step."""
    return pack({"q": step.sequence, "c": [step.command.forward, step.command.turn]})


def decode_step(data: bytes) -> StepRequest:
    """Decode a step.

    Raises:
        InvalidMessage: anything is wrong with it.
    """
    step: _Step = unpack(data, _Step, STEP)
    return StepRequest(step.sequence, Command(*step.command))


def encode_observation(observation: Observation) -> bytes:
    """Encode an observation; its image goes as raw grey bytes.

    Raises:
        InvalidValue: the image is no (H, W) uint8.
    """
    fields: dict[str, object] = {
        "t": observation.stamp_ns,
        "u": [observation.odometry.forward, observation.odometry.turn],
        "r": observation.proximity.tolist(),
        "b": observation.bumped,
    }
    if observation.battery is not None:
        fields["battery"] = observation.battery
    if observation.kidnapped:
        fields["k"] = True
    if observation.image is not None:
        image = np.ascontiguousarray(observation.image)
        if image.ndim != 2 or image.dtype != np.uint8:
            raise InvalidValue(f"image: must be (H, W) uint8, not {image.shape} {image.dtype}")
        # A view: the bytes are copied once, into the message.
        fields |= {"s": list(image.shape), "encoding": RAW, "i": image.data}
    return pack(fields)


def decode_observation(data: bytes) -> Observation:
    """Decode an observation. A raw image is a read-only view of the message's bytes.

    Raises:
        InvalidMessage: anything is wrong with it.
    """
    seen: _Observation = unpack(data, _Observation, OBSERVATION)
    forward, turn = seen.odometry
    if abs(forward) > MOST_WAY or abs(turn) > MOST_TURN:
        raise InvalidMessage(
            f"observation: odometry of {forward:g} m and {turn:g} rad in one step is out of range"
        )
    image = None if seen.image is None else _image(seen.encoding, seen.size, seen.image)
    odometry, proximity = Odometry(forward, turn), np.array(seen.proximity)
    rest = seen.bumped, seen.battery, seen.kidnapped
    return Observation(seen.stamp_ns, odometry, image, proximity, *rest)


def check_image(observation: Observation, description: RobotDescription) -> None:
    """Check an observation's image against the camera in the description.

    Raises:
        InvalidMessage: it has another size.
    """
    camera, image = description.camera, observation.image
    if image is not None and image.shape != (camera.height, camera.width):
        height, width = image.shape
        raise InvalidMessage(
            f"observation: an image of {width}x{height} px from a camera described as "
            f"{camera.width}x{camera.height} px"
        )


def encode_description(description: RobotDescription) -> bytes:
    """Encode a description; raises InvalidValue if it would not decode."""
    return typed.encode(description, DESCRIPTION)


def decode_description(data: bytes) -> RobotDescription:
    """Decode a description; raises InvalidMessage."""
    return typed.decode(data, RobotDescription, DESCRIPTION)


def _image(encoding: str, size: tuple[int, int], data: bytes) -> NDArray[np.uint8]:
    height, width = size
    if encoding == RAW:
        if len(data) != height * width:
            raise InvalidMessage(
                f"observation: a raw image of {width}x{height} px cannot have {len(data)} bytes"
            )
        return np.frombuffer(data, np.uint8).reshape(size)
    if encoding not in COMPRESSED:
        names = ", ".join((RAW, *COMPRESSED))
        raise InvalidMessage(f"observation: image encoding {encoding[:32]!r} is not {names}")
    if height * width > MAX_IMAGE_BYTES:
        raise InvalidMessage(f"observation: an image of {width}x{height} px is too large")
    return _decompress(encoding, data, size)


def _decompress(encoding: str, data: bytes, size: Sequence[int]) -> NDArray[np.uint8]:
    try:
        # An image whose size differs from the one in the message is not decoded.
        image = decode_grey(data) if sorted(image_size(data)) == sorted(size) else None
    except InvalidValue as error:
        raise InvalidMessage(f"observation: no {encoding} image ({error})") from None
    if image is None or list(image.shape) != list(size):
        raise InvalidMessage(f"observation: no {encoding} image of {size[1]}x{size[0]} px")
    return image
