"""The benchmark that kills: whether its account finds what is lost, and a short run of the whole."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import ClassVar

import pytest
from rich.progress import Progress

from benchmarks.chaos.account import Account, BrokenLog, account, sent_changes
from benchmarks.chaos.agent_process import STAMP, digest
from benchmarks.chaos.benchmark import comes_true, good, percentile, relocalize_gaps, together
from benchmarks.chaos.disorder import ChangeListener, DisorderedBus, flag
from benchmarks.chaos.fleet_processes import NO_DATABASE, FleetProcesses
from benchmarks.chaos.recovery import NEVER, RobotTimes, recoveries
from benchmarks.chaos.schedule import KILLS, LEAST_KILLS, Kind, draw_schedule
from benchmarks.chaos.scripted_robot import ScriptedRobot
from mapweave.agent.replication.journal import Journal
from mapweave.hybridmap.change import Change
from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.log.entry import ReceivedChange
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.scenarios.children import ChildFailed
from mapweave.wire.codec import element_of, encode_change
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import Mark
from mapweave.wire.memory import MemoryBus, MemoryHub
from tests.programs import python
from tests.waiting import eventually

STEPS = 40
GROUPS = (("r0", "r1"), ("s0", "s1"), ("z0", "z1"))


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a robot's log, its journal, and a store that has it all."""
    folder, script = tmp_path_factory.mktemp("written"), ScriptedRobot(0, 5)
    journal, store = Journal(folder / "r0.sqlite", "r0"), SqliteStore(folder / "s0.sqlite")
    journal.open_map(1)
    lines, head = [], 0
    for step in range(1, STEPS + 1):
        bodies = script.step()
        head += len(journal.append(script.map, bodies, step * STAMP))
        lines += [f"T {step} {len(bodies)} {digest(bodies)}", f"C {step} {head} {step / 10}"]
    (folder / "r0.truth").write_text("\n".join(lines))
    entries = [
        ReceivedChange.read(script.map, one.sequence, encode_change(one))
        for one in sent_changes(folder, 0, 5)
    ]
    store.apply(script.map, journal.log_id(script.map), entries)
    journal.close()
    store.close()
    return folder


@pytest.fixture
def fleet(written: Path, tmp_path: Path) -> Iterator[tuple[list[Change], Journal, SqliteStore]]:
    """A copy of it, open: what was sent, the journal and the store."""
    shutil.copytree(written, tmp_path, dirs_exist_ok=True)
    sent = sent_changes(tmp_path, 0, 5)
    journal, store = Journal(tmp_path / "r0.sqlite", "r0"), SqliteStore(tmp_path / "s0.sqlite")
    with closing(journal), closing(store):
        yield sent, journal, store


def changed(store: SqliteStore, path: Path, sql: str) -> SqliteStore:
    """The store after something was done to it behind its back."""
    store.close()
    disk = sqlite3.connect(path)
    disk.execute(sql)
    disk.commit()
    disk.close()
    return SqliteStore(path)


def test_all_that_was_sent_is_stored(fleet: tuple[list[Change], Journal, SqliteStore]):
    sent, journal, store = fleet
    assert len(sent) > STEPS
    assert account(sent, journal, [store]) == Account(sent=len(sent), stored=len(sent))


def test_what_a_store_lacks_is_lost(fleet: tuple[list[Change], Journal, SqliteStore], tmp_path):
    sent, journal, store = fleet
    newest = {element_of(one.body): one.sequence for one in sent}
    final = max(newest.values())
    with closing(
        changed(store, tmp_path / "s0.sqlite", f"DELETE FROM change WHERE sequence = {final}")
    ) as lacking:
        found = account(sent, journal, [lacking])
    assert (found.lost, found.stored, found.maps_equal) == (1, len(sent) - 1, False)


def test_what_a_robot_has_dropped_since_it_was_undone_is_not_lost(
    fleet: tuple[list[Change], Journal, SqliteStore], tmp_path
):
    sent, journal, store = fleet
    journal.acknowledge("s0", sent[0].map, len(sent))
    dropped = journal.prune(sent[0].map, ["s0"])
    assert dropped > 0
    kept = {one.sequence for one in journal.changes(sent[0].map, 1, len(sent))}
    gone = ", ".join(str(one.sequence) for one in sent if one.sequence not in kept)
    with closing(
        changed(store, tmp_path / "s0.sqlite", f"DELETE FROM change WHERE sequence IN ({gone})")
    ) as lacking:
        found = account(sent, journal, [lacking])
    assert (found.lost, found.undone, found.maps_equal) == (0, dropped, True)


