"""What a map server takes of a robot as the image of a node, and passes on."""

import struct
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait

import cv2
import numpy as np
import pytest

from mapweave.hybridmap.errors import Busy, InvalidValue
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.view_image import MAX_BYTES, ViewImage, ViewRequest
from mapweave.mapserver import node_views
from mapweave.mapserver.node_views import NodeViews, NoView
from mapweave.wire.bus import Request
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.messages import decode, encode
from mapweave.wire.packing import pack
from synthetic.world import CAMERA
from tests.mapserver.stub_services import picture, two_maps
from tests.waiting import eventually

KEYS = Keys("fleet")
NODE, OTHER = NodeId("r0", 1, 1), NodeId("r1", 1, 1)
JPEG = picture(CAMERA.width, CAMERA.height, ".jpg")


class HandRobot:
    """Gives what the test says, and counts how often it was asked."""

    def __init__(self, hub: MemoryHub, name: str = "r0") -> None:
        self.hub, self.bus = hub, MemoryBus(hub)
        self.asked: list[NodeId] = []
        self.gives: Callable[[NodeId], bytes | str | Busy | None] = lambda node: encode(ViewImage(node, JPEG))
        self.bus.serve(KEYS.view(name), self._answer)
        self.bus.announce(KEYS.view(name))

    def give(self, jpeg: bytes) -> None:
        self.gives = lambda node: pack({"node": [*node], "jpeg": jpeg})

    def _answer(self, request: Request) -> None:
        self.asked.append(decode(request.payload, ViewRequest).node)
        given = self.gives(self.asked[-1])
        if isinstance(given, str):
            request.refuse(given)
        elif isinstance(given, Busy):
            request.refuse(str(given), given.retry_after)
        elif given is not None:
            request.reply(given)


@pytest.fixture
def views(hub: MemoryHub) -> Iterator[NodeViews]:
    views = NodeViews(MemoryBus(hub), KEYS, two_maps)
    yield views
    views.close()


@pytest.fixture
def robot(hub: MemoryHub, views: NodeViews) -> HandRobot:
    robot = HandRobot(hub)
    eventually(lambda: not views.why_none(NODE))
    return robot


def pixels(jpeg: bytes) -> np.ndarray:
    return np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_UNCHANGED))


def test_a_view_is_encoded_again_and_asked_for_once(views: NodeViews, robot: HandRobot):
    hidden = b"<script>alert(1)</script>"
    robot.give(JPEG[:2] + b"\xff\xfe" + struct.pack(">H", 2 + len(hidden)) + hidden + JPEG[2:])
    got = views.view(NODE)
    assert got == views.view(NODE) and robot.asked == [NODE]
    assert hidden not in got
    assert np.abs(pixels(got).astype(int) - pixels(JPEG)).mean() < 6.0


def test_few_views_are_remembered(views: NodeViews, robot: HandRobot, monkeypatch):
    monkeypatch.setattr(node_views, "MOST_CACHED", 2)
    first, second, third = sorted(two_maps().maps[NODE.map].nodes)[:3]
    for node in (first, second, first, third, first, second):
        views.view(node)
    assert robot.asked == [first, second, third, second]


def bomb(width: int, height: int) -> bytes:
    """A small file with a head that says so many pixels."""
    at = JPEG.index(b"\xff\xc0")
    return JPEG[: at + 5] + struct.pack(">HH", height, width) + JPEG[at + 9 :]


