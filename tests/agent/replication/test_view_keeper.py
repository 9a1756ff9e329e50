"""Images of nodes on a robot's disk: kept, given to who asks, removed; no tick waits for them."""

import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapweave import MapId, MissionKind, NodeId, Pose2
from mapweave.agent.mapping.view import RawImage
from mapweave.agent.replication import view_keeper
from mapweave.agent.replication.view_keeper import MOST_WAITING, ViewKeeper
from mapweave.agent.settings import AgentSettings
from mapweave.hybridmap.change import NodeRetired
from mapweave.hybridmap.errors import InvalidFile, InvalidMessage
from mapweave.hybridmap.view_image import MAX_BYTES, ViewImage, ViewRequest
from mapweave.processes.agent import Agent, AgentOptions
from mapweave.storage.view_file import view_file
from mapweave.vision.lens import Distortion, Lens
from mapweave.wire.bus import Reply
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.messages import decode, encode
from tests.agent.conftest import CAMERA, PhotoWalls
from tests.agent.test_loop_waits_for_nothing import forth_and_back
from tests.waiting import eventually

KEYS = Keys("fleet")
Robot = Callable[[], ViewKeeper]


def node(number: int, epoch: int = 1) -> NodeId:
    return NodeId("r0", epoch, number)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "r0.views"


@pytest.fixture
def begin(hub: MemoryHub, folder: Path) -> Iterator[Robot]:
    """Begins a keeper; the one before ends."""
    begun: list[ViewKeeper] = []

    def again() -> ViewKeeper:
        for keeper in begun:
            keeper.close()
        begun.append(ViewKeeper(MemoryBus(hub), KEYS, "r0", folder))
        return begun[-1]

    yield again
    for keeper in begun:
        keeper.close()


@pytest.fixture
def image(walls: PhotoWalls) -> RawImage:
    return RawImage(walls.render(Pose2()), Lens(CAMERA))


def ask(hub: MemoryHub, wanted: NodeId) -> Reply:
    (reply,) = MemoryBus(hub).ask(KEYS.view("r0"), encode(ViewRequest(wanted)), 10.0)
    return reply


def kept(hub: MemoryHub, wanted: NodeId) -> bytes:
    """The file that is given; empty if there is none."""
    reply = ask(hub, wanted)
    if reply.error:
        assert reply.error == f"r0 has kept no view of {wanted}"
        return b""
    answer = decode(reply.payload, ViewImage)
    assert answer.node == wanted
    return answer.jpeg


def test_an_image_is_kept_given_and_removed_with_its_node(begin: Robot, hub, folder, image):
    keeper = begin()
    keeper.keep([(node(1), image), (node(3), image)], [])
    jpeg = kept(hub, node(1))
    assert 2_000 < len(jpeg) < 20_000
    seen = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_UNCHANGED)
    assert seen.shape == image.pixels.shape
    assert np.abs(seen.astype(int) - image.pixels).mean() < 5.0
    assert kept(hub, node(2)) == b""
    keeper.keep([], [NodeRetired(node(1))])
    assert kept(hub, node(1)) == b"" and kept(hub, node(3)) == jpeg
    assert [path.name for path in folder.iterdir()] == ["r0.1.3.jpg"]


def test_what_was_kept_outlasts_a_restart_but_for_nodes_that_are_gone(
    begin: Robot, hub: MemoryHub, folder: Path, image: RawImage
):
    begin().keep([(node(1), image), (node(3), image), (node(1, epoch=2), image)], [])
    begin().close()
    (folder / ".r0.1.5.jpg.77.part").write_bytes(b"cut off by a loss of power")
    (folder / "r0.notes.jpg").write_bytes(b"a person's")
    keeper = begin()
    keeper.keep_only(MapId("r0", 1), [node(3)])
    assert kept(hub, node(1)) == b""
    assert kept(hub, node(3)) and kept(hub, node(1, epoch=2))
    assert {path.name for path in folder.iterdir()} == {"r0.1.3.jpg", "r0.2.1.jpg", "r0.notes.jpg"}


@pytest.mark.parametrize("damage", ["missing", "empty", "cut off", "zeros", "too large"])
def test_a_damaged_file_is_no_view(begin: Robot, hub, folder, image, damage: str):
    begin().keep([(node(1), image)], [])
    jpeg, path = kept(hub, node(1)), folder / "r0.1.1.jpg"
    if damage == "missing":
        path.unlink()
    else:
        path.write_bytes({
            "empty": b"", "cut off": jpeg[:-900], "zeros": bytes(len(jpeg)), "too large": jpeg * 20
        }[damage])  # fmt: skip
    assert kept(hub, node(1)) == b""


def test_the_oldest_make_room(begin: Robot, hub, image, monkeypatch):
    monkeypatch.setattr(view_keeper, "MOST_VIEWS", 2)
    begin().keep([(node(10), image), (node(9, epoch=2), image)], [])
    # Of the files of an earlier run the numbers say which is older.
    begin().keep([(node(11, epoch=2), image)], [])
    assert kept(hub, node(10)) == b""
    assert kept(hub, node(9, epoch=2)) and kept(hub, node(11, epoch=2))


