"""Good input of every kind: what is mutated."""

import base64
import sqlite3
import tempfile
import zlib
from pathlib import Path

import cv2
import numpy as np

from benchmarks.fuzz.texts import CAMERA_TOML
from mapweave.agent.drivers.messages import StepRequest, encode_description, encode_observation, encode_step
from mapweave.agent.observation import Command, Observation, Odometry, RobotDescription
from mapweave.agent.recordings.camera_file import read_camera
from mapweave.agent.recordings.mcap_writer import McapWriter
from mapweave.agent.replication.journal import Journal
from mapweave.agent.ros_messages import making
from mapweave.hybridmap.annotation import Annotation, Place
from mapweave.hybridmap.change import Change, EdgePut, NodeRetired
from mapweave.hybridmap.constraint_subject import Apart, Linked
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.map_event import MapEvent, MapEventKind
from mapweave.hybridmap.node import EdgeKind, Node
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.pruned_node import PrunedNode
from mapweave.hybridmap.query import (
    Certainty,
    RelocalizeAnswer,
    RouteAnswer,
    RouteLeg,
    View,
    Whereabouts,
)
from mapweave.identities.key_folder import KeyFolder, Profile
from mapweave.mapserver.log.entry import ReceivedChange
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.mapserver.map_files import map_file_of
from mapweave.offline_merge import merge_parts
from mapweave.storage.map_file import MapFile, pack_map_file
from mapweave.wire.codec import encode_change
from mapweave.wire.credentials import Role
from mapweave.wire.messages import KeptHistory, KeptPruned, KeptPruning, encode, encode_view
from mapweave.wire.ros2.attachment import Attachment, encode_attachment
from mapweave.wire.ros2.messages import encode as encode_ros2
from mapweave.wire.ros2.messages import make
from synthetic.maps import changes_of
from synthetic.world import CAMERA, room, take_map, take_view


