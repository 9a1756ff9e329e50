"""ROS 2 over Zenoh against a second implementation, through a real router."""

import struct
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.errors import InvalidMessage, SettingsError
from mapweave.wire.ros2.attachment import Attachment, decode_attachment, encode_attachment
from mapweave.wire.ros2.keys import Endpoint, EndpointRole, RmwZenohKeys
from mapweave.wire.ros2.messages import decode, make, type_hash
from mapweave.wire.ros2.node import Arrival, Ros2Node
from mapweave.wire.ros2.settings import Ros2Link
from tests import ros2_peer as peer
from tests.ros2_peer import ANY_HASH, HASHES, Cdr, Reader, RosPeer
from tests.waiting import eventually
from tests.wire.fleets import ZenohFleet

STRING, TWIST, ODOMETRY = "std_msgs/msg/String", "geometry_msgs/msg/Twist", "nav_msgs/msg/Odometry"
IMAGE = "sensor_msgs/msg/Image"


def twist_message(forward: float, turn: float) -> Any:
    vector = "geometry_msgs/msg/Vector3"
    linear, angular = make(vector, x=forward, y=0.0, z=0.0), make(vector, x=0.0, y=0.0, z=turn)
    return make(TWIST, linear=linear, angular=angular)


@pytest.fixture
def router() -> Iterator[ZenohFleet]:
    fleet = ZenohFleet()
    yield fleet
    fleet.close()


@pytest.fixture
def ros(router: ZenohFleet) -> Iterator[RosPeer]:
    one = RosPeer(router.endpoints[0], domain=2)
    yield one
    one.close()


@pytest.fixture
def node(router: ZenohFleet) -> Iterator[Ros2Node]:
    one = Ros2Node(Ros2Link(router.endpoints[0], domain=2, namespace="/bot"), "mapweave")
    yield one
    one.close()


def test_keys_and_tokens_are_those_of_the_design_document():
    keys = RmwZenohKeys(Ros2Link(domain=2), "8b20917502ee955ac4476e0266340d5c", "talker")
    chatter = Endpoint("/chatter", STRING, HASHES[STRING])
    assert keys.messages(chatter) == f"2/chatter/std_msgs::msg::dds_::String_/{HASHES[STRING]}"
    assert keys.node() == "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/0/NN/%/%/talker"
    token = keys.token(EndpointRole.PUBLISHER, 10, chatter, False, 7)
    session = "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter"
    # Nothing is left out of the quality of service, for what is left out is the reader's default.
    assert token == f"{session}/std_msgs::msg::dds_::String_/{HASHES[STRING]}/1:2:1,7:,:,:,,"
    theirs = f"{session}/std_msgs::msg::dds_::String_/{HASHES[STRING]}/::,7:,:,:,,"
    assert keys.parse(theirs) == keys.parse(token) == chatter
    assert keys.parse(theirs.replace(HASHES[STRING], "TypeHashNotSupported")) is not None
    buffered = keys.parse(f"{theirs}/backends:cpu:;cuda:device%3A0")
    assert buffered == chatter
    assert buffered.backends
    assert keys.parse(f"{theirs}/backends:cpu:/more") is None
    for wrong in (
        theirs.replace("RIHS01_d", "RIHS01_*"),
        theirs.replace("::msg", "::srv"),
        theirs.rpartition("/")[0],
        "x",
    ):
        assert keys.parse(wrong) is None


@pytest.mark.parametrize("kind", HASHES)
def test_hashes_are_those_that_ros_prints(kind: str):
    assert type_hash(kind) == HASHES[kind]


@given(
    st.integers(-(2**63), 2**63 - 1), st.integers(-(2**63), 2**63 - 1), st.binary(min_size=16, max_size=16)
)
def test_attachments_have_33_bytes_and_both_forms_are_read(sequence: int, stamp_ns: int, gid: bytes):
    data = encode_attachment(Attachment(sequence, stamp_ns, gid))
    assert data == struct.pack("<qq", sequence, stamp_ns) + b"\x10" + gid
    named = b"\x0fsequence_number" + data[:8] + b"\x10source_timestamp" + data[8:16]
    named += b"\x0asource_gid" + data[16:]
    assert len(named) == 77
    assert decode_attachment(data) == decode_attachment(named) == Attachment(sequence, stamp_ns, gid)


