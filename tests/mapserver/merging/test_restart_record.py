"""A server that is killed and starts again over its files supersedes and links what one that goes on does."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.change import Change, ChangeBody, NodePut, NodeRetired
from mapweave.hybridmap.constraint_subject import RetiredMap
from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.superseded import Superseded
from mapweave.mapserver.merging import restart_record_file, verification_cache_keeper
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.merging.restart_record import RestartRecord
from mapweave.mapserver.merging.restart_record_file import load, save
from mapweave.mapserver.merging.verification_cache import PRINT_BYTES, RecentComparisons
from mapweave.mapserver.merging.verification_cache_keeper import (
    RECORD_SUFFIX,
    SUFFIX,
    VerificationCacheKeeper,
    made_by,
)
from mapweave.merge.map_maintenance.superseding_log import Changes, SupersedingLog
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.settings import ExclusionSettings, MergeSettings
from synthetic.maps import changes_of
from synthetic.world import room, take_map
from tests.quick import first_quick

DAY_NS = 86_400_000_000_000
NO_STEP = 10_000
Log = Sequence[tuple[MapId, ChangeBody]]


@cache
def drives(seed: int = 1) -> Log:
    """Two robots in one room, each on three days; some nodes are put again, and some given up."""
    rng = np.random.default_rng(seed)
    world = room(0, 0, 5, 4, 600, rng)
    out: list[tuple[MapId, ChangeBody]] = []
    for day in range(3):
        for robot in range(2):
            map_id = MapId(f"r{robot}", day + 1)
            around = rng.normal(0.0, [0.4, 0.3, 0.2], (5, 3))
            tour = [Pose2(2.4 + x, 2.0 + y, 0.9 * k + turn) for k, (x, y, turn) in enumerate(around)]
            nodes, edges = take_map(world, map_id, tour, rng)
            stamp_ns = (2 * day + robot) * DAY_NS // 2
            nodes = [replace(node, stamp_ns=stamp_ns + node.stamp_ns) for node in nodes]
            out += [(map_id, change) for change in changes_of(nodes, edges)]
            if robot:
                some = nodes[1].landmarks.take(np.arange(0, len(nodes[1].landmarks), 2))
                out.append((map_id, NodePut(replace(nodes[1], landmarks=some))))
            else:
                out.append((map_id, NodeRetired(nodes[-1].id)))
    return out


class Server:
    """What the merging thread of a server does, over files."""

    def __init__(self, path: Path, log: Log, constraints: ManualConstraints | None = None) -> None:
        self.merger = Merger()
        # Its clock stands still: on a slow disk not every merge is written, and another table is right then.
        self.keeper = VerificationCacheKeeper(path, clock=lambda: 0.0)
        self.keeper.restore(self.merger)
        if constraints is not None:
            self.merger.constrain(constraints)
            self.merger.merged()
            self.keeper.save(self.merger)
        self.merger.read(log)
        self.merge()

    def take(self, log: Log, step: int = NO_STEP) -> Server:
        """Take in changes, with a merge after every so many of them."""
        for k, (map_id, body) in enumerate(log, 1):
            self.merger.on_change(Change(map_id, k, 0, body))
            if k % step == 0:
                self.merge()
        self.merge()
        return self

    def merge(self) -> MergedMap:
        merged = self.merger.merged()
        self.keeper.save(self.merger)
        return merged


def decided(merged: MergedMap) -> dict[str, Any]:
    return {
        "superseded": {node: successor.by for node, successor in merged.superseded.items()},
        "links": [link.pair for link in merged.links],
        "refused": [(r.pair, r.reason) for r in merged.refused],
        "components": merged.components,
        "indexed": None,
    }


def decisions(server: Server) -> dict[str, Any]:
    indexed = {node for node in server.merger.merged().poses if node in server.merger.places}
    return decided(server.merger.merged()) | {"indexed": indexed}


def by_drive(path: Path, log: Log) -> Server:
    """A server that merges after each drive."""
    server = Server(path, ())
    for map_id in dict.fromkeys(map_id for map_id, _ in log):
        server.take([(which, body) for which, body in log if which == map_id])
    return server


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> tuple[Server, dict[str, bytes]]:
    """A server that has merged after each drive, and the files that it leaves."""
    folder = tmp_path_factory.mktemp("driven")
    server = by_drive(folder / "store", drives())
    return server, {file.name: file.read_bytes() for file in folder.iterdir()}


@pytest.fixture
def before(driven: tuple[Server, dict[str, bytes]], tmp_path: Path) -> Server:
    """That server, to be looked at only; copies of its files lie in the test's folder."""
    server, files = driven
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    return server


