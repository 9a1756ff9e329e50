"""One map in a map file, a store and a journal: every command reads them alike, and none is changed."""

import hashlib
import json
import random
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import replace
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from websockets.sync.client import connect

import mapweave
from mapweave import Edge, EdgeKind, HybridMap, ManualConstraint, MapEvent, MapEventKind, Pose2, PoseGaussian
from mapweave.agent.replication.journal import Journal
from mapweave.cli import main
from mapweave.hybridmap.annotation import Annotation, Place
from mapweave.hybridmap.change import ChangeBody, EdgePut, EdgeRetired, NodePut, NodeRetired
from mapweave.hybridmap.constraint_subject import Apart, RetiredNodes
from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.ids import EdgeId, MapId, NodeId
from mapweave.hybridmap.superseded import Superseded
from mapweave.mapserver.content_hash import content_hash
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.opened_map import MapSource, open_map
from mapweave.scenarios.children import Children, free_port
from mapweave.storage.map_file import MapFile, RefusedPair, pack_map_file, unpack_map_file, write_map_file
from mapweave.wire.messages import KeptHistory, encode
from synthetic.maps import fill_store, looked_around
from tests.mapweave.command_line import complaint
from tests.waiting import eventually

R0, R1 = MapId("r0", 1), MapId("r1", 1)
SAID = ManualConstraint(Apart((R0, MapId("r9", 1))), True, "anna", 5, "two kitchens")
KITCHEN = Annotation("kitchen", Place(NodeId("r0", 1, 3)), False, "anna", 6)
EVENT = MapEvent(7, MapEventKind.JOINED, "r0.1 and r1.1 are one map now")


LOGS = looked_around((R0, R1), seed=8)


