"""A journal in which the disk has changed some bytes: it is found, and nothing else is altered for it."""

import logging
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mapweave import Camera, Edge, EdgeKind, Landmarks, MapId, Node, NodeId, Pose2, PoseGaussian
from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.retained_map import RetainedMap
from mapweave.agent.replication.salvage import salvage
from mapweave.hybridmap.change import ChangeBody, EdgePut, NodePut, NodeRetired
from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.mission_order import MissionKind, MissionOrder, MissionReport, MissionState
from mapweave.hybridmap.quantization import settle
from mapweave.wire.codec import encode_body

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.25)
MAP = MapId("r0", 1)


class Contents(NamedTuple):
    """All that a journal says, to its robot and to servers."""

    missions: list[MissionReport]
    logs: list[tuple[MapId, int, int, dict[str, int]]]
    rows: list[tuple[int, bytes]]
    kept: list[bytes]
    next_number: int
    complaint: str


def contents_of(path: Path) -> Contents:
    with closing(Journal(path, "r0")) as journal:
        logs = [(m, journal.log_id(m), journal.head(m), journal.acknowledged(m)) for m in journal.maps()]
        kept = RetainedMap.of(journal, MAP)
        return Contents(
            journal.missions(), logs, journal.rows(MAP, 1, journal.head(MAP)),
            list(map(encode_body, kept.contents)), kept.next_number, kept.complaint,
        )  # fmt: skip


def log_of(count: int) -> list[ChangeBody]:
    """Nodes with 150 landmarks and edges between them, the last of which is retired."""
    rng = np.random.default_rng(1)
    log: list[ChangeBody] = []
    for k in range(count):
        pixels = rng.uniform((0, 0), (320, 240), (150, 2)).astype(np.float32)
        depths = rng.uniform(1, 9, 150).astype(np.float32)
        codes = rng.integers(20, 44, (150, 32)).astype(np.uint8)
        landmarks, _ = settle(Landmarks(pixels, codes, depths, depths / 20), CAMERA)
        here = PoseGaussian.from_sigmas(Pose2(k, 0, 0), 0.1, 0.1)
        log.append(NodePut(Node(NodeId(*MAP, 2 * k + 1), k * 10**9, here, CAMERA, landmarks)))
        if k:
            ends = NodeId(*MAP, 2 * k - 1), NodeId(*MAP, 2 * k + 1)
            log.append(EdgePut(Edge(NodeId(*MAP, 2 * k), *ends, here, EdgeKind.MAPPED)))
    return [*log, NodeRetired(NodeId(*MAP, 2 * count - 1))]


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("sound") / "r0.sqlite"
    with closing(Journal(path, "r0")) as journal:
        journal.open_map(1)
        for k, body in enumerate(log_of(12)):
            journal.append(MAP, [body], 1_795_889_292_000_000_000 + k)
        journal.acknowledge("s0", MAP, 20)
        order = MissionOrder("8568c073a3a9", "r0", MissionKind.GO, 1, "anna", NodeId("r2", 1, 22))
        journal.keep_missions([MissionReport(order, MissionState.RUNNING)])
    return path.read_bytes()


@pytest.fixture(scope="module")
def before(sound: bytes, tmp_path_factory: pytest.TempPathFactory) -> Contents:
    path = tmp_path_factory.mktemp("before") / "r0.sqlite"
    path.write_bytes(sound)
    return contents_of(path)


