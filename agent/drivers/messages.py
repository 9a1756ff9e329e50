"""Messages between an agent and a robot base in another process: MessagePack, validated field by field.

    describe    question: empty; answer: RobotDescription
    step        question: StepRequest; answer: Observation

A base refuses with a reason. Two reasons are part of the protocol: ENDED and AGAIN.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.observation import Command, Observation, Odometry, RobotDescription
from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.storage.image_file import decode_grey, image_size
from mapweave.wire.packing import MAX_NUMBER, MAX_STAMP_NS, Reader, pack
from mapweave.wire.pose_codec import pack_camera, unpack_camera

ENDED = "the simulation has ended"
"""Refusal: there will be no more observations, and that is no failure."""

AGAIN = "ask again later"
"""A refusal that contains this is answered by asking the same again (the bus says so when it is full)."""

MAX_IMAGE_BYTES = 16 * 2**20
MAX_SIDE_PX = 16384
MAX_RANGERS = 256
MAX_SMALL_BYTES = 16384
"""Longest message without an image."""

FARTHEST = 1e4
"""No ranger reaches farther, m."""
MOST_WAY = 10.0
"""No robot drives farther between two observations, m: 3 m/s over the longest silence before a question is
asked again."""
MOST_TURN = 20.0
"""Nor does it turn by more, rad: a turn a second over the same time."""
FASTEST = 1e3
"""No robot drives or turns faster, m/s and rad/s."""

RAW = "raw"
COMPRESSED = ("jpeg", "png")


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


def encode_step(step: StepRequest) -> bytes:
    """Encode a step."""
    return pack({"q": step.sequence, "c": [step.command.forward, step.command.turn]})


def decode_step(data: bytes) -> StepRequest:
    """Decode a step.

    Raises:
        InvalidMessage: anything is wrong with it.
    """
    reader = Reader(data, "step", MAX_SMALL_BYTES)
    forward, turn = _numbers(reader, "c", 2, 2, -FASTEST, FASTEST)
    return StepRequest(reader.integer("q", 1, MAX_NUMBER), Command(forward, turn))


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
    reader = Reader(data, "observation", MAX_IMAGE_BYTES + MAX_SMALL_BYTES)
    forward, turn = _numbers(reader, "u", 2, 2, -FARTHEST, FARTHEST)
    if abs(forward) > MOST_WAY or abs(turn) > MOST_TURN:
        raise reader.error(f"odometry of {forward:g} m and {turn:g} rad in one step is out of range")
    bumped = reader.any("b")
    if type(bumped) is not bool:
        raise reader.error("b must be true or false")
    return Observation(
        stamp_ns=reader.integer("t", 0, MAX_STAMP_NS),
        odometry=Odometry(forward, turn),
        image=_read_image(reader) if reader.has("i") else None,
        proximity=np.array(_numbers(reader, "r", 0, MAX_RANGERS, 0.0, FARTHEST)),
        bumped=bumped,
    )


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
    """Encode a description."""
    return pack(
        {
            "camera": pack_camera(description.camera),
            "distortion": list(description.distortion),
            "radius": description.radius,
            "axle": description.axle,
            "wheel_noise": description.wheel_noise,
            "side_slip": description.side_slip,
            "ranger_bearings": list(description.ranger_bearings),
            "ranger_reach": description.ranger_reach,
            "max_forward": description.max_forward,
            "max_turn": description.max_turn,
            "tick": description.tick,
        }
        | ({"clock": description.clock} if description.clock else {})
        | ({"ranges_see_robots": True} if description.ranges_see_robots else {})
    )


def decode_description(data: bytes) -> RobotDescription:
    """Decode a description.

    Raises:
        InvalidMessage: anything is wrong with it.
    """
    reader = Reader(data, "robot description", MAX_SMALL_BYTES)
    k1, k2, p1, p2, k3 = _numbers(reader, "distortion", 5, 5, -FARTHEST, FARTHEST)
    return RobotDescription(
        camera=unpack_camera(reader.binary("camera", MAX_SMALL_BYTES)),
        distortion=(k1, k2, p1, p2, k3),
        radius=reader.number("radius", 1e-3, 100.0),
        axle=reader.number("axle", 1e-3, 100.0),
        wheel_noise=reader.number("wheel_noise", 0.0, 1.0),
        side_slip=reader.number("side_slip", 0.0, 1.0) if reader.has("side_slip") else 0.005,
        ranger_bearings=tuple(_numbers(reader, "ranger_bearings", 0, MAX_RANGERS, -7.0, 7.0)),
        ranger_reach=reader.number("ranger_reach", 0.0, FARTHEST),
        max_forward=reader.number("max_forward", 0.0, FASTEST),
        max_turn=reader.number("max_turn", 0.0, FASTEST),
        tick=reader.number("tick", 1e-4, 3600.0),
        clock=reader.name("clock") if reader.has("clock") else "",
        ranges_see_robots=reader.has("ranges_see_robots") and reader.any("ranges_see_robots") is True,
    )


def _numbers(reader: Reader, name: str, least: int, most: int, low: float, high: float) -> list[float]:
    values = reader.array(name, most)
    if len(values) < least:
        raise reader.error(f"{name} must be a list of at least {least}")
    return [reader.as_number(value, name, low, high) for value in values]


def _read_image(reader: Reader) -> NDArray[np.uint8]:
    shape = [reader.as_integer(side, "s", 1, MAX_SIDE_PX) for side in reader.array("s", 2)]
    if len(shape) != 2:
        raise reader.error("s must be [height, width]")
    encoding = reader.text("encoding", 16)
    data = reader.binary("i", MAX_IMAGE_BYTES)
    if encoding == RAW:
        if len(data) != shape[0] * shape[1]:
            raise reader.error(f"a raw image of {shape[1]}x{shape[0]} px cannot have {len(data)} bytes")
        return np.frombuffer(data, np.uint8).reshape(shape)
    if encoding not in COMPRESSED:
        raise reader.error(f"image encoding {encoding!r} is not {', '.join((RAW, *COMPRESSED))}")
    if shape[0] * shape[1] > MAX_IMAGE_BYTES:
        raise reader.error(f"an image of {shape[1]}x{shape[0]} px is too large")
    return _decompress(reader, encoding, data, shape)


def _decompress(reader: Reader, encoding: str, data: bytes, shape: Sequence[int]) -> NDArray[np.uint8]:
    try:
        # An image whose size differs from the one in the message is not decoded.
        image = decode_grey(data) if sorted(image_size(data)) == sorted(shape) else None
    except InvalidValue as error:
        raise reader.error(f"no {encoding} image ({error})") from None
    if image is None or list(image.shape) != list(shape):
        raise reader.error(f"no {encoding} image of {shape[1]}x{shape[0]} px")
    return image
