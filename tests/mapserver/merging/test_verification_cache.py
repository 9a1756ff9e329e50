"""The verification cache outlives the process, and is used for unchanged nodes only."""

import logging
import os
import resource
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapweave.hybridmap.change import ChangeBody, NodePut
from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraints
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.mapserver.merging import verification_cache_keeper
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.merging.verification_cache import PRINT_BYTES, VerificationCache, fingerprint_of
from mapweave.mapserver.merging.verification_cache_file import load, save
from mapweave.mapserver.merging.verification_cache_keeper import SUFFIX, VerificationCacheKeeper
from mapweave.merge.pose_graph.links import Link, RefusedLink
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.verdicts import Verdict
from mapweave.merge.settings import ExclusionSettings, MergeSettings
from synthetic.maps import map_tours
from synthetic.world import room
from tests.quick import first_quick

A, B = MapId("a", 1), MapId("b", 1)
Log = list[tuple[MapId, ChangeBody]]


@pytest.fixture(scope="module")
def logged() -> Log:
    """Two robots in three rooms, of which they share one."""
    rng = np.random.default_rng(1)
    world = room(0, 0, 5, 4, 500, rng) + room(5, 0, 5, 4, 700, rng) + room(10, 0, 5, 4, 500, rng)
    tours = {
        map_id: [Pose2(x + 2.2 + 0.1 * k, 1.8, 0.9 * k) for x in rooms for k in range(7)]
        for map_id, rooms in ((A, (0, 5)), (B, (5, 10)))
    }
    return [(map_id, change) for map_id, log in map_tours(world, tours, rng).items() for change in log]


def read(log: Log, path: Path | None = None) -> Merger:
    merger = Merger()
    if path is not None:
        VerificationCacheKeeper(path).restore(merger)
    merger.read(log)
    return merger


def saved(merger: Merger, path: Path) -> Path:
    keeper = VerificationCacheKeeper(path)
    keeper.save(merger, last=True)
    return path.with_name(path.name + SUFFIX)


def same(first: MergedMap, second: MergedMap) -> bool:
    """To the last bit."""
    return (
        [link.pair for link in first.links] == [link.pair for link in second.links]
        and [(r.pair, r.reason) for r in first.refused] == [(r.pair, r.reason) for r in second.refused]
        and list(first.poses) == list(second.poses)
        and all(
            place.merged_from_robot.mean == second.poses[node].merged_from_robot.mean
            and np.array_equal(
                place.merged_from_robot.covariance, second.poses[node].merged_from_robot.covariance
            )
            for node, place in first.poses.items()
        )
    )


def random_findings(rng: np.random.Generator) -> VerificationCache:
    nodes = [NodeId(f"r{k % 3}", 1 + k % 2, k) for k in range(12)]
    pairs = [(a, b) for a in sorted(nodes) for b in sorted(nodes) if a < b and rng.random() < 0.5]
    verdicts: dict[tuple[NodeId, NodeId], Verdict] = {}
    for pair in pairs:
        if rng.random() < 0.5:
            verdicts[pair] = RefusedLink(*pair, f"only {rng.integers(9)} — zu wenig")
            continue
        root = rng.normal(0.0, 1.0, (3, 3))
        pose = PoseGaussian(Pose2(*rng.normal(0.0, 9.0, 3)), root @ root.T)
        keys = ["inliers", "share", "sigma_xy"][: int(rng.integers(0, 4))]
        evidence = {key: float(rng.normal()) for key in keys}
        verdicts[pair] = Link(*pair, pose, rng.integers(0, 150, (int(rng.integers(0, 9)), 2)), evidence)
    overlaps = {pair: float(rng.uniform(3, 30)) for pair in pairs}
    return VerificationCache({node: rng.bytes(PRINT_BYTES) for node in nodes}, overlaps, verdicts)


@pytest.mark.parametrize("seed", range(5))
def test_loading_returns_what_was_saved(seed: int, tmp_path):
    one = random_findings(np.random.default_rng(seed))
    save(tmp_path / "x", one, "me")
    two = load(tmp_path / "x", "me")
    assert (two.prints, two.overlaps, two.verdicts.keys()) == (one.prints, one.overlaps, one.verdicts.keys())
    for pair, verdict in one.verdicts.items():
        again = two.verdicts[pair]
        if isinstance(verdict, RefusedLink):
            assert isinstance(again, RefusedLink) and again.reason == verdict.reason
            continue
        assert isinstance(again, Link)
        assert again.a_from_b.mean == verdict.a_from_b.mean
        assert np.array_equal(again.a_from_b.covariance, verdict.a_from_b.covariance)
        assert np.array_equal(again.shared, verdict.shared) and again.shared.dtype == np.int64
        assert list(again.evidence.items()) == list(verdict.evidence.items())
    assert [path.name for path in tmp_path.iterdir()] == ["x"]
    with pytest.raises(InvalidFile, match="other settings"):
        load(tmp_path / "x", "another version")


def test_a_restarted_server_compares_nothing_and_merges_the_same(logged: Log, tmp_path):
    first = read(logged)
    merged = first.merged()
    assert first.counters.verified > 50 and len(merged.components) == 1
    saved(first, tmp_path / "store")
    second = read(logged, tmp_path / "store")
    assert same(merged, second.merged())
    assert second.counters.verified == 0
    # It goes on as if nothing had been.
    saved(second, tmp_path / "store")
    assert same(merged, read(logged, tmp_path / "store").merged())


