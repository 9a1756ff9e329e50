"""What is fuzzed: each decoder with good samples, and what must hold of what it takes.

A target returns if it takes the input, and raises a MapweaveError if it refuses it. Anything else is a crash.
What it takes must be valid: numbers are finite, and what is encoded again is the same; `AcceptedInvalid` says
that it is not.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from benchmarks.fuzz import cluster_messages, server_files
from benchmarks.fuzz.recordings import RECORDINGS, RecordingTarget
from benchmarks.fuzz.texts import (
    CAMERA_TOML,
    FORM,
    G2O,
    KEY,
    NAV2_MAP,
    PLACE,
    PLAN_FORM,
    RETIRE,
    ROBOT_TOML,
    TUM,
    UNMERGE,
    WORLD_TOML,
)
from mapweave.agent.drivers.arduino import parse_state
from mapweave.agent.drivers.koala import parse_numbers
from mapweave.agent.drivers.messages import decode_description, decode_observation, decode_step
from mapweave.agent.drivers.waveshare import parse_info
from mapweave.agent.recordings.camera_file import read_camera
from mapweave.agent.recordings.opening import open_recording
from mapweave.agent.recordings.pose_files import read_poses
from mapweave.agent.replication.journal import Journal
from mapweave.agent.ros_messages.images import grey_of
from mapweave.agent.ros_messages.values import camera_of, pose_of
from mapweave.formats.g2o import read_g2o
from mapweave.hybridmap.constraint_subject import read_end
from mapweave.hybridmap.errors import InvalidMessage, MapweaveError
from mapweave.hybridmap.ids import NAME
from mapweave.identities.key_file import read_key_file
from mapweave.identities.key_folder import KeyFolder
from mapweave.identities.tokens import read_tokens
from mapweave.mapserver.http.form import read_photo
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.settings import load_settings
from mapweave.sim.worlds.file import load_world
from mapweave.storage.image_file import decode_grey
from mapweave.storage.map_file import pack_map_file, unpack_map_file
from mapweave.storage.nav2_map import parse_nav2_map
from mapweave.wire import messages
from mapweave.wire.codec import decode_change, encode_change
from mapweave.wire.credentials import Credentials, Role
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import (
    Ack,
    Head,
    KeptNodes,
    LogAnswer,
    LogRequest,
    Mark,
    NewestMap,
    decode_record,
)
from mapweave.wire.messages import LIMITS, decode_view, encode_view
from mapweave.wire.pose_messages import PoseNews
from mapweave.wire.refusal import decode_refusal
from mapweave.wire.ros2.attachment import decode_attachment
from mapweave.wire.ros2.messages import decode as decode_ros2
from mapweave.wire.zenoh_config import session_values

if TYPE_CHECKING:
    from benchmarks.fuzz.http_application import HttpApplication
    from benchmarks.fuzz.samples import Samples

WIRE_VECTORS = Path(__file__).parents[2] / "docs" / "wire_vectors.json"
ROS2_KINDS = (
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/CameraInfo",
    "nav_msgs/msg/Odometry",
    "tf2_msgs/msg/TFMessage",
)


class AcceptedInvalid(Exception):
    """A decoder has taken what is not valid."""


@dataclass(frozen=True)
class Target:
    """One decoder.

    Attributes:
        run: decodes bytes; may use a folder that is its own.
        samples: good input.
        most: longest input, bytes.
    """

    run: Callable[[bytes, Path], object]
    samples: Callable[[Samples], list[bytes]]
    most: int = 8192


DECODERS: dict[str, Callable[[bytes], Any]] = {
    "change": decode_change, "view": decode_view, "flat record": decode_record, "attachment": Mark.decode,
    "beacon": Head.decode, "acknowledgement": Ack.decode, "newest map": NewestMap.decode,
    "kept nodes": KeptNodes.decode, "log question": LogRequest.decode, "log answer": LogAnswer.decode,
    "merged poses": lambda body: PoseNews.decode(body, "r0"), "refusal": decode_refusal,
    **{kind.__name__: partial(messages.decode, kind=kind) for kind in LIMITS},
}  # fmt: skip
"""Of messages, by the words of docs/wire.md."""


def _messages(data: bytes, _: Path) -> None:
    """The first byte chooses the kind."""
    if not data:
        return
    name = [*DECODERS][data[0] % len(DECODERS)]
    value = DECODERS[name](data[1:])
    check_finite(value)
    if type(value) in LIMITS:
        check_again(value, messages.encode, lambda body: messages.decode(body, type(value)))
    elif name == "change":
        check_again(value, encode_change, decode_change)
    elif name == "view":
        check_again(value, encode_view, decode_view)


def _messages_samples(samples: Samples) -> list[bytes]:
    """Good messages of every kind: the examples of docs/wire.md, and what they lack."""
    good = samples.messages()
    for example in json.loads(WIRE_VECTORS.read_text()):
        good.setdefault(example["what"], []).append(bytes.fromhex(example["hex"]))
    return [bytes([k]) + body for k, name in enumerate(DECODERS) for body in good[name]]


def _map_file(data: bytes, _: Path) -> None:
    content = unpack_map_file(data)
    check_finite(content)
    check_again(content, pack_map_file, unpack_map_file)


def _base(data: bytes, _: Path) -> None:
    for decode in (decode_observation, decode_description, decode_step):
        try:
            check_finite(decode(data), nan_allowed=True)
        except InvalidMessage:
            continue


def _lines(data: bytes, _: Path) -> None:
    """What comes over a serial line, and names that people and peers write."""
    text = data.decode("ascii", "replace")
    for numbers in (parse_numbers(text), parse_state(text)):
        if numbers is not None and any(abs(number) > 10**10 for number in numbers):
            raise AcceptedInvalid(f"a number of {max(numbers)}")
    parse_info(text)
    keys = Keys("demo")
    parse: Callable[[str], object]
    for parse in (
        read_end, keys.parse_change, keys.parse_head, keys.parse_ack, keys.parse_poses,
        keys.parse_agent_status, keys.parse_robot_driver,
    ):  # fmt: skip
        try:
            found = str(parse(text))
        except MapweaveError:
            continue
        if "/" in found or ".." in found:
            raise AcceptedInvalid(f"the name {found!r}")


def _ros2(data: bytes, _: Path) -> None:
    if not data:
        return
    number = data[0] % (len(ROS2_KINDS) + 1)
    if number == len(ROS2_KINDS):
        decode_attachment(data[1:])
        return
    message = decode_ros2(ROS2_KINDS[number], data[1:])
    for read in (grey_of, pose_of, camera_of):
        try:
            read(message)
        except (MapweaveError, AttributeError):  # another kind of message has other fields
            continue


def _image(data: bytes, _: Path) -> None:
    image = decode_grey(data)
    if image.dtype != np.uint8 or image.ndim != 2 or not image.size:
        raise AcceptedInvalid(f"an image of {image.dtype}, {image.shape}")


def _photo(data: bytes, _: Path) -> None:
    photo = read_photo("multipart/form-data; boundary=b", data, {})
    photo.check()
    check_finite(photo.view().camera)


@cache
def application() -> HttpApplication:
    from benchmarks.fuzz.http_application import HttpApplication

    return HttpApplication()


def _http(data: bytes, _: Path) -> None:
    status = application().answer(data)
    if status >= HTTPStatus.INTERNAL_SERVER_ERROR and status != HTTPStatus.SERVICE_UNAVAILABLE:
        raise RuntimeError(f"HTTP {status}")


def _live(data: bytes, _: Path) -> None:
    application().watch(data)


def _plans(data: bytes, folder: Path) -> None:
    """An upload: the image of a floor plan, or a form of it and a map.yaml."""
    _http(b"POST /plans multipart/form-data; boundary=b\n" + data, folder)


def _nav2_map(data: bytes, folder: Path) -> None:
    check_finite(parse_nav2_map(data, folder / "map.yaml"))


def _fleet_file(path: Path) -> None:
    """The list of a fleet's identities, and the rules of its router."""
    folder = KeyFolder(path.parent)
    check_finite(folder.catalogue)
    for identity in folder.catalogue.identities:
        _ = identity.state
        if not NAME.fullmatch(identity.name):
            raise AcceptedInvalid(f"the name {identity.name!r}")
    session_values(folder.router("s0", own=Credentials("s0", Role.SERVER, password="secret")))


