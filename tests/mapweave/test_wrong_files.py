"""Every command with a file that is not what it needs: one line says so, and nothing is lost or left."""

import shlex
import sqlite3
from collections.abc import Callable
from contextlib import closing, nullcontext
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapweave import Fleet, MapId, write_map_file
from mapweave.agent.replication.journal import Journal
from mapweave.cli import main
from mapweave.exit_status import FAILED, NO, USAGE
from mapweave.mapserver.map_files import map_file_of
from mapweave.mapserver.server import MapServer
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from synthetic.maps import looked_around, merger_of, write_store
from tests.mapweave.command_line import CAMERA

R0, R1 = MapId("r0", 1), MapId("r1", 1)
LOGS = looked_around((R0, R1), seed=8)


def journal(path: Path) -> None:
    with closing(Journal(path, "r0")) as disk:
        disk.append(disk.open_map(1), LOGS[R0], 0)


def merged(path: Path) -> None:
    write_map_file(path, map_file_of(merger_of(LOGS).merged()))


def half(path: Path) -> None:
    merged(path)
    path.write_bytes(path.read_bytes()[:-1000])


def database(path: Path) -> None:
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("CREATE TABLE notes (words TEXT)")


def picture(path: Path) -> None:
    path.write_bytes(cv2.imencode(".png", np.full((48, 64), 90, np.uint8))[1].tobytes())


def noise(path: Path) -> None:
    path.write_bytes(np.random.default_rng(4).bytes(5000))


