"""Images on the page in a real browser, with agents and a server behind: views of nodes, and photos."""

from __future__ import annotations

import re
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import cv2
import numpy as np
import pytest
import skimage.data

from mapweave.agent.observation import Observation
from mapweave.agent.settings import AgentSettings
from mapweave.hybridmap.errors import MapweaveError
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.mission_order import MissionKind
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.http.web import Web
from mapweave.mapserver.server import MapServer
from mapweave.processes.agent import Agent, AgentOptions
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from tests.agent.conftest import CAMERA, DESCRIPTION, PhotoWalls
from tests.agent.test_loop_waits_for_nothing import Player
from tests.browser import PROGRAMS, Browser, there_is_none
from tests.mapserver.http.client import ask
from tests.mapserver.http.person import Person
from tests.mapweave.test_kept_maps import WAY
from tests.waiting import eventually

pytestmark = pytest.mark.skipif(there_is_none(), reason=f"needs {' and '.join(PROGRAMS)} on the PATH")
KEYS = Keys("views")
SHOWN = "return document.querySelectorAll('{} svg.seen image').length"
WORDS = "return document.querySelector('#selected small').textContent"
LABEL = "return document.querySelector('{} svg').getAttribute('aria-label')"
ANSWER = "return document.getElementById('answer').{}"
CELLS = "return [...document.querySelectorAll('#answer td')].map(cell => cell.textContent)"


class Fleet:
    """Robots that were carried before the same photographs, and a map server.

    Attributes:
        folder: of all files.
        agents: of the robots, by name; they are done with their drives.
        server: the map server.
        web: over HTTP.
    """

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.folder, hub = folder, MemoryHub()
        self.server = MapServer(MemoryBus(hub), KEYS, folder / "s0.sqlite", "s0")
        stack.enter_context(self.server)
        self.agents: dict[str, Agent] = {}
        for seed, (name, keeps) in enumerate({"r0": True, "r1": True, "r2": False}.items()):
            robot = drive(seed)
            options = AgentOptions(name, folder, epoch=1, mission=MissionKind.CARRIED)
            settings = AgentSettings(keep_views=keeps)
            agent = Agent(robot.describe, MemoryBus(hub), KEYS, settings, options)
            stack.callback(agent.close)
            agent.run(robot, threading.Event())
            assert agent.replicator.wait_acknowledged(60.0)
            self.agents[name] = agent
        assert self.server.settle(60.0)
        self.web = Web(("127.0.0.1", 0), self.server)
        stack.enter_context(self.web)

    def node(self, name: str) -> NodeId:
        return min(self.agents[name].pipeline.map.nodes)


def drive(seed: int) -> Player:
    """Forth and some way back, which makes two nodes; no two cameras give the same bits."""
    walls, noise = PhotoWalls(), np.random.default_rng(seed)
    # Steps of 4 cm are enough for a node.
    poses = [Pose2(float(x)) for x in WAY[:80:2]]
    before = [poses[0], *poses]
    seen: list[Observation] = []
    for k in range(len(poses)):
        sensed = walls.observe(before[k], poses[k], k + 1)
        grain = noise.normal(0.0, 2.0, (CAMERA.height, CAMERA.width))
        image = np.clip(walls.render(poses[k]) + grain, 0, 255).astype(np.uint8)
        seen.append(Observation(sensed.stamp_ns, sensed.odometry, image))
    return Player(DESCRIPTION, seen)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    with ExitStack() as stack:
        yield Fleet(tmp_path_factory.mktemp("fleet"), stack)


@pytest.fixture(scope="module")
def page(fleet: Fleet, browser: Browser) -> Browser:
    browser.open(f"http://127.0.0.1:{fleet.web.port}/")
    eventually(lambda: browser.run("return window.mapweave?.model?.order.length"))
    return browser


def show(page: Browser, node: NodeId) -> None:
    Person(page).search(node)
    Person(page).shows(f"Node {node}")