def _tokens(path: Path) -> None:
    for token in read_tokens(path.parent):
        _ = token.expired


def _file(name: str, read: Callable[[Path], object]) -> Callable[[bytes, Path], None]:
    def run(data: bytes, folder: Path) -> None:
        path = folder / name
        path.write_bytes(data)
        path.chmod(0o600)
        read(path)

    return run


def _read_store(path: Path) -> None:
    store = SqliteStore(path)
    try:
        for map_id in store.maps():
            store.watermark(map_id)
            store.refusals(map_id)
            for change in store.replay(map_id):
                check_finite(change)
        store.constraints()
        store.traffic()
    finally:
        store.close()


def _read_journal(path: Path) -> None:
    journal = Journal(path)
    try:
        for map_id in journal.maps():
            for body in journal.replay(map_id):
                check_finite(body)
            for entry in journal.entries(map_id):
                check_finite(entry)
        journal.missions()
    finally:
        journal.close()


def _read_recording(path: Path) -> None:
    recording = open_recording(path)
    for number in range(min(len(recording.stamps_ns), 3)):
        recording.read(number)


def _of_recordings(recordings: RecordingTarget) -> Target:
    return Target(recordings.run, lambda _: recordings.samples(), 65536)


def check_again(value: Any, encode: Callable[[Any], bytes], decode: Callable[[bytes], Any]) -> None:
    """What was taken can be sent on, and is the same."""
    try:
        once = encode(value)
        twice = encode(decode(once))
    except MapweaveError as error:
        raise AcceptedInvalid(f"it cannot be encoded again: {error}") from error
    if once != twice:
        raise AcceptedInvalid("encoded again it is another one")