@given(st.binary(max_size=90))
def test_other_attachments_are_refused(data: bytes):
    try:
        attachment = decode_attachment(data)
    except InvalidMessage:
        return
    assert encode_attachment(attachment) == data or len(data) == 77


def test_both_sides_see_and_hear_each_other(ros: RosPeer, node: Ros2Node):
    got: list[Arrival] = []
    twists = ros.subscriber("/bot/cmd_vel", TWIST)
    node.subscribe(node.link.topic("odom"), [ODOMETRY], got.append)
    command = node.publisher(node.link.topic("cmd_vel"), TWIST)
    odom = ros.publisher("/bot/odom", ODOMETRY)
    eventually(lambda: command.subscribers)
    message = twist_message(0.25, -0.5)

    def heard() -> bool:
        odom.publish(peer.odometry(1_700_000_000_123_456_789, 1.0, 2.0, 0.5), named=len(got) == 0)
        command.publish(message)
        return len(got) > 1 and bool(twists)

    eventually(heard)
    assert peer.twist(twists[0], False) == (0.25, -0.5)
    decoded = decode(got[0].kind, got[0].data)
    assert (decoded.header.stamp.sec, decoded.header.stamp.nanosec) == (1_700_000_000, 123_456_789)
    assert (decoded.pose.pose.position.x, decoded.pose.pose.position.y) == (1.0, 2.0)
    # Both forms of the attachment, one after the other.
    assert got[0].published_ns > 1e18
    assert got[1].published_ns > 1e18
    # What `ros2 node list` and `ros2 topic list` show, and a publisher that waits for subscribers.
    who = ["%", "%bot", "mapweave"]
    twist = ["%bot%cmd_vel", "geometry_msgs::msg::dds_::Twist_", HASHES[TWIST], "1:2:1,10:,:,:,,"]
    odometry = ["%bot%odom", "nav_msgs::msg::dds_::Odometry_", ANY_HASH, "1:2:1,10:,:,:,,"]
    wanted = [["NN", *who], ["MP", *who, *twist], ["MS", *who, *odometry]]

    def seen() -> bool:
        parts = [token.split("/")[5:] for token in ros.tokens() if ros.zid not in token]
        return all(one in parts for one in wanted)

    eventually(seen)
    assert not ros.failures


def test_late_subscribers_get_the_last_message(router: ZenohFleet, ros: RosPeer, node: Ros2Node):
    said = node.publisher("/chatter", STRING, latched=True)
    # No subscriber is there yet, perhaps not even a session.
    said.publish(make(STRING, data="first"))
    said.publish(make(STRING, data="last"))
    eventually(lambda: any("%chatter" in token for token in ros.tokens()))
    late = ros.subscriber("/chatter", STRING, latched=True)
    eventually(lambda: late)
    assert [Reader(data).text() for data in late] == ["last"]
    assert not ros.failures
    assert any(token.endswith(f"{HASHES[STRING]}/1:1:1,1:,:,:,,") for token in ros.tokens())
    # And the other way round.
    ros.publisher("/tf_static", STRING, latched=True).publish(Cdr().text("kept"))
    got: list[Arrival] = []
    node.subscribe("/tf_static", [STRING], got.append, latched=True)
    eventually(lambda: got)
    assert Reader(got[0].data).text() == "kept"


def test_humble_has_no_hashes(ros: RosPeer, node: Ros2Node):
    twists = ros.subscriber("/cmd_vel", TWIST, type_hash="TypeHashNotSupported")
    command = node.publisher("/cmd_vel", TWIST)
    eventually(lambda: command.subscribers)

    def heard() -> bool:
        command.publish(twist_message(0.0, 0.0))
        return bool(twists)

    eventually(heard)
    got: list[Arrival] = []
    node.subscribe("/range", ["sensor_msgs/msg/Range"], got.append)
    reading = ros.publisher("/range", "sensor_msgs/msg/Range", type_hash="TypeHashNotSupported")
    # Humble's Range has no variance.
    message = Cdr().header(5, "front").put("B", 1).put("f", 0.1, 0.02, 4.0, 1.5)

    def ranged() -> bool:
        reading.publish(message)
        return bool(got)

    eventually(ranged)
    assert decode(got[0].kind, got[0].data).range == 1.5