def test_a_node_is_shown_with_its_view(fleet: Fleet, page: Browser):
    node = fleet.node("r0")
    show(page, node)
    eventually(lambda: page.run(SHOWN.format("#selected")) == 1)
    landmarks = len(fleet.agents["r0"].pipeline.map.nodes[node].landmarks)
    assert page.run(LABEL.format("#selected")) == f"The view of {node} with its {landmarks} landmarks"
    # The image lies where the landmarks are: it fills the frame of the camera's size.
    boxes = page.run(
        "return ['image', 'rect'].map(one => document.querySelector('#selected svg ' + one).getBBox())"
        ".map(box => [box.x, box.y, box.width, box.height])"
    )
    assert boxes == [[-0.5, -0.5, CAMERA.width, CAMERA.height], [0, 0, CAMERA.width, CAMERA.height]]
    assert page.run("return document.querySelectorAll('#selected svg image ~ circle').length") == landmarks


def test_a_node_without_a_view_is_shown_as_before(fleet: Fleet, page: Browser):
    """Of a robot that keeps none nothing is asked."""
    page.errors()
    node = fleet.node("r2")
    show(page, node)
    assert page.run("return document.querySelector('#selected svg image')") is None
    assert "landmarks in the image of" in page.run(LABEL.format("#selected"))
    assert "No view: r2 is away, or keeps no views (keep_views" in page.run(WORDS)
    assert page.errors() == []
    status, _, content = ask(fleet.web, "GET", f"/nodes/{node}/view")
    assert status == 404 and b"r2 is away, or keeps no views" in content


def ask_why(page: Browser, a: NodeId, b: NodeId) -> None:
    page.run(
        "document.getElementById('tab-why').click(); const form = document.getElementById('form');"
        f"form.a.value = '{a}'; form.b.value = '{b}'; form.requestSubmit()"
    )


def test_a_link_is_shown_over_both_views(fleet: Fleet, page: Browser):
    a, b = fleet.node("r0"), fleet.node("r1")
    ask_why(page, a, b)
    eventually(lambda: page.run(SHOWN.format("#result")) == 2)
    assert page.run("return document.querySelectorAll('#result svg image ~ line.agree').length") >= 10
    eventually(lambda: f"drawn over the view of {a} and {b}" in page.run(LABEL.format("#result")))
    first, second = page.run(
        "return [...document.querySelectorAll('#result svg image')].map(image => image.getBBox().y)"
    )
    assert second - first > CAMERA.height, "one below the other"
    # Side by side the views were half as wide as the panel, and their names could not be read.
    panel, view, name = page.run(
        "return ['#why', '#result svg image', '#result svg text']"
        ".map(one => document.querySelector(one).getBoundingClientRect()).map(box => [box.width, box.height])"
    )
    assert view[0] > 0.8 * (panel[0] - 40) and name[1] > 9


def test_a_link_says_which_view_is_missing_and_why(fleet: Fleet, page: Browser):
    a, b = fleet.node("r0"), fleet.node("r2")
    ask_why(page, a, b)
    eventually(lambda: page.run(SHOWN.format("#result")) == 1)
    eventually(lambda: page.run(LABEL.format("#result")).endswith(f"drawn over the view of {a}"))
    words = page.run("return document.querySelector('#result small').textContent")
    assert f"No view of {b}: r2 is away, or keeps no views" in words and f"No view of {a}" not in words


def test_a_view_that_is_lost_is_left_out(fleet: Fleet, page: Browser):
    """The robot keeps views, but the one of this node is gone from its disk."""
    node = max(fleet.agents["r1"].pipeline.map.nodes)
    (fleet.folder / "r1.views" / f"{node}.jpg").unlink()
    with pytest.raises(MapweaveError, match=f"r1 has kept no view of {node}"):
        fleet.server.view(node)
    show(page, node)
    eventually(lambda: f"No view: r1 has kept no view of {node}" in page.run(WORDS))
    assert page.run("return document.querySelector('#selected svg image')") is None
    assert "landmarks in the image of" in page.run(LABEL.format("#selected"))