def test_what_a_store_deletes_of_a_large_map_is_not_lost(
    fleet: tuple[list[Change], Journal, SqliteStore], monkeypatch
):
    """The journal may have it still; of a small map a store deletes nothing."""
    sent, journal, store = fleet
    superseded = [sequence for sequence, _ in store.superseded(sent[0].map, len(sent))]
    assert superseded
    store.drop(sent[0].map, superseded)
    assert account(sent, journal, [store]).lost == len(superseded)
    monkeypatch.setattr("benchmarks.chaos.account.LEAST_GROWN", 1000)
    found = account(sent, journal, [store])
    assert (found.lost, found.undone, found.maps_equal) == (0, len(superseded), True)
    final = max(set(range(1, len(sent) + 1)) - set(superseded))
    store.drop(sent[0].map, [final])
    assert account(sent, journal, [store]).lost == 1


def test_what_is_twice_or_elsewhere_is_counted(fleet: tuple[list[Change], Journal, SqliteStore]):
    sent, journal, store = fleet
    # As if the last change had been taken twice, the second time under the next number.
    twice = ReceivedChange.read(
        sent[0].map, len(sent) + 1, encode_change(replace(sent[-1], sequence=len(sent) + 1))
    )
    store.apply(sent[0].map, journal.log_id(sent[0].map), [twice])
    found = account(sent, journal, [store])
    assert (found.duplicated, found.out_of_order, found.lost) == (1, 1, 0)


def test_a_journal_that_forgot_a_committed_change_has_lost_it(
    fleet: tuple[list[Change], Journal, SqliteStore], tmp_path
):
    sent, journal, store = fleet
    journal.close()
    disk = sqlite3.connect(tmp_path / "r0.sqlite")
    disk.execute(f"DELETE FROM change WHERE sequence = {len(sent)}")
    disk.commit()
    disk.close()
    with closing(Journal(tmp_path / "r0.sqlite")) as shorter:
        assert account(sent, shorter, [store]).lost == 1


def test_a_log_that_contradicts_itself_is_no_measure(
    fleet: tuple[list[Change], Journal, SqliteStore], tmp_path
):
    del fleet
    path = tmp_path / "r0.truth"
    path.write_text(path.read_text().replace(" 2 ", " 1 ", 1))
    with pytest.raises(BrokenLog):
        sent_changes(tmp_path, 0, 5)


def test_recovery_ends_with_the_last_acknowledgement(tmp_path):
    (tmp_path / "r0.truth").write_text("C 1 1 10.0\nC 2 3 11.0\nC 3 4 20.0\n")
    (tmp_path / "r0.acks").write_text("s0 1 10.1\ns0 3 14.5\ns1 3 11.5\ns0 4 20.1\ns1 4 20.2\n")
    robots = [RobotTimes(tmp_path, "r0")]

    def took(end: float, kind: Kind = Kind.KILL, target: str = "s0") -> float:
        return recoveries(robots, ("s0", "s1"), [(end, kind, target)])[0]

    assert took(12.0) == pytest.approx(2.5), "s0 has the third change at 14.5"
    assert took(15.0) == 0.0
    # What a server had before its store was deleted does not count.
    assert took(15.0, Kind.LOSE_STORE, "s1") == pytest.approx(5.2)
    assert took(21.0, Kind.LOSE_STORE, "s1") == NEVER


def test_a_schedule_is_that_of_its_seed_and_kills_often_enough():
    def draw(seed: int) -> list[object]:
        return list(draw_schedule(10.0, GROUPS, seed, True))

    assert draw(1) == draw(1) != draw(2)
    for seed in range(20):
        schedule = draw_schedule(60.0, GROUPS, seed, True)
        assert sum(one.kind in KILLS for one in schedule) >= LEAST_KILLS
        lossy = {one.target[0] for one in schedule if one.kind is Kind.LOSSY}
        disordered = {one.target[0] for one in schedule if one.kind is Kind.DISORDER}
        assert lossy == disordered == {"r", "s"}, "links and messages of robots and of servers"
        for name in ("r0", "s1", "z0"):
            mine = [one for one in schedule if one.target == name]
            assert mine and all(a.at + a.lasts <= b.at for a, b in pairwise(mine))