def retired(map_id: MapId) -> ManualConstraints:
    return ManualConstraints([ManualConstraint(RetiredMap(map_id), True, "anna", 1, "moved")])


def test_a_restarted_server_supersedes_what_it_had(before: Server, tmp_path):
    assert len(before.merger.merged().superseded) > 10
    assert decisions(Server(tmp_path / "store", drives())) == decisions(before)
    # Without the record it would have been another table.
    (tmp_path / f"store{RECORD_SUFFIX}").unlink()
    assert decisions(Server(tmp_path / "store", drives())) != decisions(before)


@pytest.mark.parametrize("seed", first_quick(range(1, 4), 0))
@settings(max_examples=4, deadline=None)
@given(
    kills=st.lists(st.integers(1, 72), min_size=1, max_size=3, unique=True),
    step=st.integers(4, 20),
    saved=st.sampled_from([0.0, 0.3, 1e9]),
    gone=st.none() | st.tuples(st.integers(0, 3), st.integers(0, 1), st.integers(1, 3)),
)
def test_a_killed_server_ends_as_one_that_goes_on(
    seed: int, kills: list[int], step: int, saved: float, gone: tuple[int, int, int] | None
):
    """Also if its verification cache is older than its last merge, and a person retires a map meanwhile."""
    log = drives(seed)
    bounds = [0, *sorted(kills), len(log)]
    parts = [log[a:b] for a, b in pairwise(bounds)]
    when, robot, day = gone or (0, 0, 0)
    constraints = None
    with TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(verification_cache_keeper, "WORTHWHILE", saved)
        on, killed, done = Server(Path(folder) / "on", ()), Server(Path(folder) / "killed", ()), 0
        for k, part in enumerate(parts):
            on.take(part, step)
            killed.take(part, step)
            done += len(part)
            if gone and k == min(when, len(parts) - 1):
                constraints = retired(MapId(f"r{robot}", day))
                on.merger.constrain(constraints)
                on.merge()
            killed = Server(Path(folder) / "killed", log[:done], constraints)
            assert decisions(killed) == decisions(on)
        for node in on.merger.merged().poses:
            assert killed.merger.merged().pose(node).distance(on.merger.merged().pose(node)) < 1e-6


@pytest.mark.parametrize("amount", first_quick([5, 1, 9], 1))
def test_changes_that_no_merge_has_seen_are_taken_in_afterwards(tmp_path, amount: int):
    log = drives()
    server = by_drive(tmp_path / "store", log[:-amount])
    for k, (map_id, body) in enumerate(log[-amount:]):
        server.merger.on_change(Change(map_id, k, 0, body))
    # It is killed before it merges these.
    killed = Server(tmp_path / "store", log)
    server.merge()
    assert decisions(killed) == decisions(server)


def random_record(rng: np.random.Generator) -> RestartRecord:
    nodes = sorted(NodeId(f"r{k % 3}", 1 + k % 2, k) for k in range(20))
    pairs = [(a, b) for a in nodes for b in nodes if a < b and rng.random() < 0.3]
    judged = frozenset(node for node in nodes if rng.random() < 0.8)
    active = {node for node in judged if rng.random() < 0.4} | {min(judged)}
    successors = {node: sorted(active)[int(rng.integers(len(active)))] for node in sorted(judged - active)}
    superseded = {
        node: Superseded(by, int(rng.integers(150)), *rng.uniform(0.0, 2.0, 2).tolist())
        for node, by in successors.items()
    }
    compared = frozenset(node for node in nodes if rng.random() < 0.2)
    overlaps = {pair: float(rng.uniform(3, 30)) for pair in pairs if compared & {*pair}}
    recent = RecentComparisons({node: rng.bytes(PRINT_BYTES) for node in nodes}, compared, overlaps)
    unsure = frozenset({MapId("other", 3), MapId("r0", 1)})
    return RestartRecord(recent, judged, superseded, frozenset(pairs[::2]), unsure, random_log(rng, nodes))


def random_log(rng: np.random.Generator, nodes: Sequence[NodeId]) -> SupersedingLog:
    """Of these nodes, and of one that is gone."""
    gone = NodeId("gone", 1, 7)
    was = [None, Superseded(gone, 20, 0.1, 0.2), Superseded(nodes[1], 30, 0.3, 0.4)]
    steps = tuple(
        Changes(
            {node: was[int(rng.integers(3))] for node in nodes if rng.random() < 0.2},
            frozenset({gone} | {node for node in nodes if rng.random() < 0.2}),
            frozenset((a, b) for a in nodes for b in nodes if a < b and rng.random() < 0.1),
            frozenset((gone, node) for node in nodes[k:3]),
            ({MapId("r2", 1): 0, MapId("far", 9): -1}, {MapId("r0", 1): 3, MapId("r1", 1): 2})[:k],
        )
        for k in range(4)
    )
    parts = {MapId("r0", 1): -1, MapId("r1", 2): 0}, {MapId("r2", 1): 4, MapId("far", 9): 2}
    return SupersedingLog(steps, parts)