GARBAGE = {
    "nothing": (b"", "no whole JPEG file"),
    "text": (b"<html>", "no whole JPEG file"),
    "a PNG": (picture(CAMERA.width, CAMERA.height), "no whole JPEG file"),
    "cut off": (JPEG[:-300], "no whole JPEG file"),
    "a JPEG in name alone": (
        b"\xff\xd8\xff" + b"no image" * 20 + b"\xff\xd9",
        "no JPEG, PNG, PGM or BMP file",
    ),
    "another size": (picture(CAMERA.width // 2, CAMERA.height, ".jpg"), "px instead of"),
    "a bomb of pixels": (bomb(65_500, 65_500), "65500x65500 px instead of"),
    "many scans": (JPEG[:-2] + b"\xff\xda" * 30 + b"\xff\xd9", "more than 20 scans"),
    "too large": (b"\xff\xd8\xff" + bytes(MAX_BYTES) + b"\xff\xd9", "view of a node"),
}


@pytest.mark.parametrize(("sent", "words"), GARBAGE.values(), ids=GARBAGE)
def test_garbage_is_refused_in_one_line(views: NodeViews, robot: HandRobot, sent: bytes, words: str):
    robot.give(sent)
    with pytest.raises(NoView) as refused:
        views.view(NODE)
    assert f"what r0 gave as its view of {NODE} is refused: " in str(refused.value)
    assert words in str(refused.value) and "\n" not in str(refused.value)
    robot.give(JPEG)
    assert views.view(NODE)


def test_a_size_that_is_no_size_in_the_head_is_not_decoded(views: NodeViews, robot: HandRobot, monkeypatch):
    """A decoder allocates memory for as many pixels as the head says."""

    def decoder(*_: object) -> None:
        raise AssertionError("decoded")

    monkeypatch.setattr(cv2, "imdecode", decoder)
    for sent in (bomb(65_500, 65_500), bomb(CAMERA.width, 65_500)):
        robot.give(sent)
        with pytest.raises(NoView, match="px instead of"):
            views.view(NODE)


def test_the_view_of_another_node_is_refused(views: NodeViews, robot: HandRobot):
    robot.gives = lambda node: encode(ViewImage(OTHER, JPEG))
    with pytest.raises(NoView, match=f"it is of {OTHER}"):
        views.view(NODE)


def test_a_robot_that_hangs_holds_up_few_people(views: NodeViews, robot: HandRobot, monkeypatch):
    monkeypatch.setattr(node_views, "PATIENCE", 60.0)
    held: list[Request] = []
    robot.bus.close()
    robot.bus = MemoryBus(robot.hub)
    robot.bus.serve(KEYS.view("r0"), held.append)
    robot.bus.announce(KEYS.view("r0"))
    eventually(lambda: not views.why_none(NODE))
    with ThreadPoolExecutor(node_views.MOST_ASKED + 1) as people:
        waiting = [people.submit(views.view, NODE) for _ in range(node_views.MOST_ASKED)]
        eventually(lambda: len(held) == node_views.MOST_ASKED)
        one_more = people.submit(views.view, NODE)
        refused = wait([one_more], 5.0).done
        for request in held:
            request.reply(encode(ViewImage(NODE, JPEG)))
        assert refused, "one more waits for the robot as well"
        assert isinstance(one_more.exception(), Busy)
        assert len({one.result(60.0) for one in waiting}) == 1
    assert views.view(NODE)


def test_a_busy_robot_is_asked_again_later(views: NodeViews, robot: HandRobot):
    """That it has no view would be wrong."""
    robot.gives = lambda node: Busy(3.0)
    with pytest.raises(Busy) as refused:
        views.view(NODE)
    assert refused.value.retry_after == pytest.approx(3.0)


def test_why_there_is_none(hub: MemoryHub, views: NodeViews, monkeypatch):
    with pytest.raises(InvalidValue, match="has no node 9999"):
        views.view(NodeId("r0", 1, 9999))
    with pytest.raises(NoView, match="r0 is away, or keeps no views"):
        views.view(NODE)
    robot = HandRobot(hub)
    eventually(lambda: not views.why_none(NODE))
    assert "r1 is away" in views.why_none(OTHER)
    robot.gives = lambda node: f"r0 has kept no view of {node}"
    with pytest.raises(NoView, match=f"^r0 has kept no view of {NODE}$"):
        views.view(NODE)
    # It hangs.
    robot.gives = lambda node: None
    monkeypatch.setattr(node_views, "PATIENCE", 0.05)
    with pytest.raises(NoView, match="r0 does not answer"):
        views.view(NODE)
    robot.give(JPEG)
    monkeypatch.undo()
    seen = views.view(NODE)
    robot.bus.close()
    eventually(lambda: views.why_none(NodeId("r0", 1, 2)))
    # What was given once is remembered.
    assert not views.why_none(NODE) and views.view(NODE) == seen
