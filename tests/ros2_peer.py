"""A second implementation of ROS 2 over Zenoh, from the design document of rmw_zenoh and the bridge's manual.

It shares no code with the product. Its session is a peer, as those of ROS 2 processes are, and it is as
strict as they are: what arrives without a valid attachment is a failure.
"""

from __future__ import annotations

import json
import struct
import threading
import time
from typing import Any

import zenoh
import zenoh.ext

HASHES = {
    "std_msgs/msg/String": "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "geometry_msgs/msg/Twist": "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
}
"""Of the demos and of `ros2 topic info -v`; of other types any hash will do, for a publisher chooses it."""
ANY_HASH = "RIHS01_" + "5a" * 32


class Cdr:
    """Writes CDR, little-endian: each number is aligned to its size."""

    def __init__(self) -> None:
        self.data = bytearray()

    def put(self, form: str, *values: Any) -> Cdr:
        size = struct.calcsize(form)
        for value in values:
            self.data += bytes(-len(self.data) % size) + struct.pack("<" + form, value)
        return self

    def text(self, text: str) -> Cdr:
        self.put("I", len(text) + 1)
        self.data += text.encode() + b"\0"
        return self

    def many(self, form: str, values: Any) -> Cdr:
        return self.put("I", len(values)).put(form, *values)

    def raw(self, data: bytes) -> Cdr:
        self.put("I", len(data))
        self.data += data
        return self

    def header(self, stamp_ns: int, frame: str) -> Cdr:
        return self.put("i", stamp_ns // 10**9).put("I", stamp_ns % 10**9).text(frame)

    def bytes(self) -> bytes:
        return b"\x00\x01\x00\x00" + bytes(self.data)


class Reader:
    """Reads CDR."""

    def __init__(self, data: bytes) -> None:
        assert data[:4] == b"\x00\x01\x00\x00"
        self.data, self.at = data[4:], 0

    def get(self, form: str) -> Any:
        size = struct.calcsize(form)
        self.at += -self.at % size
        (value,) = struct.unpack_from("<" + form, self.data, self.at)
        self.at += size
        return value

    def several(self, form: str, count: int) -> list[Any]:
        return [self.get(form) for _ in range(count)]

    def text(self) -> str:
        size = self.get("I")
        text = self.data[self.at : self.at + size - 1].decode()
        self.at += size
        return text

    def header(self) -> tuple[int, str]:
        seconds, nanoseconds = self.get("i"), self.get("I")
        return seconds * 10**9 + nanoseconds, self.text()


def dds(kind: str) -> str:
    package, _, name = kind.split("/")
    return f"{package}::msg::dds_::{name}_"


class RosPeer:
    """A ROS 2 process of one node, or a bridge.

    Attributes:
        failures: why a ROS 2 process would have ended by now.
    """

    def __init__(self, endpoint: str, domain: int = 0, bridge: str | None = None) -> None:
        config = zenoh.Config()
        values = {
            "mode": "peer",
            "connect/endpoints": [endpoint],
            "connect/exit_on_failure": False,
            "connect/timeout_ms": -1,
            "connect/retry": {"period_init_ms": 50, "period_max_ms": 200, "period_increase_factor": 2},
            "listen/endpoints": ["tcp/127.0.0.1:0"],
            "scouting/multicast/enabled": False,
            "scouting/delay": 1,
            "timestamping/enabled": True,
        }
        for path, value in values.items():
            config.insert_json5(path, json.dumps(value))
        self.session = zenoh.open(config)
        self.zid = str(self.session.zid())
        self.domain, self.bridge = domain, bridge
        self.failures: list[str] = []
        self._held: list[Any] = []
        self._count = 0
        self._lock = threading.Lock()
        if bridge is None:
            self._token(f"@ros2_lv/{domain}/{self.zid}/0/0/NN/%/%/robot")

    def key(self, topic: str, kind: str, type_hash: str) -> str:
        if self.bridge is not None:
            return f"{self.bridge}{topic}".strip("/")
        return f"{self.domain}{topic}/{dds(kind)}/{type_hash}"

    def publisher(self, topic: str, kind: str, latched: bool = False, type_hash: str = "") -> Publisher:
        type_hash = type_hash or HASHES.get(kind, ANY_HASH)
        self.announce("MP", topic, kind, type_hash, ":1:,1:,:,:,," if latched else "::,10:,:,:,,")
        publisher = Publisher(self, self.key(topic, kind, type_hash), latched)
        self._held.append(publisher)
        return publisher

    def buffered_publisher(self, topic: str, kind: str) -> BufferedPublisher:
        """A publisher of a type with a byte array, of rmw_zenoh_cpp 0.10.5 (Lyrical) and later."""
        self.announce("MP", topic, kind, ANY_HASH, "2::,5:,:,:,,/backends:cpu:")
        return BufferedPublisher(self, topic, kind)

    def subscriber(self, topic: str, kind: str, type_hash: str = "", latched: bool = False) -> list[bytes]:
        """Messages as they come, without those that would end a ROS 2 process."""
        got: list[bytes] = []
        sequences: dict[bytes, int] = {}

        def receive(sample: zenoh.Sample) -> None:
            attachment = sample.attachment.to_bytes() if sample.attachment is not None else b""
            if self.bridge is None:
                if len(attachment) != 33 or attachment[16] != 16:
                    self.failures.append(f"{sample.key_expr}: attachment of {len(attachment)} bytes")
                    return
                sequence, stamp = struct.unpack("<qq", attachment[:16])
                gid = attachment[17:]
                if sequence <= sequences.get(gid, 0) or abs(stamp - time.time_ns()) > 60e9:
                    self.failures.append(f"{sample.key_expr}: message {sequence} of {stamp}")
                sequences[gid] = sequence
            got.append(sample.payload.to_bytes())

        type_hash = type_hash or HASHES.get(kind, ANY_HASH)
        key = self.key(topic, kind, type_hash)
        if latched:
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
            self._held.append(
                zenoh.ext.declare_advanced_subscriber(self.session, key, receive, history=history)
            )
        else:
            self._held.append(self.session.declare_subscriber(key, receive))
        self.announce("MS", topic, kind, type_hash, "::,10:,:,:,,")
        return got

    def announce(self, role: str, topic: str, kind: str, type_hash: str, qos: str) -> None:
        self._count += 1
        if self.bridge is None:
            name = topic.replace("/", "%")
            who = f"{self.zid}/0/{self._count}/{role}/%/%/robot"
            self._token(f"@ros2_lv/{self.domain}/{who}/{name}/{dds(kind)}/{type_hash}/{qos}")
        else:
            name = self.key(topic, kind, "").replace("/", "§")
            # No key, reliable, volatile, keep last 10 by the numbers of DDS, and the type's hash since Iron.
            dds_qos = f":1:0:0,10:typehash={type_hash};"
            self._token(f"@/{self.zid}/@ros2_lv/{role}/{name}/{kind.replace('/', '§')}/{dds_qos}")

    def tokens(self) -> list[str]:
        """What `ros2 topic list` and `ros2 node list` are made of."""
        replies = self.session.liveliness().get(f"@ros2_lv/{self.domain}/**")
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

    def close(self) -> None:
        self.session.close()  # type: ignore[no-untyped-call]

    def _token(self, key: str) -> None:
        self._held.append(self.session.liveliness().declare_token(key))


class Publisher:
    def __init__(self, peer: RosPeer, key: str, latched: bool) -> None:
        self._bridge, self._sequence = peer.bridge is not None, 0
        self._gid = bytes(range(16))
        self._publisher: Any = (
            zenoh.ext.declare_advanced_publisher(
                peer.session, key, cache=zenoh.ext.CacheConfig(1), publisher_detection=True
            )
            if latched
            else peer.session.declare_publisher(key)
        )

    def undeclare(self) -> None:
        self._publisher.undeclare()

    def _put(self, payload: bytes, attachment: bytes | None) -> None:
        self._publisher.put(payload, attachment=attachment)

    def publish(self, message: Cdr, stamp_ns: int = 0, named: bool = False) -> None:
        """Publish; `named` is the attachment of rmw_zenoh_cpp 0.2.0 to 0.2.3."""
        self._sequence += 1
        numbers = [struct.pack("<q", value) for value in (self._sequence, stamp_ns or time.time_ns())]
        values = [*numbers, bytes([16]) + self._gid]
        if named:
            names = (b"sequence_number", b"source_timestamp", b"source_gid")
            values = [bytes([len(n)]) + n + v for n, v in zip(names, values, strict=True)]
        attachment = None if self._bridge else b"".join(values)
        self._put(message.bytes(), attachment)


class BufferedPublisher(Publisher):
    """Puts each message where the tokens of its subscribers want it.

    Those that announce the backend "cpu" alone share one key; each of the others has a key of its own, to
    which it alone subscribes. The key of the topic itself stays unused.
    """

    def __init__(self, peer: RosPeer, topic: str, kind: str) -> None:
        key = peer.key(topic, kind, ANY_HASH)
        super().__init__(peer, f"{key}/_buf_cpu", False)
        self._peer, self._topic, self._key = peer, topic.replace("/", "%"), key

    def _put(self, payload: bytes, attachment: bytes | None) -> None:
        tokens = [token.split("/") for token in self._peer.tokens()]
        subscribers = [t for t in tokens if t[5] == "MS" and t[9] == self._topic and t[11] == ANY_HASH]
        if any(len(token) == 14 and token[13] == "backends:cpu:" for token in subscribers):
            super()._put(payload, attachment)
        for number in range(sum(len(token) == 13 for token in subscribers)):
            self._peer.session.put(f"{self._key}/_buf/{number:032x}", payload, attachment=attachment)


# The messages that a robot publishes.


def odometry(stamp_ns: int, x: float, y: float, heading: float) -> Cdr:
    import math

    out = Cdr().header(stamp_ns, "odom").text("base_footprint").put("d", x, y, 0.0)
    out.put("d", 0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2)).put("d", *[0.0] * 36)
    return out.put("d", *[0.0] * 6).put("d", *[0.0] * 36)