@pytest.mark.parametrize("seed", range(5))
def test_loading_returns_what_was_saved(seed: int, tmp_path):
    record = random_record(np.random.default_rng(seed))
    save(tmp_path / "x", record, "me")
    assert load(tmp_path / "x", "me") == record
    with pytest.raises(InvalidFile, match="other settings"):
        load(tmp_path / "x", "another version")
    save(tmp_path / "x", RestartRecord(), "me")
    assert load(tmp_path / "x", "me") == RestartRecord()
    assert [path.name for path in tmp_path.iterdir()] == ["x"]


def _superseded(**fields: Any) -> Mapping[str, Any]:
    record = random_record(np.random.default_rng(1))
    node, one = min(record.superseded.items())
    return {"superseded": {**record.superseded, node: replace(one, **fields)}}


def _by(agent: str, **fields: Any) -> Superseded:
    return replace(Superseded(NodeId(agent, 1, -1 if agent == "a" else 1), 20, 0.1, 0.2), **fields)


def _logged(**fields: Any) -> Mapping[str, Any]:
    log = random_record(np.random.default_rng(1)).log
    return {"log": replace(log, steps=(replace(log.steps[0], **fields), *log.steps[1:]))}


BAD: dict[str, Any] = {
    "negative count": lambda record: _superseded(found=-1),
    "large count": lambda record: _superseded(found=10**6),
    "negative distance": lambda record: _superseded(distance=-0.1),
    "no distance": lambda record: _superseded(distance=np.nan),
    "far": lambda record: _superseded(distance=1e9),
    "more than a turn": lambda record: _superseded(turn=7.5),
    "by a superseded node": lambda record: _superseded(by=max(record.superseded)),
    "by itself": lambda record: _superseded(by=min(record.superseded)),
    "not judged": lambda record: {"judged": frozenset()},
    "pair the other way": lambda record: {"linked": {pair[::-1] for pair in record.linked}},
    "pair with itself": lambda record: {"linked": {(a, a) for a, _ in record.linked}},
    "name": lambda record: {"unsure": frozenset({MapId("R 0", 1)})},
    "epoch": lambda record: {"unsure": frozenset({MapId("r0", -1)})},
    "log: by a node before all": lambda record: _logged(before={min(record.judged): _by("a")}),
    "log: large count": lambda record: _logged(before={min(record.judged): _by("r0", found=10**6)}),
    "log: no distance": lambda record: _logged(before={min(record.judged): _by("r0", distance=np.nan)}),
    "log: pair the other way": lambda record: _logged(
        linked={pair[::-1] for pair in record.log.steps[0].linked}
    ),
    "log: cut the other way": lambda record: _logged(cut={pair[::-1] for pair in record.log.steps[0].linked}),
    "log: parted later": lambda record: _logged(parted=({MapId("r0", 1): 5},)),
    "log: joined later": lambda record: {"log": SupersedingLog(record.log.steps, ({MapId("r0", 1): 5},))},
    "log: joined before all": lambda record: {
        "log": SupersedingLog(record.log.steps, ({MapId("r0", 1): -2},))
    },
    "overlap": lambda record: {
        "recent": replace(record.recent, overlaps=dict.fromkeys(record.recent.overlaps, 0.0))
    },
}


@pytest.mark.parametrize("bad", BAD)
def test_what_cannot_be_is_refused(bad: str, tmp_path):
    """A whole file with a valid checksum."""
    record = random_record(np.random.default_rng(1))
    save(tmp_path / "x", replace(record, **BAD[bad](record)), "me")
    with pytest.raises(InvalidFile, match="no record of this version"):
        load(tmp_path / "x", "me")