def test_a_disk_that_hangs_holds_up_no_one(begin: Robot, hub, image, monkeypatch):
    """What it has no time for is left out, and who asks meanwhile gets a time to ask again."""
    hangs, goes_on = threading.Event(), threading.Event()
    write = view_keeper.write_whole

    def hanging(path: Path, data: bytes) -> None:
        hangs.set()
        assert goes_on.wait(60.0)
        write(path, data)

    monkeypatch.setattr(view_keeper, "write_whole", hanging)
    keeper = begin()
    keeper.keep([(node(1), image)], [])
    assert hangs.wait(60.0)
    keeper.keep([(node(number), image) for number in range(2, 40)], [])
    refused = ask(hub, node(1))
    assert refused.error and refused.retry_after > 0.0
    goes_on.set()
    eventually(lambda: not ask(hub, node(1)).error)
    assert [number for number in range(1, 40) if kept(hub, node(number))] == [*range(1, 2 + MOST_WAITING)]


def test_a_full_disk_is_reported_once(begin: Robot, hub, image, monkeypatch, caplog):
    def full(path: Path, data: bytes) -> None:
        raise InvalidFile(f"{path.name}: cannot be written (No space left on device)")

    keeper = begin()
    with monkeypatch.context() as patched:
        patched.setattr(view_keeper, "write_whole", full)
        for number in range(3):
            keeper.keep([(node(number), image)], [])
            # That someone asks meanwhile does not make the disk good.
            assert kept(hub, node(number)) == b""
        assert "r0.1.0.jpg: cannot be written" in caplog.text
    keeper.keep([(node(4), image)], [])
    assert kept(hub, node(4))
    assert len(caplog.records) == 1


def test_an_image_that_cannot_be_encoded_ends_nothing(begin: Robot, hub, image, monkeypatch, caplog):
    def broken(pixels: np.ndarray, camera: object) -> bytes:
        raise cv2.error("OpenCV(4.0)\nassertion failed")

    keeper = begin()
    with monkeypatch.context() as patched:
        patched.setattr(view_keeper, "view_file", broken)
        keeper.keep([(node(1), image)], [])
        assert kept(hub, node(1)) == b""
    assert "not kept: OpenCV(4.0) assertion failed" in caplog.text
    keeper.keep([(node(2), image)], [])
    assert kept(hub, node(2))


def test_what_is_no_question_is_refused(begin: Robot, hub):
    begin()
    (reply,) = MemoryBus(hub).ask(KEYS.view("r0"), b"\x81\xa1v\x01", 10.0)
    assert reply.error and not reply.retry_after
    with pytest.raises(InvalidMessage):
        decode(b"x" * 2 * MAX_BYTES, ViewImage)


def test_noise_of_any_size_fits_in_a_message():
    noise = np.random.default_rng(0).integers(0, 255, (480, 640)).astype(np.uint8)
    assert len(view_file(noise, CAMERA)) <= MAX_BYTES


def run(walls: PhotoWalls, description, hub: MemoryHub, folder: Path, keep_views: bool) -> Agent:
    """An agent at the end of a drive that makes nodes; it stays open."""
    robot = forth_and_back(walls, description)
    options = AgentOptions("r0", folder, epoch=1, mission=MissionKind.CARRIED, patience=0.0)
    agent = Agent(robot.describe, MemoryBus(hub), KEYS, AgentSettings(keep_views=keep_views), options)
    agent.run(robot, threading.Event())
    return agent


def test_an_agent_keeps_the_view_of_each_node(walls, description, hub, tmp_path):
    agent = run(walls, description, hub, tmp_path, keep_views=True)
    try:
        nodes = agent.pipeline.map.nodes
        assert nodes
        for one in nodes.values():
            seen = cv2.imdecode(np.frombuffer(kept(hub, one.id), np.uint8), cv2.IMREAD_GRAYSCALE)
            x = float(one.map_from_robot.mean.x)
            true = walls.render(Pose2(x))
            assert np.abs(seen.astype(int) - true).mean() < 8.0, f"{one.id} was made elsewhere"
        # What the map no longer has is removed when it is taken up again.
        agent.close()
        last = max(nodes)
        for path in (tmp_path / "r0.views").iterdir():
            path.rename(path.with_name(f"r0.1.{900 + last.number}.jpg"))
        agent = run(walls, description, hub, tmp_path, keep_views=True)
        assert kept(hub, NodeId("r0", 1, 900 + last.number)) == b""
    finally:
        agent.close()


def test_without_the_setting_nothing_is_kept(walls, description, hub, tmp_path, opened):
    agent = opened(run(walls, description, hub, tmp_path, keep_views=False))
    assert agent.pipeline.map.nodes
    assert not (tmp_path / "r0.views").exists()
    assert MemoryBus(hub).ask(KEYS.view("r0"), encode(ViewRequest(node(1))), 1.0) == []


@pytest.mark.parametrize("distortion", [(-0.3, 0.1, 0.001, -0.001, 0.0), (0.0,) * 5])
def test_the_image_is_the_one_in_which_the_landmarks_are(
    begin: Robot, hub, image: RawImage, distortion: Distortion
):
    """A distorting lens is taken out of it."""
    lens = Lens(CAMERA, distortion)
    grid = np.stack(np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height)), axis=-1)
    at = lens.undistort(grid).astype(np.float32).reshape(CAMERA.height, CAMERA.width, 2)
    raw = cv2.remap(image.pixels, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    begin().keep([(node(1), RawImage(np.asarray(raw, np.uint8), lens))], [])
    seen = cv2.imdecode(np.frombuffer(kept(hub, node(1)), np.uint8), cv2.IMREAD_GRAYSCALE).astype(int)
    inner = np.s_[60:180, 80:240]
    assert np.abs(seen - image.pixels)[inner].mean() < 5.0