class Samples:
    """Made once; small, so that mutations hit something."""

    def __init__(self, seed: int) -> None:
        """Map a room twice, and write it in every form."""
        rng = np.random.default_rng(seed)
        world = room(0, 0, 5, 4, 300, rng)
        stops = [Pose2(2.4 + 0.05 * k, 2.0, 0.7 * k) for k in range(3)]
        self.map_id = MapId("r0", 1)
        nodes, edges = take_map(world, self.map_id, stops, rng)
        others, other_edges = take_map(world, MapId("r1", 1), stops, rng)
        self.bodies = changes_of(nodes, edges)
        self.changes = [Change(self.map_id, k + 1, 10**18 + k, body) for k, body in enumerate(self.bodies)]
        self.merged = merge_parts(
            {self.map_id: HybridMap(self.bodies), MapId("r1", 1): HybridMap(changes_of(others, other_edges))},
            ManualConstraints(),
        )
        self.map_files = [
            pack_map_file(MapFile("agent", "r0.1", tuple(self.bodies))),
            pack_map_file(map_file_of(self.merged)),
        ]  # fmt: skip
        self.view = take_view(world, stops[0], rng)[0]
        self.nodes: list[Node] = [*nodes, *others]

    def messages(self) -> dict[str, list[bytes]]:
        """Good messages by kind: those of a real map, and those that the examples of docs/wire.md lack."""
        a, b = self.nodes[0], self.nodes[-1]
        here = next(body.edge.a_from_b for body in self.bodies if isinstance(body, EdgePut))
        legs = (RouteLeg(a, here, None), RouteLeg(b, here, EdgeKind.LOOP))
        place = Whereabouts(a.id, here, here, 0, 20, 0.9)
        retired = Change(self.map_id, 99, 10**18, NodeRetired(a.id))
        event = MapEvent(10**18, MapEventKind.JOINED, "r0.1 and r1.1 are one map now")
        link = Linked(
            a.id, b.id, Pose2(0.5), (1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4), ((0, 1),), (("inliers", 9.0),)
        )
        left = PrunedNode(b.id, Pose2(1.0, 2.0, 0.5), 10**18)
        values = (
            RelocalizeAnswer(Certainty.FOUND, (place,), "seen"), RouteAnswer(legs, "the way"),
            ManualConstraint(Apart((a.id, b.id)), True, "anna", 5, "two kitchens"),
            Annotation("kitchen", Place(a.id), False, "anna", 10**18),
            KeptHistory(
                (event,), (frozenset({a.id.map, b.id.map}),), frozenset({(a.id.map, b.id.map)}),
                frozenset({a.id.map}), frozenset({(a.id, b.id)}), frozenset({(a.id, b.id)}),
                frozenset({b.id.map}), ((b.id.map, "2000 landmarks"),),
            ),
            KeptPruning((link,), ((a.id, b.id),), ((a.id, 5),), ((a.id, b.id, 5),), 10**18, 1),
            KeptPruned(((a.id, left),)),
        )  # fmt: skip
        return {
            "change": [encode_change(change) for change in (*self.changes, retired)],
            "view": [encode_view(View(self.view.pixels, self.view.codes, CAMERA))],
            **{type(value).__name__: [encode(value)] for value in values},
        }

    def keys(self) -> tuple[bytes, bytes]:
        """The list of a fleet's identities, with one that was revoked, and that of its tokens."""
        with tempfile.TemporaryDirectory() as folder:
            keys = KeyFolder.create(Path(folder), "demo", Profile.PRODUCTION, ["192.168.1.10"], "s0")
            keys.add("r0", Role.ROBOT)
            keys.add("anna", Role.OPERATOR)
            keys.token("anna", 30.0)
            keys.revoke("r0", "stolen")
            return (Path(folder) / "fleet.json").read_bytes(), (Path(folder) / "tokens.json").read_bytes()

    def bases(self) -> list[bytes]:
        """What a robot base and its driver say to each other."""
        image = np.arange(48 * 64, dtype=np.uint8).reshape(48, 64)
        seen = Observation(10**18, Odometry(0.01, 0.002), image, np.array([0.5, 1.0, 2.0]), True, 0.8)
        return [
            encode_observation(seen), encode_description(description()),
            encode_step(StepRequest(1, Command(0.1, 0.2))),
        ]  # fmt: skip

    def images(self) -> list[bytes]:
        """Small images of each kind."""
        grey = np.arange(48 * 64, dtype=np.uint8).reshape(48, 64)
        colour = np.dstack([grey, grey.T.reshape(48, 64), grey])
        return [
            cv2.imencode(kind, image)[1].tobytes()
            for kind in (".png", ".jpg", ".pgm", ".bmp", ".webp") for image in (grey, colour)
            if (kind, image.ndim) != (".pgm", 3)
        ]  # fmt: skip

    def viewers(self) -> list[bytes]:
        """What browsers send that look at the live view and say something: plain, compressed, nothing."""
        head = b"GET /live HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        head += b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: " + base64.b64encode(bytes(16)) + b"\r\n"
        plain = [_frame(1, b"hello"), _frame(2, bytes(200)), _frame(9, b"1"), _frame(8, b"\x03\xe8gone")]
        packed = zlib.compress(b"hello" * 20, wbits=-15)
        offer = b"Sec-WebSocket-Extensions: permessage-deflate; client_max_window_bits\r\n"
        return [
            head + b"\r\n" + b"".join(plain),
            head + b"Origin: http://127.0.0.1\r\n" + offer + b"\r\n" + _frame(0x41, packed),
            head.replace(b"/live", b"/live?token=a", 1) + b"Cookie: session=a; b=c\r\n\r\n",
        ]

    def store(self) -> bytes:
        """A server's store, as a file."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "s0.sqlite"
            store = SqliteStore(path)
            entries = [
                ReceivedChange(change.sequence, encode_change(change), change) for change in self.changes
            ]
            store.apply(self.map_id, 5, entries)
            store.close()
            return _whole_database(path)

    def journal(self) -> bytes:
        """A robot's journal, as a file."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "r0.sqlite"
            journal = Journal(path, "r0")
            map_id = journal.open_map(1)
            journal.append(map_id, self.bodies, 10**18)
            journal.close()
            return _whole_database(path)

    def ros2(self, kinds: tuple[str, ...]) -> list[bytes]:
        """ROS 2 messages as CDR; the number of its kind comes first."""
        now, at = making.header(10**18, "camera"), Pose2(1.0, 2.0, 0.3)
        pixels = np.arange(12, dtype=np.uint8)
        region = make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        twist = make(
            "geometry_msgs/msg/TwistWithCovariance", twist=making.twist(Command(0.1, 0.2)),
            covariance=np.zeros(36),
        )  # fmt: skip
        pose = make("geometry_msgs/msg/PoseWithCovariance", pose=making.pose(at), covariance=np.zeros(36))
        tree = [making.transform(10**18, "odom", "base_link", at)]
        values = {
            "Image": {"header": now, "height": 3, "width": 4, "encoding": "mono8", "is_bigendian": 0,
                      "step": 4, "data": pixels},
            "CompressedImage": {"header": now, "format": "png",
                                "data": np.frombuffer(self.images()[0], np.uint8)},
            "CameraInfo": {"header": now, "height": 48, "width": 64, "distortion_model": "plumb_bob",
                           "d": np.zeros(5), "k": np.array([60.0, 0, 32, 0, 60, 24, 0, 0, 1]),
                           "r": np.eye(3).ravel(), "p": np.zeros(12), "binning_x": 0, "binning_y": 0,
                           "roi": region},
            "Odometry": {"header": now, "child_frame_id": "base_link", "pose": pose, "twist": twist},
            "TFMessage": {"transforms": tree},
        }  # fmt: skip
        bodies = [encode_ros2(make(kind, **values[kind.rpartition("/")[2]])) for kind in kinds]
        attachment = encode_attachment(Attachment(1, 10**18, bytes(range(16))))
        return [bytes([k]) + body for k, body in enumerate([*bodies, attachment])]

    def recording(self) -> bytes:
        """A recording, one MCAP file."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "drive"
            writer = McapWriter(path, description())
            rng = np.random.default_rng(1)
            for k in range(4):
                image = rng.integers(0, 255, (48, 64), dtype=np.uint8)
                seen = Observation(10**18 + k * 10**8, Odometry(0.01, 0.0), image, np.ones(3))
                writer.write(seen, Command(0.1, 0.0))
            writer.close()
            (file,) = path.rglob("*.mcap")
            return file.read_bytes()


def description() -> RobotDescription:
    """A robot with three rangers and a small camera."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "camera.toml"
        path.write_text(CAMERA_TOML)
        camera, _ = read_camera(path)
    return RobotDescription(camera=camera, radius=0.12, axle=0.15, ranger_bearings=(0.8, 0.0, -0.8))


def _frame(kind: int, payload: bytes) -> bytes:
    """A frame of a WebSocket, by a browser, whose mask is zero.

    Args:
        kind: its opcode, and 0x40 if it is compressed.
        payload: at most 65535 bytes.
    """
    short = len(payload) < 126
    size = bytes([0x80 | len(payload)]) if short else b"\xfe" + len(payload).to_bytes(2, "big")
    return bytes([0x80 | kind]) + size + bytes(4) + payload


def _whole_database(path: Path) -> bytes:
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")
    connection.close()
    return path.read_bytes()
