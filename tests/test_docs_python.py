"""Every block of Python in docs/python.md runs, one after the other, with a fleet behind."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

import mapweave
from mapweave.mapserver.server import MapServer
from mapweave.photographs import send_map
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.zenoh_bus import ZenohBus
from synthetic.maps import changes_of
from synthetic.world import room, take_map
from tests.waiting import eventually, free_port

PAGE = Path(__file__).parents[1] / "docs" / "python.md"
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
ENDPOINT = "tcp/127.0.0.1:7447"


def test_every_block_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    rng = np.random.default_rng(2)
    world = room(0, 0, 5, 4, 600, rng)
    tour = [mapweave.Pose2(2.2 + 0.1 * k, 1.8, 0.9 * k) for k in range(4)]
    changes = {}
    for name in ("r0", "r1"):
        changes[name] = tuple(changes_of(*take_map(world, mapweave.MapId(name, 1), tour, rng)))
        mapweave.write_map_file(Path(f"{name}.mapweave"), mapweave.MapFile("agent", name, changes[name]))
    mapweave.FileMap(mapweave.merge_map_files([Path("r0.mapweave"), Path("r1.mapweave")])).save(
        "office.mapweave"
    )
    cv2.imwrite("photo.png", rng.integers(0, 255, (48, 64), dtype=np.uint8))
    Path("camera.toml").write_text(
        "width = 64\nheight = 48\nfx = 60\nfy = 60\ncx = 32\ncy = 24\nheight_m = 0.3\n"
    )
    endpoint, keys = f"tcp/127.0.0.1:{free_port()}", Keys("demo")
    bus = ZenohBus(BusSettings(mode="router", listen=(endpoint,)))
    robot = ZenohBus(BusSettings(endpoints=(endpoint,)))
    try:
        with MapServer(bus, keys, tmp_path / "s0.sqlite", "s0") as server:
            for name, body in changes.items():
                journal = tmp_path / f"{name}.sqlite"
                assert send_map(body, mapweave.MapId(name, 1), journal, robot, keys, "s0", 30.0)
            eventually(lambda: server.status()["nodes"] == 8 and server.status()["settled"])
            values: dict[str, object] = {}
            blocks = BLOCK.findall(PAGE.read_text())
            assert len(blocks) >= 7
            for block in blocks:
                exec(compile(block.replace(ENDPOINT, endpoint), str(PAGE), "exec"), values)
    finally:
        robot.close()
        bus.close()
    printed = capsys.readouterr().out
    assert printed.startswith("<FileMap: 8 nodes, 2 maps, 1 component, ")
    assert "unknown" in printed and "r0.1 r1.1 True" in printed
    saved = "annotated.mapweave", "both.mapweave", "now.mapweave"
    for made in ("office.png", *saved, "both.g2o", "trajectories/r0.1.tum"):
        assert Path(made).stat().st_size > 0, made
