"""Every block of Python of the pages runs, those of a page one after the other, with a fleet behind."""

import math
import re
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest

import mapweave
from mapweave.commands.http_access import http_access
from mapweave.hybridmap.agent_status import AgentStatus, Status
from mapweave.hybridmap.change import ChangeBody
from mapweave.hybridmap.mission_order import MissionOrder, MissionReport, MissionState
from mapweave.identities.key_folder import KeyFolder, Profile
from mapweave.mapserver.server import MapServer
from mapweave.photographs import send_map
from mapweave.wire.bus import Request
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.credentials import Role
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.messages import decode, encode
from mapweave.wire.senders import serve_senders
from mapweave.wire.zenoh_bus import ZenohBus
from synthetic.maps import map_tours
from synthetic.world import room
from tests.simulator import needs_simulator
from tests.waiting import eventually, free_port

DOCS = Path(__file__).parents[1] / "docs"
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
ENDPOINT = "tcp/127.0.0.1:7447"
STOPS = 10
"""Of each of two robots; nodes and edges are numbered together, so r0.1.19 is the last node."""


def run_blocks(page: str, values: dict[str, object], replaced: Mapping[str, str]) -> None:
    """Run the blocks of Python of a page, one after the other, with other words in the place of some."""
    blocks = BLOCK.findall((DOCS / page).read_text())
    assert blocks
    for block in blocks:
        for word, other in replaced.items():
            block = block.replace(word, other)
        exec(compile(block, page, "exec"), values)


def with_endpoint(endpoint: str) -> dict[str, str]:
    """The default endpoint, written or not, becomes that of a test."""
    return {ENDPOINT: endpoint, "mapweave.Fleet(": f'mapweave.Fleet("{endpoint}", '}


def test_no_page_has_python_that_is_not_run():
    root = DOCS.parent
    files = [*DOCS.rglob("*.md"), *root.glob("*.md")]
    pages = {str(page.relative_to(root)) for page in files if BLOCK.search(page.read_text())}
    run = {"python.md", "command.md", "corrections.md", "http.md", "worlds.md"}
    assert pages == {*(f"docs/{page}" for page in run), "README.md"}


def together() -> dict[str, list[ChangeBody]]:
    """Two robots' maps of one room."""
    tour = [mapweave.Pose2(2.2 + 0.05 * k, 1.8, k * math.pi / 3) for k in range(STOPS)]
    return mapped({"r0": tour, "r1": tour}, 5, 600)


def apart() -> dict[str, list[ChangeBody]]:
    """Two robots in a bare hall: r0.1.17 and r1.1.5 alone see the same, too little to join the maps."""
    west = [mapweave.Pose2(2.5, 2.0, math.pi + 0.15 * (k - 4)) for k in range(STOPS)]
    east = [mapweave.Pose2(9.5, 2.0, 0.15 * (k - 4)) for k in range(STOPS)]
    west[8], east[2] = mapweave.Pose2(6.0, 1.5, 1.55), mapweave.Pose2(6.1, 1.8, 1.6)
    return mapped({"r0": west, "r1": east}, 12, 450)


def mapped(
    tours: Mapping[str, Sequence[mapweave.Pose2]], length: float, landmarks: int
) -> dict[str, list[ChangeBody]]:
    """What robots map on tours of a room so long, m."""
    rng = np.random.default_rng(2)
    world = room(0, 0, length, 4, landmarks, rng)
    by_map = map_tours(world, {mapweave.MapId(name, 1): tour for name, tour in tours.items()}, rng)
    return {map_id.agent: changes for map_id, changes in by_map.items()}


@contextmanager
def fleet_with(changes: Mapping[str, Sequence[ChangeBody]], tmp_path: Path) -> Iterator[str]:
    """A fleet with these maps, and a robot r0 that has done what it is sent to at once: its endpoint."""
    endpoint, keys = f"tcp/127.0.0.1:{free_port()}", Keys("demo")
    bus = ZenohBus(BusSettings(mode="router", listen=(endpoint,)))
    robot = ZenohBus(BusSettings(endpoints=(endpoint,)))
    doing = Status("parked", "", 1, 0, mapweave.Pose2(), True, located=True)
    done: list[MissionReport] = []

    def take(request: Request) -> None:
        order = decode(request.payload, MissionOrder)
        done.append(MissionReport(order, MissionState.DONE, 1.0, "at the goal, 3 +- 2 mm off"))
        request.reply(encode(MissionReport(order, MissionState.RUNNING)))

    def report() -> None:
        while not over.wait(0.1):
            mission = done[-1] if done else None
            robot.publish(keys.agent_status("r0"), encode(AgentStatus(doing, 1, "r0", mission=mission)))

    over, reporting = threading.Event(), threading.Thread(target=report)
    serving = serve_senders(robot, keys.mission("r0"), lambda request, who: take(request))
    try:
        with MapServer(bus, keys, tmp_path / "s0.sqlite", "s0") as server:
            for name, body in changes.items():
                journal = tmp_path / f"{name}.sqlite"
                assert send_map(body, mapweave.MapId(name, 1), journal, robot, keys, "s0", 30.0)
            reporting.start()
            eventually(lambda: server.status()["nodes"] == 2 * STOPS and server.status()["settled"])
            yield endpoint
    finally:
        over.set()
        reporting.join()
        for one in serving:
            one.close()
        robot.close()
        bus.close()