def choose(page: Browser, path: Path) -> None:
    """By the field for files."""
    page.type("#image", str(path))


def drop(page: Browser, path: Path) -> None:
    """From a folder of the desktop onto the map, as Chromium hears of it from the window system."""
    data = {"items": [], "files": [str(path)], "dragOperationsMask": 1}
    hint = "return document.getElementById('drop').hidden"
    assert page.run(hint)
    for kind in ("dragEnter", "dragOver"):
        page.devtools("Input.dispatchDragEvent", type=kind, x=100, y=200, data=data)
    eventually(lambda: not page.run(hint))
    page.devtools("Input.dispatchDragEvent", type="drop", x=100, y=200, data=data)
    eventually(lambda: page.run(hint))


@pytest.fixture
def photo(page: Browser, tmp_path: Path) -> Callable[[np.ndarray], Path]:
    """Writes what the robots' camera sees, which the page knows."""
    hfov = np.degrees(2 * np.arctan(CAMERA.width / 2 / CAMERA.fx))
    page.run(
        "const at = name => document.getElementById(name);"
        "at('answer').textContent = ''; delete at('answer').dataset.certainty;"
        f"at('height_m').value = {CAMERA.mount_height}; at('hfov').value = {hfov:.0f}"
    )

    def write(image: np.ndarray) -> Path:
        cv2.imwrite(str(tmp_path / "photo.png"), image)
        return tmp_path / "photo.png"

    return write


@pytest.mark.parametrize("give", [choose, drop])
def test_a_photo_is_found_where_it_was_taken(
    page: Browser, photo: Callable[[np.ndarray], Path], give: Callable[[Browser, Path], None]
):
    """All maps begin where the first robot was, so that the truth is in the frame of the merged map."""
    taken = Pose2(0.3, 0.2, 0.1)
    give(page, photo(PhotoWalls().render(taken)))
    eventually(lambda: page.run(ANSWER.format("dataset.certainty")) == "found")
    node, ahead, left, turned, _ = page.run(CELLS)
    shown = page.run(f"const m = mapweave.model, row = m.rowOf('{node}'); return [m.x[row], m.y[row]]")
    assert shown[0] + float(ahead.split()[0]) == pytest.approx(taken.x, abs=0.03)
    assert shown[1] + float(left.split()[0]) == pytest.approx(taken.y, abs=0.03)
    assert turned == "6\u00b0"
    x, y, heading = page.run("return mapweave.page.photo[0].merged_from_robot.mean")
    assert (x, y, heading) == pytest.approx((taken.x, taken.y, taken.heading), abs=0.03)
    assert page.run("const v = mapweave.viewport; return [v.x, v.y]") == pytest.approx([x, y])
    eventually(
        lambda: "photo, " in page.run("return mapweave.painter.labels.texts.map(one => one.text).join()")
    )


def of_phone(image: np.ndarray, path: Path, megapixels: float) -> Path:
    """A JPEG file as a phone writes it that is held across: lying on its side, which the file says (Exif)."""
    scale = np.sqrt(megapixels * 1e6 / image.size)
    large = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    lying = cv2.rotate(large, cv2.ROTATE_90_COUNTERCLOCKWISE)
    data = cv2.imencode(".jpg", lying)[1].tobytes()
    orientation = struct.pack("<HHIHH", 0x0112, 3, 1, 6, 0)
    tiff = b"II*\0" + struct.pack("<IH", 8, 1) + orientation + bytes(4)
    segment = b"Exif\0\0" + tiff
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + data[2:])
    return path


