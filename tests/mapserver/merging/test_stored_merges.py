"""A server that adopts the merges of another has the same map, and goes on from it when it must."""

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.annotation import Annotations
from mapweave.hybridmap.change import Change
from mapweave.hybridmap.constraint_subject import Apart, Linked, RetiredMap, RetiredNodes
from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.pin import Pin
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.mapserver.content_hash import content_hash
from mapweave.mapserver.log.store import MERGE, MERGE_MARK, Store
from mapweave.mapserver.map_files import map_file_of
from mapweave.mapserver.merging import merge_adoption, stored_merges, verification_cache_keeper
from mapweave.mapserver.merging.merge_adoption import MergeAdoption
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.merging.stored_merges import PART, StoredMerges
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.settings import ExclusionSettings, MergeSettings
from tests.mapserver.merging.test_restart_record import Log, Server, decided, drives
from tests.quick import first_quick

OTHERS = MapId("r0", 1), MapId("r1", 1)


class Results:
    """The results of a store, of which one server leads."""

    leads = followed = True
    term = 1
    away = False

    def __init__(self) -> None:
        self.values: dict[str, bytes] = {}

    def publish(self, results: Mapping[str, bytes]) -> None:
        self.values |= results

    def result(self, name: str) -> bytes | None:
        if self.away:
            raise InvalidFile("the map store cannot be used")
        return self.values.get(name)


class Leader(Server):
    """What the merging thread of a server that leads does; it has files of its own, too."""

    def __init__(self, results: Results, path: Path, name: str = "s0") -> None:
        self.stored, self.last = StoredMerges(cast(Store, results), name), dict[MapId, int]()
        super().__init__(path, ())
        self.path = path

    def put(self, changes: list[Change]) -> None:
        for change in changes:
            self.merger.on_change(change)
            self.last[change.map] = change.sequence

    def merge(self) -> MergedMap:
        merged = super().merge()
        self.stored.write(self.merger, self.last, None)
        return merged

    def restarted(self, changes: list[Change]) -> MergedMap:
        """As another process merges that has all changes, and these files."""
        log = [(change.map, change.body) for change in changes]
        return Server(self.path, log, self.merger.constraints).merger.merged()


class Follower:
    """What that of a server that follows does; its clock is set by hand."""

    def __init__(self, results: Results, merging: MergeSettings | None = None) -> None:
        self.now, self.results = 0.0, results
        self.merger = Merger(settings=merging)
        self.adoption = MergeAdoption(StoredMerges(cast(Store, results), "s1"), None, lambda: self.now)
        self.merged = MergedMap.empty()
        self.last: dict[MapId, int] = {}
        self.taken = 0

    def take(self, changes: list[Change]) -> None:
        for change in changes:
            self.taken += 1
            self.adoption.hold(self.taken, change)

    def read(self, changes: list[Change]) -> None:
        self.last |= {change.map: change.sequence for change in changes}
        self.merger.read((change.map, change.body) for change in changes)

    def look(self) -> bool:
        merged = self.adoption.adopt(self.merger, self.read, self.merger.counters.merges > 0, self.last)
        self.merged = merged or self.merged
        return merged is not None

    def lead(self) -> MergedMap:
        self.adoption.hand_over(self.merger, self.merger.counters.merges > 0)
        self.read(self.adoption.release())
        return self.merger.merged()


def numbered(log: Log) -> list[Change]:
    """The changes as they come: each map's by its own numbers."""
    last: dict[MapId, int] = {}
    out = []
    for map_id, body in log:
        last[map_id] = last.get(map_id, 0) + 1
        out.append(Change(map_id, last[map_id], 0, body))
    return out


def hash_of(merged: MergedMap) -> str:
    return content_hash(map_file_of(merged, (), Annotations(())))


def assert_same(one: MergedMap, other: MergedMap) -> None:
    """Bit by bit, but for what the merged map is made of inside."""
    assert hash_of(one) == hash_of(other)
    assert decided(one) == decided(other)
    assert {r.pair: r.edge for r in one.refused} == {r.pair: r.edge for r in other.refused}
    for name in (
        "set_apart",
        "implausible",
        "wrong",
        "contradicted",
        "pins",
        "refused_changes",
        "disbelieved",
    ):
        assert getattr(one, name) == getattr(other, name), name
    assert one.copies.keys() == other.copies.keys()
    assert dict(one.constraints.nodes) == dict(other.constraints.nodes)
    assert one.constraints.floors == other.constraints.floors
    for a, b in zip(one.graphs, other.graphs, strict=True):
        assert (a.anchor, a.nodes) == (b.anchor, b.nodes)
        assert np.array_equal(a.means, b.means)
        assert (a.information != b.information).nnz == 0, "covariances"
    for a, b in zip(one.links, other.links, strict=True):
        assert a.evidence == b.evidence and np.array_equal(a.shared, b.shared)
        assert a.a_from_b == b.a_from_b or np.array_equal(a.a_from_b.covariance, b.a_from_b.covariance)
    assert one.explain(*one.links[0].pair) == other.explain(*other.links[0].pair) if one.links else True