def image(stamp_ns: int, width: int, height: int, encoding: str, step: int, data: bytes) -> Cdr:
    out = Cdr().header(stamp_ns, "camera_optical_frame").put("I", height, width).text(encoding)
    return out.put("B", 0).put("I", step).raw(data)


def compressed(stamp_ns: int, form: str, data: bytes) -> Cdr:
    return Cdr().header(stamp_ns, "camera_optical_frame").text(form).raw(data)


def camera_info(
    stamp_ns: int, width: int, height: int, focal: float, lens: tuple[float, ...] = (0.0,) * 5,
    model: str = "plumb_bob", centre: tuple[float, float] | None = None,
) -> Cdr:  # fmt: skip
    cx, cy = centre or (width / 2, height / 2)
    out = Cdr().header(stamp_ns, "camera_optical_frame").put("I", height, width).text(model).many("d", lens)
    out.put("d", focal, 0, cx, 0, focal, cy, 0, 0, 1).put("d", 1, 0, 0, 0, 1, 0, 0, 0, 1)
    out.put("d", focal, 0, cx, 0, 0, focal, cy, 0, 0, 0, 1, 0)
    return out.put("I", 0, 0).put("I", 0, 0, 0, 0).put("B", 0)


def transforms(*all_of_them: tuple[int, str, str, tuple[float, ...], tuple[float, ...]]) -> Cdr:
    """Of (stamp_ns, parent, child, (x, y, z), (qx, qy, qz, qw))."""
    out = Cdr().put("I", len(all_of_them))
    for stamp_ns, parent, child, at, turn in all_of_them:
        out.header(stamp_ns, parent).text(child).put("d", *at).put("d", *turn)
    return out