@pytest.mark.parametrize("megapixels", [0.3, 12.0])
@pytest.mark.parametrize("give", [choose, drop])
def test_a_photo_of_a_phone_is_found_upright(
    page: Browser,
    photo: Callable[[np.ndarray], Path],
    give: Callable[[Browser, Path], None],
    megapixels: float,
):
    """A small one is sent as it is, and a large one made smaller by the page."""
    taken = Pose2(0.3, 0.2, 0.1)
    image = PhotoWalls().render(taken)
    file = of_phone(image, photo(image).with_name("phone.jpg"), megapixels)
    assert cv2.imread(str(file), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION).shape[0] > 600
    give(page, file)
    eventually(lambda: page.run(ANSWER.format("dataset.certainty")) == "found", 60.0)
    x, y, heading = page.run("return mapweave.page.photo[0].merged_from_robot.mean")
    assert (x, y, heading) == pytest.approx((taken.x, taken.y, taken.heading), abs=0.03)
    eventually(lambda: page.run("return document.getElementById('shown').naturalWidth") > 0)
    width, height = page.run(
        "const one = document.getElementById('shown'); return [one.naturalWidth, one.naturalHeight]"
    )
    assert width > height, "shown as it was held"


def test_a_photo_that_no_browser_here_reads_is_refused_in_one_line(page: Browser, tmp_path):
    """Phones of one maker write HEIC, which Chromium does not read."""
    file = tmp_path / "IMG_0001.heic"
    file.write_bytes(struct.pack(">I", 24) + b"ftypheic" + bytes(4) + b"mif1heic" + bytes(5000))
    drop(page, file)
    line = "IMG_0001.heic is no image that can be read: choose a JPEG or PNG."
    eventually(lambda: page.run(ANSWER.format("textContent")) == line)
    assert (
        page.run("return document.getElementById('shown').hidden")
        and page.run(ANSWER.format("className")) == "box failed"
    )


@pytest.mark.parametrize(("heading", "side"), [(0.95, "right"), (-0.9, "left")])
@pytest.mark.parametrize("give", [choose, drop])
def test_a_photo_that_shows_too_little_says_where_to_turn(
    page: Browser,
    photo: Callable[[np.ndarray], Path],
    give: Callable[[Browser, Path], None],
    heading: float,
    side: str,
):
    """Turned so far that one edge of the image shows what the robots have mapped."""
    give(page, photo(PhotoWalls().render(Pose2(0.3, 0.0, heading))))
    eventually(lambda: page.run(ANSWER.format("dataset.certainty")) == "unknown")
    words = page.run("return document.querySelector('#answer li').textContent")
    assert re.match(r"r\d\.1\.\d the \d+ landmarks that agree lie in \d of 24 image cells\.", words), words
    assert re.search(r"\d+ landmarks match, \d+ agree on one pose\. ", words), "enough of them agree"
    turn = re.search(r"Turn by (\d+)\u00b0 to the (left|right) and try again\.", words)
    assert turn, words
    assert turn[2] == side and np.radians(float(turn[1])) == pytest.approx(abs(heading), abs=0.1)
    assert page.run("return mapweave.page.photo") == []


def test_a_photo_of_another_place_is_not_known(page: Browser, photo: Callable[[np.ndarray], Path]):
    cat = cv2.cvtColor(skimage.data.chelsea(), cv2.COLOR_RGB2GRAY)
    drop(page, photo(cv2.resize(cat, (CAMERA.width, CAMERA.height))))
    eventually(lambda: page.run(ANSWER.format("dataset.certainty")) == "unknown")
    words = page.run(ANSWER.format("textContent"))
    assert re.search(
        r"It looks most like:r\d\.1\.\d \d features match, \d with a depth; 10 are needed\.", words
    ), words
    assert "Turn by" not in words and "no robot may have mapped what the photo shows" in words
    page.run("document.querySelector('#answer li button').click()")
    eventually(lambda: "Node r" in page.run("return document.querySelector('#selected h2').textContent"))