KINDS: dict[str, Callable[[Path], object]] = {
    "missing": lambda path: None,
    "folder": Path.mkdir,
    "empty": Path.touch,
    "text": lambda path: path.write_text("a line of words\n" * 40),
    "noise": noise,
    "picture": picture,
    "database": database,
    "journal": journal,
    "map": merged,
    "half": half,
}
IN_MAPS = (
    "map explain r0.1 r1.1", "map route r0.1.1 r1.1.1", "map history", "map link r0.1.1 r1.1.3 -o {out}",
    "map unmerge r0.1.1 r1.1.1 -o {out}", "map retire r0.1 -o {out}", "map undo 1 -o {out}",
    "map pin r0.1.1 -o {out}", "map portal list", "map portal add gate r0.1.1 r1.1.1 --kind door -o {out}",
    "map portal remove gate -o {out}", "place add sink r0.1.1 -o {out}", "place list",
    "place remove sink -o {out}", "plan show", "plan export office --format tf",
    "plan remove office -o {out}",
    "plan add {picture} --pair r0.1.1=1,2 --pair r0.1.3=9,2 --pair r0.1.5=5,30 -o {out}",
    "close r0.1.1 -o {out}", "reopen sink -o {out}", "prefer r0.1.1 r0.1.3 -o {out}",
    "avoid r0.1.1 r0.1.3 -o {out}", "closures", "floor ground r0.1.1 -o {out}",
    "relocalize {picture} --camera {camera}",
)  # fmt: skip
LINES = {
    **{f"{line} --map {{bad}}": {"journal", "map"} for line in IN_MAPS},
    "map show {bad} --no-picture": {"journal", "map"},
    "map diff {map} {bad}": {"journal", "map"},
    "map merge {bad} -o {out}": {"journal", "map"},
    "map extract {bad} -o {tmp}/maps": {"journal", "map"},
    "map export {bad} --format g2o -o {out}": {"journal", "map"},
    "map import {bad} -o {tmp}/x.g2o": set(),
    "map backup {bad} -o {out}": set(),
    "map from-photos {bad} --camera {camera} --spacing 1 -o {out}": set(),
    "map from-photos {recording}/images --camera {bad} --spacing 1 -o {out}": set(),
    "open {bad} --http x": set(),
    "plan add {bad} --pair r0.1.1=1,2 --pair r0.1.3=9,2 --pair r0.1.5=5,30 --map {map} -o {out}": set(),
    "relocalize {bad} --camera {camera} --map {map}": {"picture"},
    "relocalize {picture} --camera {bad} --map {map}": set(),
    "info {bad}": set(),
    "info {recording} --camera {bad}": set(),
    "replay {bad} --offline --data {tmp}/data": set(),
    "replay {recording} --odometry {bad} --offline --data {tmp}/data": set(),
    "replay {recording} --settings {bad} --offline --data {tmp}/data": {"empty"},
    "replay {recording} --calibration {bad} --offline --data {tmp}/data": {"missing", "folder"},
    "replay {recording} --offline --data {bad} --name r9": {"missing", "folder"},
    "eval replay {bad} -o {tmp}/eval": set(),
    "eval relocalize {bad} -o {tmp}/eval": set(),
    "eval merge {bad} -o {tmp}/eval": set(),
    "eval replay {recording} --truth {bad} -o {tmp}/eval": set(),
    "calibrate camera {bad}": set(),
    "calibrate drive {bad}": set(),
    "sim run {bad}": set(),
    "status --settings {bad} --connect {at}": set(),
    "status --keys {bad} --connect {at}": set(),
    "keys list --keys {bad}": set(),
    "keys add r0 --keys {bad}": set(),
    "keys revoke r0 --keys {bad}": set(),
    "keys init --keys {bad}": {"missing", "folder"},
    "server --map {bad} --keys {tmp}/none": set(),
}
"""Command lines, and the kinds of files of which each is right about {bad}."""


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Each kind of file under its name."""
    folder = tmp_path_factory.mktemp("kinds")
    for kind, make in KINDS.items():
        make(folder / kind)
    (folder / "camera.toml").write_text(CAMERA)
    return folder


def state(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b""
        for path in folder.rglob("*")
    }


@pytest.mark.usefixtures("signals")
@pytest.mark.parametrize("line", LINES)
def test_a_wrong_file_is_one_line_and_nothing_is_lost(
    line: str, files: Path, recording: Path, closed: str, tmp_path, monkeypatch, capfd
):
    monkeypatch.chdir(tmp_path)
    for kind in [kind for kind in KINDS if kind not in LINES[line]]:
        values = {
            "bad": files / kind, "map": files / "map", "picture": files / "picture", "at": closed,
            "camera": files / "camera.toml", "out": tmp_path / "out.mapweave", "tmp": tmp_path,
            "recording": recording,
        }  # fmt: skip
        before, kept = state(files), state(tmp_path)
        capfd.readouterr()
        status = main([str(word) for word in shlex.split(line.format(**values))])
        said = capfd.readouterr().err.splitlines()
        assert status in (FAILED, NO, USAGE), kind
        assert len(said) == 1 and said[0].startswith("mapweave: ") and "Errno" not in said[0], (kind, said)
        assert state(files) == before, kind
        left = state(tmp_path)
        assert {name: left[name] for name in kept} == kept, kind
        assert not any(left[name] for name in left.keys() - kept.keys() if not name.endswith(".log")), kind


OUTS = (
    "map show {map} -o {bad}.png", "map merge {map} -o {bad}", "map extract {journal} -o {bad}",
    "map export {map} --format g2o -o {bad}", "map export {map} --format tum -o {bad}",
    "map import {graph} -o {bad}", "map backup {store} -o {bad}", "map fetch {bad} --connect {at}",
    "map retire r0.1.1 --map {map} -o {bad}", "map pin r0.1.1 --map {map} -o {bad}",
    "place add sink r0.1.1 --map {map} -o {bad}", "floor ground r0.1.1 --map {map} -o {bad}",
    "map explain r0.1.1 r1.1.1 --map {map} --draw {bad}.png",
    "map route r0.1.1 r1.1.1 --map {map} --draw {bad}.png",
    "map from-photos {recording}/images --camera {camera} --spacing 1 -o {bad}",
    "keys init --keys {bad}", "keys bundle s0 --keys {keys} -o {bad}", "calibrate target -o {bad}",
    "replay {recording} --offline --data {bad} --name r9", "eval replay {recording} -o {bad}",
    "record r0 --robot create -o {bad}",
)  # fmt: skip
"""Command lines that would write to {bad}."""
PLACES = {"full": "full", "missing": "none/x", "below a file": "map/x"}
"""Where they cannot: a folder with a file of its owner, in a folder that is not there, below a file."""
MADE = {
    ("map extract {journal} -o {bad}", "full"), ("map extract {journal} -o {bad}", "missing"),
    ("map export {map} --format tum -o {bad}", "full"), ("map export {map} --format tum -o {bad}", "missing"),
    ("keys init --keys {bad}", "full"), ("keys init --keys {bad}", "missing"),
    ("replay {recording} --offline --data {bad} --name r9", "full"),
    ("replay {recording} --offline --data {bad} --name r9", "missing"),
    ("eval replay {recording} -o {bad}", "full"), ("eval replay {recording} -o {bad}", "missing"),
    ("map show {map} -o {bad}.png", "missing"),
    ("map explain r0.1.1 r1.1.1 --map {map} --draw {bad}.png", "missing"),
    ("map route r0.1.1 r1.1.1 --map {map} --draw {bad}.png", "missing"),
    ("record r0 --robot create -o {bad}", "missing"),
}  # fmt: skip
"""A folder is what they want there, or they make it."""


@pytest.mark.usefixtures("signals")
@pytest.mark.parametrize("line", OUTS)
def test_a_place_where_nothing_can_be_written_is_one_line(
    line: str, files: Path, recording: Path, closed: str, tmp_path, capfd
):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("keep me")
    (tmp_path / "full.png").mkdir()
    (tmp_path / "map").write_bytes((files / "map").read_bytes())
    graph, store, keys = tmp_path / "in.g2o", write_store(tmp_path / "s0.sqlite", LOGS), tmp_path / "keys"
    graph.write_text("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
    if line.startswith("keys bundle"):
        assert main(["keys", "init", "--keys", str(keys)]) == 0
    for kind, place in PLACES.items():
        if (line, kind) in MADE:
            continue
        values = {
            "bad": tmp_path / place, "map": tmp_path / "map", "journal": files / "journal", "store": store,
            "graph": graph, "at": closed, "camera": files / "camera.toml", "recording": recording,
            "keys": keys,
        }  # fmt: skip
        before = state(tmp_path)
        capfd.readouterr()
        status = main(shlex.split(line.format(**values)))
        said = capfd.readouterr().err.splitlines()
        assert status in (FAILED, NO, USAGE), kind
        assert len(said) == 1 and said[0].startswith("mapweave: ") and "Errno" not in said[0], (kind, said)
        assert state(tmp_path) == before, kind


@pytest.mark.usefixtures("signals")
@pytest.mark.parametrize(("line", "kind"), sorted(one for one in MADE if "--robot" not in one[0]))
def test_a_folder_that_is_there_or_made_keeps_what_was_in_it(
    line: str, kind: str, files: Path, recording: Path, tmp_path
):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("keep me")
    values = {"map": files / "map", "journal": files / "journal", "recording": recording}
    main(shlex.split(line.format(bad=tmp_path / PLACES[kind], **values)))
    assert (tmp_path / "full" / "mine.txt").read_text() == "keep me"


@pytest.mark.parametrize(("line", "words"), [
    ("go r9 r0.1.1", "r9"), ("explore r9", "r9"), ("stop r9", "r9"), ("missions r9", "r9"),
    ("portal done r9", "r9"), ("place add sink r0.1.999", "no node 999"), ("place remove sink", "sink"),
    ("reopen sink", "sink"), ("close r0.1.1 r0.1.999", "no node 999"), ("floor ground r9.1.1", "no map r9.1"),
    ("map pin r9.1.1", "no map r9.1"), ("place add sink kitchn", "kitchn"),
    ("plan export attic --format tf", "attic"), ("place add sink 1,1 --plan attic", "attic"),
    ("status --plan attic", "attic"), ("map portal remove gate", "gate"),
])  # fmt: skip
def test_what_a_running_server_does_not_know_is_one_line_and_nothing_is_kept(
    line: str, words: str, tmp_path, monkeypatch, capfd
):
    hub, keys = MemoryHub(), Keys("demo")
    path = write_store(tmp_path / "s0.sqlite", LOGS)
    with (
        closing(MemoryBus(hub)) as bus,
        MapServer(bus, keys, path, "s0") as server,
        closing(MemoryBus(hub)) as other,
        Fleet(by="anna", bus=other) as fleet,
    ):
        assert server.settle(60.0)
        for module in ("missions", "annotating", "portal", "status"):
            monkeypatch.setattr(f"mapweave.commands.{module}.fleet_of", lambda _: nullcontext(fleet))
        status = main(line.split())
        out, err = capfd.readouterr()
        # Of a mission the report is the answer, and stands on stdout.
        said = (err or out).splitlines()
        assert status in (FAILED, NO), out + err
        assert len(said) == 1 and words in said[0]
        assert fleet.annotations().made == () and not any(one.open for one in fleet.missions())