def check_damaged(path: Path, before: Contents, damaged: bytes, caplog: pytest.LogCaptureFixture) -> bool:
    """Nothing changes without a line; returns whether the damage was found."""
    path.write_bytes(damaged)
    caplog.clear()
    try:
        after = contents_of(path)
    except InvalidFile as error:
        assert "\n" not in str(error)
        return True
    if not after.complaint and not caplog.messages:
        assert after == before
        return False
    # What is left is what was written.
    assert set(after.rows) - set(before.rows) <= {(sequence, b"") for sequence, _ in before.rows}
    assert after.next_number == before.next_number
    lacks = set(after.kept) ^ set(before.kept)
    assert len(lacks) <= 3, "a node and its edges, or a node that was retired"
    assert after.logs == before.logs or after.logs == [(*log[:3], {}) for log in before.logs]
    return True


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_bytes_that_the_disk_has_changed_alter_nothing_without_a_line(
    sound: bytes, before: Contents, tmp_path_factory, caplog, data: st.DataObject
):
    offset = data.draw(st.integers(0, len(sound) - 4))
    written = data.draw(st.binary(min_size=1, max_size=4))
    damaged = sound[:offset] + written + sound[offset + len(written) :]
    check_damaged(tmp_path_factory.mktemp("damage") / "r0.sqlite", before, damaged, caplog)


def test_a_change_whose_number_or_stamp_is_damaged_is_found(sound: bytes, before: Contents, tmp_path, caplog):
    """Bytes before the body of a change were not checked: stamps and numbers were wrong without a word."""
    path = tmp_path / "r0.sqlite"
    path.write_bytes(sound)
    with closing(sqlite3.connect(path)) as disk:
        bodies = [body for (body,) in disk.execute("SELECT body FROM change ORDER BY sequence")]
    found = 0
    # A node, an edge, and the retirement, which is the newest change.
    for body in (bodies[4], bodies[5], bodies[-1]):
        begin = sound.index(body[:40])
        for offset in range(begin - 16, begin):
            damaged = bytearray(sound)
            damaged[offset] ^= 1 << offset % 7
            found += check_damaged(path, before, bytes(damaged), caplog)
    assert found > 40


@pytest.mark.parametrize("column", ["sequence", "stamp_ns", "element", "put"])
def test_a_damaged_number_is_refused_and_the_others_can_be_extracted(column: str, sound: bytes, tmp_path):
    path = tmp_path / "r0.sqlite"
    path.write_bytes(sound)
    whole = len(salvage(path).maps[MAP].contents)
    with closing(sqlite3.connect(path)) as disk, disk:
        disk.execute(f"UPDATE change SET {column} = {column} + 256 WHERE sequence = 21")
    with pytest.raises(InvalidFile, match=r"r0\.sqlite: agent journal is damaged .* `mapweave map extract"):
        Journal(path, "r0")
    salvaged = salvage(path).maps[MAP]
    assert salvaged.complaint.startswith("1 of ")
    # Change 21 is a node with an edge before it and one behind it, which is gone for the retired node.
    assert whole - len(salvaged.contents) <= 3


def test_acknowledgements_that_are_damaged_are_asked_for_again(sound: bytes, tmp_path, caplog):
    """A greater one lets what a server has not got be dropped."""
    path = tmp_path / "r0.sqlite"
    path.write_bytes(sound)
    with closing(sqlite3.connect(path)) as disk, disk:
        disk.execute("UPDATE ack SET watermark = 22")
    with closing(Journal(path, "r0")) as journal:
        assert journal.acknowledged(MAP) == {}
        assert "are asked again" in caplog.text
        journal.acknowledge("s0", MAP, 20)
    caplog.clear()
    with closing(Journal(path, "r0")) as journal:
        assert journal.acknowledged(MAP) == {"s0": 20} and not caplog.text


def test_another_log_id_than_was_written_is_refused(sound: bytes, tmp_path):
    path = tmp_path / "r0.sqlite"
    path.write_bytes(sound)
    with closing(sqlite3.connect(path)) as disk, disk:
        disk.execute("UPDATE map SET log_id = log_id - 1")
    with pytest.raises(InvalidFile, match="its list of maps"):
        Journal(path, "r0")