def annotated_store(path: Path, maps: dict[MapId, list[ChangeBody]]) -> Path:
    store = SqliteStore(path)
    fill_store(store, maps)
    store.add_constraint(encode(SAID))
    store.add_annotation(encode(KITCHEN))
    store.put_result("history", encode(KeptHistory((EVENT,))))
    store.close()
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A store, a journal and map files, with names that say nothing; no file can be written there."""
    made = tmp_path_factory.mktemp("maps")
    annotated_store(made / "store", LOGS)
    journal = Journal(made / "journal", "r0")
    journal.append(journal.open_map(1), LOGS[R0], 0)
    journal.open_map(2)
    journal.close()
    write_map_file(made / "own", MapFile("agent", "r0.1", tuple(LOGS[R0])))
    assert main(["map", "merge", str(made / "store"), "-o", str(made / "merged")]) == 0
    made.chmod(0o555)
    yield made
    made.chmod(0o755)


def rounded(words: str) -> str:
    """To a tenth of a millimetre: poses of a merge and of its file differ in their last bits."""
    return re.sub(r"-?\d+\.\d+(e-?\d+)?", lambda number: f"{float(number[0]) + 0.0:.4f}", words)


def state(folder: Path) -> dict[str, tuple[str, int]]:
    return {
        path.name: (hashlib.sha256(path.read_bytes()).hexdigest(), path.stat().st_mtime_ns)
        for path in folder.iterdir()
    }


def test_what_it_is_shows_the_content(folder: Path):
    before = state(folder)
    opened = {name: open_map(folder / name) for name in ("store", "journal", "own", "merged")}
    assert state(folder) == before
    assert [one.source for one in opened.values()] == [
        MapSource.STORE, MapSource.JOURNAL, MapSource.FILE, MapSource.FILE,
    ]  # fmt: skip
    assert opened["store"].maps == (R0, R1) and opened["journal"].maps == (R0, MapId("r0", 2))
    assert opened["store"].content.constraints == (SAID,)
    assert opened["store"].content.annotations == (KITCHEN,) and opened["store"].content.history == (EVENT,)
    assert not any(one.complaints for one in opened.values())
    stored, filed = opened["store"].merged(), opened["merged"].merged()
    assert [link.pair for link in stored.links] == [link.pair for link in filed.links] != []
    assert content_hash(opened["store"].file(stored)) == content_hash(opened["merged"].content)
    assert content_hash(opened["journal"].content) == content_hash(opened["own"].content)


def test_python_and_shell_open_the_same_map(folder: Path, tmp_path, capsys):
    """Of a store with a single map Python showed nodes as in use that a person had retired."""
    one = annotated_store(tmp_path / "one.sqlite", {R0: LOGS[R0]})
    corrected = annotated_store(tmp_path / "corrected.sqlite", {R0: LOGS[R0]})
    gone = NodeId("r0", 1, 3)
    with closing(SqliteStore(corrected)) as store:
        store.add_constraint(encode(ManualConstraint(RetiredNodes((gone,)), True, "anna", 7, "it is new")))
    withdrawn = annotated_store(tmp_path / "withdrawn.sqlite", {R0: LOGS[R0]})
    with closing(SqliteStore(withdrawn)) as store:
        store.add_constraint(encode(replace(SAID, holds=False, stamp_ns=8)))
    for path in (one, corrected, withdrawn, *map(folder.joinpath, ("store", "journal", "own", "merged"))):
        capsys.readouterr()
        assert main(["map", "show", str(path), "--json", "--no-picture"]) == 0
        shown = json.loads(capsys.readouterr().out)
        room = mapweave.open(path)
        assert (room.hash, room.content.kind) == (shown["content_hash"], shown["kind"]), path.name
    assert gone in mapweave.open(corrected).content.retired
    assert str(gone) not in mapweave.open(corrected).nodes.ids


@pytest.mark.slow
def test_every_command_reads_all_three_alike(folder: Path, tmp_path, capfd):
    before = state(folder)

    def answers(name: str, start: str, goal: str) -> list[str]:
        """What the commands answer about a map, without its place and kind."""
        path, out = folder / name, tmp_path / name
        lines = []
        for arguments in (
            ("show", path, "--json", "--out", tmp_path / "map.png"), ("explain", "--json", "--map", path),
            ("route", start, goal, "--json", "--map", path), ("history", "--map", path),
            ("export", path, "--format", "graphml", "-o", out / "x.graphml"),
            ("extract", path, "-o", out / "parts"), ("merge", path, "-o", out / "m.mapweave"),
        ):  # fmt: skip
            out.mkdir(exist_ok=True)
            assert main(["map", *map(str, arguments)]) == 0, capfd.readouterr().err
            lines.append(rounded(capfd.readouterr().out.replace(str(out), "")))
        shown = json.loads(lines[0])
        own = ("file", "bytes", "source", "kind", "title")
        parts = {path.name: path.read_bytes() for path in (out / "parts").iterdir()}
        assert parts
        exported = rounded((out / "x.graphml").read_text())
        shown = {name: value for name, value in shown.items() if name not in own}
        return [str(shown), *lines[1:], exported, str(parts), (out / "m.mapweave").read_bytes().hex()]

    assert answers("store", "r0.1.1", "r1.1.7") == answers("merged", "r0.1.1", "r1.1.7")
    journal, own = (answers(name, "r0.1.1", "r0.1.7") for name in ("journal", "own"))
    assert [line for line in journal if "r0.2" not in line] == [
        line for line, other in zip(own, journal, strict=True) if "r0.2" not in other
    ]
    assert state(folder) == before


def test_commands_that_change_a_map_refuse_stores_and_journals(folder: Path, tmp_path, capfd):
    for name in ("store", "journal", "own"):
        copy = tmp_path / name
        shutil.copyfile(folder / name, copy)
        before = copy.read_bytes()
        for command in (("unmerge", "r0.1", "r1.1"), ("retire", "r0.1")):
            assert "and is not changed" in complaint(capfd, "map", *command, "--map", copy)
        assert copy.read_bytes() == before and {path.name for path in tmp_path.iterdir()} == {name}
        copy.unlink()


def test_no_command_writes_over_a_store_a_journal_a_map_or_notes(folder: Path, tmp_path, capfd):
    """With `-o` the file that is read, or another one, was replaced without a word."""
    for name in ("store", "journal", "merged"):
        shutil.copyfile(folder / name, tmp_path / name)
    (tmp_path / "notes").write_text("of a year")
    before = state(tmp_path)
    commands = [
        ("merge", "merged", "-o"), ("unmerge", "r0.1", "r1.1", "--map", "store", "-o"),
        ("pin", "r0.1.1", "--map", "merged", "-o"), ("export", "merged", "--format", "g2o", "-o"),
    ]  # fmt: skip
    for command in commands:
        given = [tmp_path / word if (tmp_path / word).exists() else word for word in command]
        for name in ("store", "journal"):
            words = complaint(capfd, "map", *given, tmp_path / name)
            assert words.endswith("(a server's store or an agent's journal is there; give another name)")
        if command[0] != "export":
            words = complaint(capfd, "map", *given, tmp_path / "notes")
            assert words.endswith("(a file that is no map is there; give another name)")
    words = complaint(capfd, "map", *given, tmp_path / "merged")
    assert words.endswith("(a map file is there; give another name)")
    assert state(tmp_path) == before
    journal = tmp_path / "journal"
    words = complaint(capfd, "place", "add", "hall", "r0.1.1", "--map", journal)
    assert words == f"mapweave: {journal} is an agent's journal, which is not written: give -o"


@pytest.mark.parametrize("name", ["store", "merged"])
def test_a_constraint_on_a_store_goes_into_a_file(folder: Path, tmp_path, name: str, capfd):
    """They were refused with `-o`, too, while places and closures were taken."""
    before, out = state(folder), tmp_path / "out.mapweave"
    command = ("map", "unmerge", "r0.1", "r1.1", "--map", str(folder / name))
    assert main([*command, "--check"]) == 0 and not out.exists()
    assert "only checked, nothing is changed: " in capfd.readouterr().out
    assert main([*command, "-o", str(out), "--because", "two like rooms"]) == 0
    assert state(folder) == before
    content = open_map(out).content
    assert len({component for component, _ in content.poses.values()}) == 2
    assert content.constraints[0] == SAID and content.constraints[1].because == "two like rooms"
    assert content.annotations == (KITCHEN,) and EVENT in content.history
    assert main(["map", "undo", "2", "--map", str(out)]) == 0
    again = open_map(out)
    assert len({component for component, _ in again.content.poses.values()}) == 1
    links = [link.pair for link in again.merged().links]
    assert links == [link.pair for link in open_map(folder / "merged").merged().links] != []


@pytest.mark.parametrize("name", ["journal", "own"])
def test_a_constraint_on_a_robots_own_map_goes_into_a_file(folder: Path, tmp_path, name: str):
    before, out = state(folder), tmp_path / "out.mapweave"
    assert main(["map", "retire", "r0.1.3", "--map", str(folder / name), "-o", str(out)]) == 0
    assert state(folder) == before
    kept = {node for node in HybridMap(LOGS[R0]).nodes if node != NodeId("r0", 1, 3)}
    assert open_map(out).content.poses.keys() == kept


@pytest.mark.slow
def test_a_store_whose_server_was_killed_is_read_with_its_last_commits(tmp_path):
    path = tmp_path / "s0.sqlite"
    code = (
        "import os, sys; from pathlib import Path\n"
        "from mapweave.mapserver.log.sqlite_store import SqliteStore\n"
        "from tests.mapweave.test_opened_map import LOGS, R0, annotated_store\n"
        "store = SqliteStore(Path(sys.argv[1])); store.put_result('history', b'x' * 9)\n"
        "SqliteStore.close = lambda self: os._exit(0)\n"
        "store._database.close(); annotated_store(Path(sys.argv[1]), {R0: LOGS[R0]})\n"
    )
    subprocess.run([sys.executable, "-c", code, str(path)], check=True, cwd=Path(__file__).parents[2])
    assert path.with_name("s0.sqlite-wal").stat().st_size > 0
    before = state(tmp_path)
    assert content_hash(open_map(path).content) == content_hash(
        MapFile("agent", "", tuple(LOGS[R0]), constraints=(SAID,), annotations=(KITCHEN,))
    )
    assert state(tmp_path) == before


@pytest.mark.parametrize("name", ["store", "journal", "merged"])
def test_a_cut_off_or_newer_file_is_reported_in_one_line(folder: Path, tmp_path, name: str, capfd):
    data = (folder / name).read_bytes()
    path = tmp_path / name
    for length in (0, 3, 12, 50, len(data) // 2):
        path.write_bytes(data[:length])
        for command in (
            ("show", path, "--no-picture"),
            ("explain", "--map", path),
            ("history", "--map", path),
        ):
            # Of half a store or journal the rest is shown, with a complaint.
            if main(["map", *map(str, command)]) == 0:
                assert name in ("store", "journal") and length > 50
            assert len(capfd.readouterr().err.splitlines()) >= 1
    # The version: of map files behind the magic, of SQLite's user_version at byte 60 of its header.
    at = 8 if name == "merged" else 60
    path.write_bytes(data[:at] + b"\1\1\1\1" + data[at + 4 :])
    said = complaint(capfd, "map", "show", path)
    assert "format" in said and "a newer version of Mapweave has written it: upgrade this one" in said


@pytest.mark.slow
def test_a_map_is_served_to_people_and_never_changed(folder: Path, tmp_path):
    before = state(folder)
    with Children(tmp_path) as children:
        port = free_port()
        children.start("open", ["open", str(folder / "store"), "--http", str(port)])

        def ask(path: str, body: bytes | None = None) -> tuple[int, Any]:
            connection = HTTPConnection("127.0.0.1", port, timeout=60)
            connection.request("GET" if body is None else "POST", path, body, {"Content-Type": "image/png"})
            reply = connection.getresponse()
            content = reply.read()
            connection.close()
            return reply.status, json.loads(content) if "json" in reply.headers["Content-Type"] else content

        def up() -> bool:
            children.check()
            with suppress(OSError):
                return ask("/status")[0] == 200
            return False

        eventually(up, 90.0)
        with connect(f"ws://127.0.0.1:{port}/live") as live:
            hello = json.loads(live.recv(30))
            assert hello["kind"] == "hello" and hello["read_only"] and not hello["commands"]
            shown = json.loads(live.recv(30))
            assert shown["kind"] == "map" and shown["nodes"]["count"] == len(NODES)
        status, page = ask("/")
        assert status == 200 and b"<html" in page
        counts, links = ask("/status")[1], open_map(folder / "merged").merged().links
        assert counts["links"] == len(links) > 0 and counts["source"] == "server's store"
        assert ask("/robots")[1]["robots"] == ask("/missions")[1]["reports"] == []
        kinds = [event["kind"] for event in ask("/history")[1]["history"]]
        assert kinds == ["constrained", "annotated", "joined"]
        link = links[0].pair
        assert ask(f"/explain?a={link[0]}&b={link[1]}")[1]["standing"] == "linked"
        assert ask(f"/route?a={link[0]}&b={link[1]}")[1]["found"]
        content = unpack_map_file(ask("/map")[1])
        assert content_hash(content) == content_hash(open_map(folder / "merged").content)
        for path in ("/robots/r0/go?goal=r0.1.1", "/robots/r0/explore", "/robots/r0/stop"):
            status, answer = ask(path, b"")
            assert status == 400 and "is only shown, and nothing of it changes" in answer["error"]
        grey = np.random.default_rng(0).integers(0, 255, (120, 160)).astype(np.uint8)
        status, answer = ask("/relocalize", cv2.imencode(".png", grey)[1].tobytes())
        assert status == 200 and answer["certainty"] == "unknown"
        children.end("open")
    assert state(folder) == before


CONTENTS = [body for changes in LOGS.values() for body in changes]
NODES = [body.node.id for body in CONTENTS if isinstance(body, NodePut)]
LINK = Edge(
    EdgeId("merge", 0, 1), NODES[0], NODES[4], PoseGaussian.from_sigmas(Pose2(), 0.1, 0.1), EdgeKind.MERGED,
    evidence={"inliers": 9.0, "matches": 20.0},
)  # fmt: skip
WHOLE = MapFile(
    "merged", "two robots", (*CONTENTS, EdgePut(LINK)), {NODES[0]: (0, LINK.a_from_b)},
    (RefusedPair(NODES[1], NODES[5], "too far"), RefusedPair(NODES[2], NODES[5], "too far")),
    (SAID, replace(SAID, holds=False, stamp_ns=6)),
    {NODES[1]: Superseded(NODES[2], 12, 0.1, 0.2), NODES[3]: Superseded(NODES[4], 12, 0.1, 0.2)},
    {}, (EVENT,), retired={NODES[6]: 0, NODES[7]: 0},
    annotations=(KITCHEN, replace(KITCHEN, removed=True)),
)  # fmt: skip


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.randoms(use_true_random=False), st.integers(0, len(NODES) - 1))
def test_the_same_map_has_the_same_hash_however_it_is_written(shuffle: random.Random, gone: int):
    edges = [body for body in WHOLE.changes if isinstance(body, EdgePut)]
    nodes = [body for body in WHOLE.changes if isinstance(body, NodePut)]
    # Drafts that are replaced, an edge and a node that are retired, all in another order.
    draft = NodePut(replace(nodes[gone].node, stamp_ns=1))
    extra = NodePut(replace(nodes[gone].node, id=NodeId("r0", 1, 999)))
    loose = EdgePut(replace(LINK, id=EdgeId("merge", 0, 2)))
    shuffle.shuffle(nodes)
    shuffle.shuffle(edges)
    changes = (draft, extra, *nodes, loose, *edges, EdgeRetired(loose.edge.id), NodeRetired(extra.node.id))
    changes = tuple(
        EdgePut(replace(b.edge, evidence=dict(reversed([*b.edge.evidence.items()], ), probability=0.5)))
        if isinstance(b, EdgePut) and b.edge.id == LINK.id else b
        for b in changes
    )  # fmt: skip
    other = replace(
        WHOLE, title="renamed", changes=changes, poses={}, history=(), refused=WHOLE.refused[::-1],
        superseded=dict(reversed(list(WHOLE.superseded.items()))),
        retired=dict(reversed(list(WHOLE.retired.items()))),
    )  # fmt: skip
    expected = content_hash(WHOLE)
    assert content_hash(other) == expected == content_hash(unpack_map_file(pack_map_file(other)))


@pytest.mark.parametrize("other", [
    replace(WHOLE, changes=WHOLE.changes[:-1]),
    replace(WHOLE, changes=(*WHOLE.changes[:-1], EdgePut(replace(LINK, evidence={"inliers": 8.0})))),
    replace(WHOLE, changes=(NodePut(replace(CONTENTS[0].node, stamp_ns=1)), *WHOLE.changes[1:])),  # type: ignore[union-attr]
    replace(WHOLE, refused=WHOLE.refused[:1]),
    replace(WHOLE, constraints=WHOLE.constraints[::-1]),
    replace(WHOLE, annotations=WHOLE.annotations[::-1]),
    replace(WHOLE, superseded={}),
    replace(WHOLE, retired={NODES[6]: 0, NODES[7]: 1}),
    replace(WHOLE, faded={NODES[0]: np.zeros(len(CONTENTS[0].node.landmarks), bool)}),  # type: ignore[union-attr]
])  # fmt: skip
def test_another_map_has_another_hash(other: MapFile):
    assert content_hash(other) != content_hash(WHOLE)


def test_the_map_of_an_agent_that_runs_is_said_to_be_in_its_journal(tmp_path):
    """`no such file`, said `map show` of the map that the agent was making."""
    (tmp_path / "r0.sqlite").touch()
    for name, words in {
        "r0.1": f"{tmp_path / 'r0.1.mapweave'}: no such file yet: the agent of r0 writes it when it ends; "
        "while it runs ask the server, `mapweave map fetch FILE`, and after it was killed take it from the "
        f"journal, `mapweave map extract {tmp_path / 'r0.sqlite'}`",
        "r1.1": f"{tmp_path / 'r1.1.mapweave'}: no such file",
        "r0": f"{tmp_path / 'r0.mapweave'}: no such file",
    }.items():
        with pytest.raises(InvalidFile) as error:
            open_map(tmp_path / f"{name}.mapweave")
        assert str(error.value) == words