def test_images_of_lyrical_come_by_the_key_of_the_processors_memory(ros: RosPeer, node: Ros2Node):
    """Its tokens were not understood, and none of its images came; Twist and Odometry did."""
    got: list[Arrival] = []
    node.subscribe("/image_raw", [IMAGE], got.append)
    camera = ros.buffered_publisher("/image_raw", IMAGE)
    eventually(lambda: node.publishers([IMAGE]) == ["/image_raw"])

    def seen() -> bool:
        camera.publish(peer.image(5, 4, 2, "mono8", 4, bytes(range(8))))
        return bool(got)

    eventually(seen)
    assert bytes(decode(got[0].kind, got[0].data).data) == bytes(range(8))
    assert len({arrival.published_ns for arrival in got}) == len(got), "a message came twice"
    # Publishers of before give the same topic without backends, and are subscribed to without.
    ros.publisher("/image_raw", IMAGE)
    wanted = {(ANY_HASH, "1:2:1,10:,:,:,,", "backends:cpu:"), (ANY_HASH, "1:2:1,10:,:,:,,")}

    def announced() -> bool:
        tokens = [token.split("/") for token in ros.tokens() if "/MS/" in token and ros.zid not in token]
        return {tuple(token[11:]) for token in tokens} == wanted

    eventually(announced)
    assert not ros.failures


def test_a_message_of_another_type_is_named_and_not_decoded(ros: RosPeer, node: Ros2Node):
    got: list[Arrival] = []
    subscriber = node.subscribe("/odom", [ODOMETRY], got.append)
    ros.publisher("/odom", STRING).publish(Cdr().text("no odometry"))
    eventually(lambda: subscriber.refused)
    assert subscriber.refused == STRING
    assert not got


def test_a_bridge_has_plain_keys(router: ZenohFleet):
    bridge = RosPeer(router.endpoints[0], bridge="/bot1")
    node = Ros2Node(Ros2Link(router.endpoints[0], namespace="/bot1", bridge=True), "mapweave")
    try:
        got: list[Arrival] = []
        twists = bridge.subscriber("/cmd_vel", TWIST)
        node.subscribe(node.link.topic("/odom"), ["sensor_msgs/msg/JointState", ODOMETRY], got.append)
        command = node.publisher(node.link.topic("cmd_vel"), TWIST)
        odom = bridge.publisher("/odom", ODOMETRY)
        eventually(lambda: command.subscribers)
        eventually(lambda: node.publishers([ODOMETRY]) == ["/bot1/odom"])

        def heard() -> bool:
            odom.publish(peer.odometry(5, 1.0, 2.0, 0.5))
            command.publish(twist_message(0.0, 0.0))
            return bool(got) and bool(twists)

        eventually(heard)
        assert command.keys == ["bot1/cmd_vel"]
        assert got[-1].kind == ODOMETRY
    finally:
        node.close()
        bridge.close()


def test_either_byte_order_is_read_and_the_second_version_of_cdr_refused():
    """A bridge hands on what its DDS writers send: plain CDR or XCDR2, which aligns doubles to 4 bytes."""
    values = (0.25, 0.0, 0.0, 0.0, 0.0, -0.5)
    for order, representation in ((">", b"\0\0"), ("<", b"\0\1")):
        twist = decode(TWIST, representation + b"\0\0" + struct.pack(f"{order}6d", *values))
        assert (twist.linear.x, twist.angular.z) == (0.25, -0.5)
    for representation in (b"\0\6", b"\0\7", b"\0\3", b"\0\x0b"):
        with pytest.raises(InvalidMessage, match="52 bytes are no geometry_msgs/msg/Twist"):
            decode(TWIST, representation + b"\0\0" + struct.pack("<6d", *values))


def test_a_link_refuses_what_is_no_name(monkeypatch):
    for wrong in ({"endpoint": "127.0.0.1"}, {"namespace": "/a b"}, {"namespace": "/1st"}):
        with pytest.raises(SettingsError):
            Ros2Link(**wrong)  # type: ignore[arg-type]
    with pytest.raises(SettingsError, match="no ROS name"):
        Ros2Link().topic("camera/*")
    assert Ros2Link(namespace="bot/").topic("odom") == "/bot/odom"
    assert Ros2Link(namespace="/bot").topic("/tf") == "/tf"
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    assert Ros2Link().domain_id() == 7
    monkeypatch.setenv("ROS_DOMAIN_ID", "seven")
    with pytest.raises(SettingsError, match="0 to 232"):
        Ros2Link().domain_id()