def scan(
    stamp_ns: int, frame: str, begin: float, step: float, nearest: float, farthest: float, ranges: Any
) -> Cdr:
    out = Cdr().header(stamp_ns, frame)
    out.put("f", begin, begin + step * (len(ranges) - 1), step, 0.0, 0.1, nearest, farthest)
    return out.many("f", ranges).many("f", [])


def range_reading(stamp_ns: int, frame: str, nearest: float, farthest: float, distance: float) -> Cdr:
    out = Cdr().header(stamp_ns, frame).put("B", 1)
    return out.put("f", 0.1, nearest, farthest, distance, 0.0)


def joint_states(stamp_ns: int, names: list[str], positions: list[float]) -> Cdr:
    out = Cdr().header(stamp_ns, "").put("I", len(names))
    for name in names:
        out.text(name)
    return out.many("d", positions).many("d", []).many("d", [])


def wheel_ticks(stamp_ns: int, left: int, right: int) -> Cdr:
    return Cdr().header(stamp_ns, "base_link").put("i", left, right)


def kidnap_status(stamp_ns: int, kidnapped: bool) -> Cdr:
    return Cdr().header(stamp_ns, "base_link").put("B", kidnapped)


def battery_state(stamp_ns: int, percentage: float) -> Cdr:
    out = Cdr().header(stamp_ns, "").put("f", 14.4, 25.0, -0.8, 1.0, 2.0, 2.6, percentage)
    return out.put("B", 2, 1, 2, 1).many("f", []).many("f", []).text("").text("")


def hazards(stamp_ns: int, kinds: list[int]) -> Cdr:
    out = Cdr().header(stamp_ns, "base_link").put("I", len(kinds))
    for kind in kinds:
        out.header(stamp_ns, "bump_front_center").put("B", kind)
    return out


def ir_intensity(stamp_ns: int, readings: list[tuple[str, int]]) -> Cdr:
    out = Cdr().header(stamp_ns, "base_link").put("I", len(readings))
    for frame, value in readings:
        out.header(stamp_ns, frame).put("h", value)
    return out


def twist(data: bytes, stamped: bool) -> tuple[float, float]:
    """Speed and turn rate of a Twist or TwistStamped."""
    reader = Reader(data)
    if stamped:
        reader.header()
    x, y, z, roll, pitch, yaw = reader.several("d", 6)
    assert (y, z, roll, pitch) == (0.0, 0.0, 0.0, 0.0)
    return x, yaw