def check_finite(value: Any, nan_allowed: bool = False) -> None:
    """Raise AcceptedInvalid if a number in a value is not finite."""
    left, seen = [value], 0
    while left and seen < 100_000:
        item, seen = left.pop(), seen + 1
        if isinstance(item, float) and not math.isfinite(item) and not (nan_allowed and math.isnan(item)):
            raise AcceptedInvalid(f"{item} in a {type(value).__name__}")
        if isinstance(item, np.ndarray) and item.dtype.kind == "f":
            # In arrays a missing reading or depth is NaN.
            if np.isinf(item).any():
                raise AcceptedInvalid(f"inf in an array of a {type(value).__name__}")
        elif dataclasses.is_dataclass(item) or isinstance(item, msgspec.Struct):
            names = item.__struct_fields__ if isinstance(item, msgspec.Struct) else [
                field.name for field in dataclasses.fields(item)
            ]  # fmt: skip
            left += [getattr(item, name) for name in names]
        elif isinstance(item, Mapping):
            left += item.values()
        elif isinstance(item, tuple | list | frozenset):
            left += item


TARGETS: dict[str, Target] = {
    "messages": Target(_messages, _messages_samples),
    "checksummed": Target(server_files.run_checksummed, server_files.checksummed_samples, 65536),
    "shown": Target(server_files.run_shown, server_files.shown_samples),
    "learned": Target(_file("r0.learned.toml", server_files.run_learned), server_files.learned_samples),
    "views": Target(server_files.run_view, server_files.view_samples, 16384),
    "cluster": Target(cluster_messages.run, lambda _: cluster_messages.cluster_messages().samples, 65536),
    "map_file": Target(_map_file, lambda s: s.map_files, 65536),
    "bases": Target(_base, lambda s: s.bases()),
    "lines": Target(_lines, lambda _: [b"1,2,3", b"S 1 2 0 50 -1", b'{"T":1001,"L":0.1,"R":0.1}', b"r0.1.17",
                                       b"mapweave/1/demo/agent/r0/change/1"], 300),
    "ros2": Target(_ros2, lambda s: s.ros2(ROS2_KINDS)),
    "images": Target(_image, lambda s: s.images(), 16384),
    "photos": Target(_photo, lambda s: [FORM % image for image in s.images()[:4]], 16384),
    "http": Target(_http, lambda s: [
        b"GET /status", b"GET /explain?a=r0.1&b=r1.1", b"GET /route?a=r0.1.1&b=r1.1.5",
        b"POST /relocalize\n" + s.images()[0], b"POST /robots/r0/go?goal=r0.1.1",
        b"GET /static/../web.py", b"POST /stop", b"GET /history", b"GET /missions", b"GET /map",
        b"POST /relocalize?hfov=60 image/jpeg\n" + s.images()[2], b"POST /stop application/json\n{}",
        b"POST /relocalize multipart/form-data; boundary=b\n" + FORM % s.images()[0],
        b"POST /plans application/octet-stream\n" + s.images()[0],
        b"POST /plans application/x-www-form-urlencoded\nimage=a", b"POST /constraints text/plain\n{}",
        b"POST /constraints application/json; charset=utf-16\n" + UNMERGE.encode("utf-16"),
        b"POST /constraints application/json\n" + UNMERGE.encode(),
        b"POST /constraints application/json\n" + RETIRE.encode(),
        b"POST /annotations application/json\n" + PLACE.encode(), b'POST /login\n{"token": "mw_a"}']),
    "plans": Target(_plans, lambda s: [PLAN_FORM % s.images()[0], FORM % s.images()[0]], 16384),
    "live": Target(_live, lambda s: s.viewers()),
    "nav2_map": Target(_nav2_map, lambda _: [NAV2_MAP]),
    "world": Target(_file("world.toml", load_world), lambda _: [WORLD_TOML.encode()]),
    "fleet_file": Target(_file("fleet.json", _fleet_file), lambda s: [s.keys()[0]]),
    "tokens": Target(_file("tokens.json", _tokens), lambda s: [s.keys()[1]]),
    **{name: _of_recordings(recordings) for name, recordings in RECORDINGS.items()},
    "store": Target(_file("s0.sqlite", _read_store), lambda s: [s.store()], 131072),
    "journal": Target(_file("r0.sqlite", _read_journal), lambda s: [s.journal()], 131072),
    "recording": Target(_file("drive.mcap", _read_recording), lambda s: [s.recording()], 65536),
    "poses": Target(_file("poses.txt", read_poses), lambda _: [TUM]),
    "g2o": Target(_file("graph.g2o", read_g2o), lambda _: [G2O]),
    "settings": Target(_file("robot.toml", load_settings), lambda _: [ROBOT_TOML.encode()]),
    "camera": Target(_file("camera.toml", read_camera), lambda _: [CAMERA_TOML.encode()]),
    "key": Target(_file("r0.key.toml", read_key_file), lambda _: [KEY]),
}  # fmt: skip