ON_SQLITE = {
    "store": "sqlite", "sent": 3, "stored": 3, "undone": 0, "lost": 0, "duplicated": 0, "out_of_order": 0,
    "unacknowledged": 0, "maps_equal": True, "recovery_s_p50": 1.0, "recovery_s_p95": 2.0,
    "relocalize_gap_s": 0.3, "frozen_router_gap_s": 5.0, "kills": 20, "lost_stores": 1, "stops": 7,
    "cuts": 11, "lossy": 2, "disorders": 7, "doubled": 5, "reordered": 3,
}  # fmt: skip


def test_messages_come_twice_and_late_and_none_is_lost(hub: MemoryHub, tmp_path, monkeypatch):
    monkeypatch.setattr("benchmarks.chaos.disorder.LONGEST", 0.5)
    robot, server, keys = MemoryBus(hub), MemoryBus(hub), Keys("fleet")
    link = DisorderedBus(robot, tmp_path, [3])
    map_id, heard = MapId("r0", 1), list[int]()
    listener = ChangeListener(server, keys)
    server.subscribe(keys.changes(), lambda sample: heard.append(Mark.decode(sample.attachment).sequence))
    acks = list[bytes]()
    link.subscribe(keys.acks("r0"), lambda sample: acks.append(sample.payload), direct=True)

    def publish(first: int, last: int) -> None:
        for sequence in range(first, last + 1):
            link.publish(keys.change(map_id), b"change", Mark(sequence, 7).encode())
            for name in ("s0", "s1"):
                server.publish(keys.ack(name, "r0"), f"{name} {sequence}".encode())

    publish(1, 50)
    eventually(lambda: heard == list(range(1, 51)) and len(acks) == 100)
    assert (listener.doubled, listener.reordered) == (0, 0)
    flag(tmp_path, "r0").touch()
    flag(tmp_path, "s1").touch()
    publish(51, 100)
    flag(tmp_path, "r0").unlink()
    eventually(lambda: set(heard) == set(range(1, 101)) and len(set(acks)) == 200)
    link.close()
    eventually(lambda: listener.doubled == len(heard) - 100 > 5)
    # By hand: what comes again, and what comes first behind a greater one.
    first = [number for k, number in enumerate(heard) if number not in heard[:k]]
    assert listener.reordered == sum(n < max(first[: k + 1]) for k, n in enumerate(first)) > 5
    steady = [ack for ack in acks if ack.startswith(b"s0")]
    assert steady == [f"s0 {k}".encode() for k in range(1, 101)], "the messages of s0 stay as they are"
    late = [ack for ack in acks if ack.startswith(b"s1")]
    assert len(late) > 105 and late != sorted(late, key=lambda ack: int(ack[3:]))
    for bus in (robot, server):
        bus.close()


def test_what_is_published_without_a_connection_does_not_come_late(hub: MemoryHub, tmp_path, monkeypatch):
    """A robot takes what a server has of it and has never left for changes that its disk has lost."""
    monkeypatch.setattr("benchmarks.chaos.disorder.LONGEST", 0.1)
    robot, server, heard = MemoryBus(hub), MemoryBus(hub), list[bytes]()
    server.subscribe("a/b/c/d/r0/*", lambda sample: heard.append(sample.payload))
    link = DisorderedBus(robot, tmp_path, [3])
    flag(tmp_path, "r0").touch()
    hub.cut(robot)
    for _ in range(50):
        link.publish("a/b/c/d/r0/change", b"cut off")
    hub.restore(robot)
    for _ in range(50):
        link.publish("a/b/c/d/r0/change", b"connected")
    eventually(lambda: len(heard) >= 50 and not link._late)
    link.close()
    assert set(heard) == {b"connected"}
    for bus in (robot, server):
        bus.close()


def test_what_is_lost_on_one_store_is_lost_on_both():
    one = ON_SQLITE
    other = dict(one, store="postgresql", stored=2, lost=1, maps_equal=False, relocalize_gap_s=0.7)
    assert together([one]) == one and good(one)
    both = together([one, other])
    assert not good(both) and both["stores"] == [one, other] and both["store"] == "sqlite and postgresql"
    assert (both["sent"], both["stored"], both["lost"], both["maps_equal"]) == (6, 5, 1, False)
    assert both["relocalize_gap_s"] == 0.7 and both["kills"] == 40 and both["lossy"] == 4
    assert (both["disorders"], both["doubled"], both["reordered"]) == (14, 10, 6)


def test_what_stays_unacknowledged_is_in_the_report():
    other = dict(ON_SQLITE, unacknowledged=2, recovery_s_p95=percentile([1.0, NEVER], 95))
    both = together([ON_SQLITE, other])
    assert not good(other) and not good(both)
    assert (both["unacknowledged"], both["recovery_s_p95"], both["recovery_s_p50"]) == (2, None, 1.0)
    json.dumps(both, allow_nan=False)