def constrained(seed: int) -> ManualConstraints:
    """What a person may say, of nodes that are there or not."""
    rng = np.random.default_rng(seed)
    a, b, c = (NodeId(*OTHERS[k % 2], 1 + 2 * int(rng.integers(5))) for k in range(3))
    by_hand = Linked.of(a, b, PoseGaussian.from_sigmas(Pose2(0.1, 0.2, 0.3), 0.1, 0.1))
    said = [
        ManualConstraint(Apart(OTHERS), True, "anna", 1, "two kitchens"),
        ManualConstraint(RetiredMap(OTHERS[1]), True, "anna", 2, "moved"),
        ManualConstraint(RetiredNodes((c,)), True, "anna", 3, "dark"),
        ManualConstraint(by_hand, True, "anna", 4, "the same shelf"),
    ]
    return ManualConstraints([one for one in said if rng.random() < 0.5])


@pytest.mark.parametrize("seed", first_quick(range(1, 4), 0))
@settings(max_examples=5, deadline=None)
@given(
    steps=st.lists(st.integers(1, 25), min_size=2, max_size=8),
    seen=st.lists(st.booleans(), min_size=8, max_size=8),
    late=st.lists(st.integers(0, 12), min_size=8, max_size=8),
    full=st.sampled_from([1, 30, 2000]),
    said=st.integers(0, 7),
)
def test_a_follower_has_the_leaders_map_and_goes_on_from_it(
    seed: int, steps: list[int], seen: list[bool], late: list[int], full: int, said: int
):
    """It misses merges, hears changes early, and takes over at last; beside it a leader that goes on."""
    results, changes = Results(), numbered(drives(seed))
    with pytest.MonkeyPatch.context() as patch, TemporaryDirectory() as folder:
        patch.setattr(stored_merges, "FULL", full)
        leader, follower = Leader(results, Path(folder) / "s0"), Follower(results)
        done = heard = 0
        for k, step in enumerate(steps):
            some = changes[done : done + step]
            done += len(some)
            ahead = max(heard, min(len(changes), done + late[k]))
            follower.take(changes[heard:ahead])
            heard = ahead
            leader.put(some)
            if k == said:
                for server in (leader, follower):
                    server.merger.constrain(constrained(seed + k))
                    server.merger.pin([Pin(NodeId(*OTHERS[0], 1), Pose2(1.0, 2.0, 0.5))])
            merged = leader.merge()
            if seen[k]:
                follower.look()
                assert not follower.adoption.reason
                assert_same(follower.merged, merged)
                assert not follower.look()
                indexed = {node for node in merged.poses if node in leader.merger.places}
                assert indexed == {node for node in merged.poses if node in follower.merger.places}
        assert follower.merger.counters.merges == follower.merger.counters.verified == 0
        follower.look()
        # The leader is gone. What a merge has not seen yet is taken in as by a leader that starts again.
        assert decided(follower.lead()) == decided(leader.restarted(changes[:heard]))
        if heard == done:
            assert decided(follower.merger.merged()) == decided(merged)
            assert follower.merger.counters.verified == 0, "what was compared is compared once"
        for node in merged.poses if heard == done else ():
            assert follower.merger.merged().pose(node).distance(merged.pose(node)) < 1e-6


HandedOver = tuple[Results, list[Change]]


@pytest.fixture(scope="module")
def handed_over(tmp_path_factory: pytest.TempPathFactory) -> HandedOver:
    """A merge of the first changes, to be looked at only."""
    results, changes = Results(), numbered(drives(1))[:24]
    leader = Leader(results, tmp_path_factory.mktemp("leader") / "s0")
    leader.put(changes)
    leader.merge()
    return results, changes


def follower_of(handed_over: HandedOver) -> Follower:
    results = Results()
    results.values = dict(handed_over[0].values)
    return Follower(results)