def test_later_nodes_are_compared_with_all(logged: Log, tmp_path):
    first = read(logged[:-20])
    first.merged()
    saved(first, tmp_path / "store")
    whole, again = read(logged), read(logged, tmp_path / "store")
    assert same(whole.merged(), again.merged())
    assert 0 < again.counters.verified < 0.8 * whole.counters.verified


def test_a_node_that_is_no_longer_just_so_is_compared_again(logged: Log, tmp_path):
    first = read(logged)
    before = first.merged()
    saved(first, tmp_path / "store")
    changed = before.links[0].a
    node = first.node(changed)
    assert node is not None
    # Half of what it saw is gone: what links it to others is another pose, or nothing.
    less = replace(node, landmarks=node.landmarks.take(np.arange(0, len(node.landmarks), 2)))
    assert fingerprint_of(less) != fingerprint_of(node)
    log = [(m, NodePut(less) if isinstance(b, NodePut) and b.node is node else b) for m, b in logged]
    whole, again = read(log), read(log, tmp_path / "store")
    assert same(whole.merged(), again.merged()) and not same(before, again.merged())
    assert 0 < again.counters.verified < 0.5 * whole.counters.verified


@pytest.mark.parametrize("damage", first_quick(["flipped", "version", "merging", "cut", "empty", "other"], 3))
def test_a_damaged_index_is_built_again(logged: Log, tmp_path, damage: str, caplog, monkeypatch):
    path = saved_once(logged, tmp_path)
    data = bytearray(path.read_bytes())
    if damage == "cut":
        data = data[: len(data) // 2]
    elif damage == "flipped":
        data[len(data) // 2] ^= 1
    elif damage == "empty":
        data = bytearray()
    elif damage == "other":
        data[:8] = b"whatever"
    path.write_bytes(bytes(data))
    settings = {
        # What large islands had decided was decided by other rules.
        "merging": MergeSettings(exclusion=ExclusionSettings(doubt=0.01))
    }
    if damage == "version":
        # Another version may compare by other rules.
        monkeypatch.setattr(verification_cache_keeper, "VERSION", "0.0.0")
    merger = Merger(None, settings.get(damage))
    with caplog.at_level(logging.INFO):
        VerificationCacheKeeper(tmp_path / "store").restore(merger)
    assert len(caplog.records) == 1 and "compared again" in caplog.text
    merger.read(logged)
    assert len(merger.merged().components) == 1
    assert merger.counters.verified > 50


@pytest.mark.parametrize("fresh", [False, True])
def test_a_new_store_is_not_reported_as_unknown(tmp_path, fresh: bool, caplog):
    with caplog.at_level(logging.INFO):
        VerificationCacheKeeper(tmp_path / "store", fresh).restore(Merger())
    assert len(caplog.records) == (not fresh)


def saved_once(logged: Log, tmp_path: Path) -> Path:
    merger = read(logged)
    merger.merged()
    return saved(merger, tmp_path / "store")


def test_a_server_that_ends_before_it_has_merged_leaves_the_file_as_it_is(logged: Log, tmp_path):
    path = saved_once(logged, tmp_path)
    before = path.read_bytes()
    saved(read(logged[:10], tmp_path / "store"), tmp_path / "store")
    assert path.read_bytes() == before


def test_a_merge_before_the_store_is_read_keeps_earlier_results(logged: Log, tmp_path):
    """Manual constraints come first: on a busy machine they were merged alone, and all was compared again."""
    path = saved_once(logged, tmp_path)
    before = path.read_bytes()
    merger, keeper = Merger(), VerificationCacheKeeper(tmp_path / "store")
    keeper.restore(merger)
    merger.constrain(ManualConstraints())
    assert not merger.merged().maps
    keeper.save(merger, last=True)
    assert path.read_bytes() == before
    merger.read(logged)
    assert len(merger.merged().components) == 1 and merger.counters.verified == 0


def test_a_full_disk_is_reported(logged: Log, tmp_path, caplog):
    merger = read(logged)
    merger.merged()
    now = [0.0]
    keeper = VerificationCacheKeeper(tmp_path / "later" / "store", clock=lambda: now[0])
    for _ in range(5):
        keeper.save(merger)
        now[0] += verification_cache_keeper.RETRY + 1.0
    keeper.save(merger, last=True)
    assert caplog.text.count("the next start takes longer") == 1
    (tmp_path / "later").mkdir()
    now[0] += verification_cache_keeper.RETRY + 1.0
    keeper.save(merger)
    assert (tmp_path / "later" / f"store{SUFFIX}").exists()


def test_a_process_that_can_open_no_more_files_says_so_once(logged: Log, tmp_path, caplog):
    merger = read(logged)
    merger.merged()
    now = [0.0]
    keeper = VerificationCacheKeeper(tmp_path / "store", clock=lambda: now[0])
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    newest = max(int(one.name) for one in Path("/proc/self/fd").iterdir())
    held = [os.open("/", os.O_RDONLY) for _ in range(newest)]
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(held) + 1, hard))
    try:
        for _ in range(5):
            keeper.save(merger)
            now[0] += verification_cache_keeper.RETRY + 1.0
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        for handle in held:
            os.close(handle)
    assert [line.getMessage().count("Too many open files") for line in caplog.records] == [1, 1]
    keeper.save(merger)
    assert (tmp_path / f"store{SUFFIX}").exists()