@pytest.mark.parametrize("damage", first_quick(["flipped", "version", "merging", "cut", "empty", "other"], 3))
@pytest.mark.usefixtures("before")
def test_a_damaged_record_is_thrown_away(tmp_path, damage: str, caplog, monkeypatch):
    log = drives()
    path = tmp_path / f"store{RECORD_SUFFIX}"
    data = bytearray(path.read_bytes())
    if damage == "cut":
        data = data[: len(data) // 2]
    elif damage == "flipped":
        data[len(data) // 2] ^= 1
    elif damage == "empty":
        data = bytearray()
    elif damage == "other":
        data = bytearray((tmp_path / f"store{SUFFIX}").read_bytes())
    path.write_bytes(bytes(data))
    merging = MergeSettings(exclusion=ExclusionSettings(doubt=0.01)) if damage == "merging" else None
    if damage == "version":
        # Another version may supersede by other rules.
        monkeypatch.setattr(verification_cache_keeper, "VERSION", "0.0.0")
    merger, plain = Merger(settings=merging), Merger(settings=merging)
    caplog.clear()
    with caplog.at_level(logging.INFO):
        VerificationCacheKeeper(tmp_path / "store").restore(merger)
    other_program = damage in ("version", "merging")
    # That is said once of all files.
    assert len(caplog.records) == (1 if other_program else 2)
    assert other_program or "what is superseded is decided again" in caplog.text
    for one in (merger, plain):
        one.read(log)
    merged, expected = decided(merger.merged()), decided(plain.merged())
    if not other_program:
        # What was compared is known still, and some of it only since then.
        merged, expected = ({"components": one["components"]} for one in (merged, expected))
    assert merged == expected


@pytest.mark.slow
def test_a_table_of_other_nodes_does_no_harm(tmp_path):
    """The store of another fleet was put in the place of this one."""
    by_drive(tmp_path / "store", drives(2))
    other = [
        (MapId("x" + map_id.agent, map_id.epoch), body)
        for map_id, body in drives(1)
        if not isinstance(body, NodeRetired)
    ]
    other = [(map_id, _moved(map_id, body)) for map_id, body in other if isinstance(body, NodePut)]
    for log in (drives(1), other, drives(2)[:20], drives(2)[20:]):
        plain = Merger()
        plain.read(log)
        with TemporaryDirectory() as folder:
            for file in tmp_path.iterdir():
                (Path(folder) / file.name).write_bytes(file.read_bytes())
            merged = Server(Path(folder) / "store", log).merger.merged()
        assert merged.poses.keys() == plain.merged().poses.keys()
        for node, successor in merged.superseded.items():
            assert node in merged.poses and successor.by in merged.poses
            assert successor.by not in merged.superseded


def _moved(map_id: MapId, put: NodePut) -> NodePut:
    return NodePut(replace(put.node, id=NodeId(*map_id, put.node.id.number)))


def test_a_record_without_a_verification_cache_is_used(before: Server, tmp_path):
    (tmp_path / f"store{SUFFIX}").unlink()
    again = Server(tmp_path / "store", drives())
    assert again.merger.counters.verified > 50
    same = before.merger.merged().superseded.keys() & again.merger.merged().superseded.keys()
    assert len(same) > 0.8 * len(before.merger.merged().superseded)


def test_a_slow_disk_is_used_a_twentieth_of_the_time(tmp_path, monkeypatch):
    now, written = [0.0], list[float]()

    def slowly(path: Path, record: RestartRecord, made_by: str) -> None:
        written.append(now[0])
        now[0] += 1.0
        save(path, record, made_by)

    monkeypatch.setattr(restart_record_file, "save", slowly)
    merger, keeper = Merger(), VerificationCacheKeeper(tmp_path / "x", clock=lambda: now[0])
    for map_id, body in drives()[:12]:
        merger.on_change(Change(map_id, 1, 0, body))
        merger.merged()
        keeper.save(merger)
        now[0] += 4.0
    assert len(written) == 3 and min(np.diff(written)) >= 20.0
    keeper.save(merger, last=True)
    assert len(written) == 4 and load(tmp_path / f"x{RECORD_SUFFIX}", made_by(merger)) == merger.record()


def test_a_full_disk_is_reported_once(tmp_path, caplog):
    now = [0.0]
    (tmp_path / "later").mkdir()
    merger = Merger()
    keeper = VerificationCacheKeeper(tmp_path / "later" / "store", clock=lambda: now[0])
    keeper.restore(merger)
    (tmp_path / "later").rmdir()
    for map_id, body in drives()[:30]:
        merger.on_change(Change(map_id, 1, 0, body))
        merger.merged()
        keeper.save(merger)
        now[0] += verification_cache_keeper.RETRY + 1.0
    assert caplog.text.count("may supersede other nodes") == 1
    (tmp_path / "later").mkdir()
    keeper.save(merger)
    assert (tmp_path / "later" / f"store{RECORD_SUFFIX}").exists()