def test_percentiles_of_recoveries_by_hand():
    assert percentile([3.0, 1.0, 2.0], 50) == 2.0
    assert percentile([1.0, 2.0, 3.0, NEVER], 25) == 1.75
    assert percentile([1.0, NEVER], 50) is None
    assert percentile([NEVER, NEVER], 50) is None


def test_robots_that_are_not_done_are_named(tmp_path):
    with FleetProcesses(tmp_path, 2, 1, "sqlite") as fleet:
        for name, script in (("r0", "pass"), ("r1", "input()")):
            fleet._commands[name] = [sys.executable, "-c", script]
            fleet.start(name)
        assert not comes_true(fleet.done, 0.0)
        assert comes_true(lambda: fleet.mapping() == ["r1"], 60.0)


def test_a_server_that_has_ended_by_itself_is_neither_frozen_nor_thawed(tmp_path):
    """It found no database; it is started again later."""
    with FleetProcesses(tmp_path, 1, 1, "sqlite") as fleet:
        fleet._commands["s0"] = [sys.executable, "-c", "pass"]
        fleet.start("s0")
        fleet.begin(Kind.STOP, "s0")
        fleet.end_disturbance(Kind.STOP, "s0")
        eventually(lambda: fleet._running["s0"].poll() == 0)
        fleet.end_disturbance(Kind.STOP, "s0")


class PatientRobot:
    """Recognised by both servers once a file is there; it asks nothing itself."""

    there: ClassVar[Path]
    missing: ClassVar = ["s0: there", "s1: no answer"]

    def __init__(self, *_: object) -> None:
        pass

    def __enter__(self) -> PatientRobot:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def recognised(self, servers: tuple[str, ...]) -> bool:
        return servers == ("s0", "s1") and self.there.exists()

    def start(self) -> None:
        pass

    def longest_gap(self, begin: float, end: float) -> float:
        return max(begin - end, 0.0)


def test_a_server_that_found_no_database_is_started_again_before_robots_ask(tmp_path, monkeypatch):
    """Also when it ends behind the last disturbance; and who is missing is named."""
    monkeypatch.setattr("benchmarks.chaos.benchmark.LostRobot", PatientRobot)
    monkeypatch.setattr("benchmarks.chaos.benchmark.ATTACKS", ((Kind.STOP, "s1", 0.0),))
    monkeypatch.setattr("benchmarks.chaos.fleet_processes.RESTART", 0.1)
    script = (
        "import pathlib, sys; first, there = map(pathlib.Path, sys.argv[1:])\n"
        "if first.exists(): there.touch(); input()\n"
        f"first.touch(); sys.exit('{NO_DATABASE}')"
    )
    PatientRobot.there = tmp_path / "there"
    with FleetProcesses(tmp_path, 1, 1, "sqlite") as fleet, Progress(disable=True) as progress:
        fleet._commands["s0"] = [
            sys.executable, "-c", script, str(tmp_path / "first"), str(PatientRobot.there),
        ]  # fmt: skip
        fleet.start("s0")
        assert relocalize_gaps(fleet, 1, progress) == [0.0]
        PatientRobot.there = tmp_path / "never"
        monkeypatch.setattr("benchmarks.chaos.benchmark.START", 0.1)
        with pytest.raises(ChildFailed, match=r"not both servers recognise a place .*; s1: no answer"):
            relocalize_gaps(fleet, 1, progress)


@pytest.mark.slow
@pytest.mark.alone
@pytest.mark.timeout(600)
def test_nothing_is_lost_in_a_short_chaos():
    arguments = "--agents 2 --seconds 10 --json --store sqlite"
    ran = python("-m", "benchmarks.chaos", *arguments.split(), env=dict(os.environ), timeout=None)
    assert ran.returncode == 0, ran.stderr[-2000:]
    report = json.loads(ran.stdout.splitlines()[-1])
    assert report["kills"] >= LEAST_KILLS and report["lost_stores"] > 0 and report["lossy"] > 0
    assert report["doubled"] > 0 and report["reordered"] > 0
    assert report["sent"] == report["stored"] + report["undone"] > 100
    assert (report["lost"], report["duplicated"], report["out_of_order"]) == (0, 0, 0)
    assert report["unacknowledged"] == 0
    assert report["maps_equal"] is True
    # One of two servers, or the robot's router, is killed, or a server stopped.
    assert report["relocalize_gap_s"] < 1.0