def test_a_damaged_mission_is_left_out_with_a_line(sound: bytes, tmp_path, caplog):
    """It was believed: a goal could be another one, to which the robot drove."""
    assert sound.count(b"anna") == 1
    path = tmp_path / "r0.sqlite"
    path.write_bytes(sound.replace(b"anna", b"anne"))
    with caplog.at_level(logging.WARNING), closing(Journal(path, "r0")) as journal:
        assert journal.missions() == []
    assert "a mission is damaged" in caplog.text


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, bytes]:
    """Database and log of an agent that was killed: nothing has come from the log into the database."""
    path = tmp_path_factory.mktemp("killed") / "r0.sqlite"
    with closing(Journal(path, "r0")) as journal:
        journal.open_map(1)
        for k, body in enumerate(log_of(12)):
            journal.append(MAP, [body], k)
        return path.read_bytes(), path.with_name("r0.sqlite-wal").read_bytes()


def left_behind(path: Path, killed: tuple[bytes, bytes], log: bytes) -> Path:
    path.write_bytes(killed[0])
    path.with_name("r0.sqlite-wal").write_bytes(log)
    return path


@pytest.mark.parametrize("place", [0, 9, 20, 28, 40, 3000, 0.1, 0.3, 0.6, 0.8, 0.9])
def test_damage_in_the_log_of_an_agent_that_was_killed_is_found(
    place: float, killed: tuple[bytes, bytes], tmp_path
):
    """SQLite went on as if all that follows had never been made: the robot had a part of its map, or none."""
    log = bytearray(killed[1])
    log[int(place * len(log)) if isinstance(place, float) else place] ^= 4
    path = left_behind(tmp_path / "r0.sqlite", killed, bytes(log))
    for _ in range(2):
        with pytest.raises(
            InvalidFile, match=r"journal is damaged \(its last \d+ commits cannot be read\); save"
        ):
            Journal(path, "r0")
    assert path.with_name("r0.sqlite-wal").read_bytes() == log, "nothing is changed"
    if isinstance(place, float) and place >= 0.3:
        salvaged = salvage(path)
        assert not salvaged.whole and 1 <= len(salvaged.maps[MAP].contents) <= 22


def test_a_log_that_a_loss_of_power_has_cut_short_goes_on(killed: tuple[bytes, bytes], tmp_path):
    """The last commit was not on the disk yet, in whole or in part: it was never acknowledged."""
    whole = contents_of(left_behind(tmp_path / "r0.sqlite", killed, killed[1]))
    assert whole.logs[0][2] == 24
    damaged = bytearray(killed[1])
    damaged[-2000] ^= 1
    for k, log in enumerate((bytes(damaged), killed[1][:-1], killed[1][:-4000], killed[1][:20], b"")):
        folder = tmp_path / str(k)
        folder.mkdir()
        path = left_behind(folder / "r0.sqlite", killed, log)
        with closing(Journal(path, "r0")) as journal:
            assert len(log) < 100 or journal.head(MAP) == 23


@settings(max_examples=20, deadline=None)
@given(st.lists(st.integers(1, 5), min_size=1, max_size=8), st.integers(0, 6))
def test_a_log_that_holds_is_never_refused(tmp_path_factory, sizes: list[int], checkpoint: int):
    """Also one that SQLite has begun again: what is behind its end is of before."""
    folder = tmp_path_factory.mktemp("log")
    path, log = folder / "r0.sqlite", log_of(6)
    with closing(Journal(path, "r0")) as journal:
        journal.open_map(1)
        for k, size in enumerate(sizes):
            journal.append(MAP, log[:size], k)
            if k == checkpoint:
                journal._database.connection.execute("PRAGMA wal_checkpoint(RESTART)")
        files = path.read_bytes(), path.with_name("r0.sqlite-wal").read_bytes()
    other = folder / "copy"
    other.mkdir()
    with closing(Journal(left_behind(other / "r0.sqlite", files, files[1]), "r0")) as journal:
        assert journal.head(MAP) == sum(sizes)