def test_time_without_a_store_is_no_time_without_a_leader(handed_over: HandedOver):
    follower = follower_of(handed_over)
    follower.results.values[MERGE] = b""
    assert not follower.look() and follower.adoption.reason.endswith("is incomplete or damaged")
    follower.results.away = True
    follower.now = 100.0
    assert not follower.look() and not follower.adoption.overdue
    follower.results.away = False
    follower.now += merge_adoption.PATIENCE
    assert not follower.look() and follower.adoption.overdue


def test_a_follower_that_has_not_all_waits_longer_than_one_with_other_maps(handed_over: HandedOver):
    changes, lacking, other = handed_over[1], follower_of(handed_over), follower_of(handed_over)
    lacking.take(changes[:-1])
    assert not lacking.look() and "has not merged" in lacking.adoption.reason
    lacking.now = merge_adoption.PATIENCE
    assert not lacking.adoption.overdue
    lacking.take(changes[-1:])
    assert lacking.look() and not lacking.adoption.reason
    # Another one has lost a change on the way.
    other.take(changes[1:])
    assert not other.look() and other.adoption.reason == merge_adoption.OTHER_MAPS.format("s0")
    other.now = merge_adoption.PATIENCE
    assert other.adoption.overdue


@pytest.mark.parametrize("taken", [0, 5, 24])
def test_changes_that_could_not_be_taken_in_are_not_lost(handed_over: HandedOver, taken: int):
    """Those of a merge, of which some are in the map, and those behind it."""
    changes = handed_over[1]
    later = numbered(drives(1))[24:30]
    follower, leading = follower_of(handed_over), follower_of(handed_over)
    for one in (follower, leading):
        one.take([*changes, *later])

    def fails(some: list[Change]) -> None:
        leading.read(some[:taken])
        raise MemoryError

    with pytest.raises(MemoryError):
        leading.adoption.adopt(leading.merger, fails, False, leading.last)
    assert follower.look() and leading.look()
    assert_same(leading.merged, follower.merged)
    assert leading.adoption.behind == follower.adoption.behind == len(later)
    assert decided(leading.lead()) == decided(follower.lead())
    assert leading.merger.maps.keys() == {change.map for change in [*changes, *later]}


def test_a_follower_gives_up_at_once_and_tries_the_next_merge_later(handed_over: HandedOver, tmp_path):
    changes, follower = handed_over[1], follower_of(handed_over)
    follower.take(changes)
    assert follower.look() and follower.adoption.in_step(follower.merger)
    follower.adoption.give_up("a defect")
    assert follower.adoption.overdue and follower.adoption.reason == "a defect"
    assert not follower.adoption.in_step(follower.merger)
    assert follower.lead().poses.keys() == follower.merged.poses.keys()
    follower.now += merge_adoption.AGAIN
    assert not follower.adoption.promising(follower.merger), "it is the merge with which it failed"
    follower.results.publish(handed_over[0].values)
    leader = Leader(follower.results, tmp_path / "s0")
    leader.put(changes)
    leader.put(numbered(drives(1))[24:30])
    leader.merge()
    follower.now -= 0.1
    assert not follower.adoption.promising(follower.merger), "it is too early"
    follower.now += 0.1
    assert follower.adoption.promising(follower.merger)


@pytest.mark.parametrize("name", [MERGE, MERGE_MARK, PART.format(0)])
@pytest.mark.parametrize("how", ["missing", "empty", "cut", "flipped"])
def test_what_is_damaged_is_not_adopted(handed_over: HandedOver, name: str, how: str):
    follower = follower_of(handed_over)
    value, values = follower.results.values.pop(name), follower.results.values
    if how != "missing":
        middle = len(value) // 2
        flipped = value[:middle] + bytes([value[middle] ^ 1]) + value[middle + 1 :]
        values[name] = {"empty": b"", "cut": value[:-1], "flipped": flipped}[how]
    follower.take(handed_over[1])
    assert not follower.look() and follower.adoption.reason
    values[name] = value
    follower.now = merge_adoption.RETRY
    assert follower.look() and not follower.adoption.reason


def test_merges_with_other_settings_or_of_another_version_are_not_adopted(
    handed_over: HandedOver, monkeypatch
):
    follower = Follower(handed_over[0], MergeSettings(exclusion=ExclusionSettings(doubt=0.01)))
    follower.take(handed_over[1])
    assert not follower.look() and "with other settings" in follower.adoption.reason
    monkeypatch.setattr(verification_cache_keeper, "VERSION", "0.0.0")
    follower = Follower(handed_over[0])
    assert not follower.look() and "of another version" in follower.adoption.reason