def write_files(
    changes: Mapping[str, Sequence[ChangeBody]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Map files, a photograph and its camera, where blocks of Python look for them."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    for name, body in changes.items():
        mapweave.write_map_file(Path(f"{name}.mapweave"), mapweave.MapFile("agent", name, tuple(body)))
    mapweave.FileMap(mapweave.merge_map_files([Path("r0.mapweave"), Path("r1.mapweave")])).save(
        "office.mapweave"
    )
    for photo in ("photo.png", "photo.jpg"):
        cv2.imwrite(photo, np.random.default_rng(2).integers(0, 255, (48, 64), dtype=np.uint8))
    Path("camera.toml").write_text(
        "width = 64\nheight = 48\nfx = 60\nfy = 60\ncx = 32\ncy = 24\nheight_m = 0.3\n"
    )


@needs_simulator
def test_the_blocks_of_the_readme_run(tmp_path, monkeypatch, capsys):
    changes = together()
    write_files(changes, tmp_path, monkeypatch)
    with fleet_with(changes, tmp_path) as endpoint:
        run_blocks("../README.md", {}, {**with_endpoint(endpoint), "seconds=60.0": "seconds=1.0"})
    simulated, *library = capsys.readouterr().out.splitlines()
    assert simulated.startswith("(240, 320) Odometry(") and len(library) > 3


@pytest.mark.slow
def test_every_block_of_the_page_of_python_runs(tmp_path, monkeypatch, capsys):
    changes = together()
    write_files(changes, tmp_path, monkeypatch)
    with fleet_with(changes, tmp_path) as endpoint:
        run_blocks("python.md", {}, with_endpoint(endpoint))
    printed = capsys.readouterr().out
    assert printed.startswith(f"<FileMap: {2 * STOPS} nodes, 2 maps, 1 component, ")
    assert "unknown" in printed and "r0.1 r1.1 True" in printed
    saved = "annotated.mapweave", "both.mapweave", "now.mapweave"
    for made in ("office.png", *saved, "both.g2o", "trajectories/r0.1.tum"):
        assert Path(made).stat().st_size > 0, made


def test_the_blocks_of_the_page_of_commands_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with fleet_with(together(), tmp_path) as endpoint:
        run_blocks("command.md", {}, with_endpoint(endpoint))
    assert "done at the goal, 3 +- 2 mm off" in capsys.readouterr().out
    assert len(mapweave.open("office.mapweave").nodes) == 2 * STOPS


def test_the_blocks_of_the_page_of_corrections_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with fleet_with(apart(), tmp_path) as endpoint:
        run_blocks("corrections.md", {}, with_endpoint(endpoint))
        with mapweave.connect(endpoint) as fleet:
            assert [one.holds for one in fleet.constraints()] == [True, False]
            assert fleet.annotations().last("closure", "paint") is None
    printed = capsys.readouterr().out
    assert "1 anna r0.1.17 and r1.1.5 " in printed and "both see the red door" in printed
    assert "only checked, nothing is changed: " in printed and printed.endswith("r0.1.17\n")


def test_the_block_of_the_page_of_http_runs(tmp_path, monkeypatch, capsys):
    """With the certificate and the token of a fleet with keys."""
    monkeypatch.chdir(tmp_path)
    folder = KeyFolder.create(tmp_path / "keys", "demo", Profile.PRODUCTION, ["127.0.0.1"], "s0")
    folder.add("anna", Role.OPERATOR)
    Path("authority.pem").write_bytes((folder.path / "authority.pem").read_bytes())
    with (
        closing(MemoryBus(MemoryHub())) as bus,
        MapServer(bus, Keys("demo"), tmp_path / "s0.sqlite", "s0") as server,
        http_access(f"127.0.0.1:{free_port()}", folder, "s0").serve(server) as web,
    ):
        where = {"192.168.1.10:8080": f"127.0.0.1:{web.port}"}
        run_blocks("http.md", {"token": folder.token("anna", 30.0)}, where)
    assert capsys.readouterr().out == "{'robots': []}\n"


@needs_simulator
def test_the_block_of_the_page_of_worlds_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("my.toml").write_bytes((DOCS.parent / "sim/worlds/examples/flat.toml").read_bytes())
    values: dict[str, object] = {}
    run_blocks("worlds.md", values, {})
    assert len(values["robots"]) == 3  # type: ignore[arg-type]
