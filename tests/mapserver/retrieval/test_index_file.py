"""The saved place index: as it was, or not at all."""

import logging
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.change import Change, NodePut, NodeRetired
from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Landmarks, Node
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import View
from mapweave.mapserver.log.entry import Entry, Position
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.mapserver.log.store import Store
from mapweave.mapserver.retrieval import index_file
from mapweave.mapserver.retrieval.fingerprint import fingerprint, landmark_prints
from mapweave.mapserver.retrieval.landmark_index import LandmarkIndexSettings
from mapweave.mapserver.retrieval.place_database import SUFFIX, PlaceDatabase
from mapweave.mapserver.retrieval.place_index import PlaceIndex, PlaceIndexSettings
from mapweave.wire.codec import encode_change
from synthetic.world import CAMERA, random_vectors, room, take_map, take_view

MAP = MapId("a", 1)
LOGS = {MAP: Position(77, 5)}
SETTINGS = PlaceIndexSettings(landmarks=LandmarkIndexSettings(small=300, exact=1200, probes=10_000))


@pytest.fixture(scope="module")
def mapped() -> tuple[list[Node], list[View]]:
    """A room, and views near its nodes."""
    rng = np.random.default_rng(1)
    world = room(0, 0, 5, 4, 500, rng)
    tour = [Pose2(rng.uniform(1.5, 3), rng.uniform(1.5, 2.5), k) for k in range(16)]
    views = [take_view(world, stop @ Pose2(0.1, 0.0, 0.05), rng)[0] for stop in tour]
    return take_map(world, MAP, tour, rng)[0], views


def filled(nodes: list[Node]) -> PlaceIndex:
    index = PlaceIndex(SETTINGS)
    index.extend(nodes)
    return index


def changed(node: Node) -> Node:
    """The same node with other looks."""
    return replace(node, landmarks=replace(node.landmarks, codes=node.landmarks.codes[::-1].copy()))


def alike(a: PlaceIndex, b: PlaceIndex, views: list[View]) -> bool:
    assert len(a) == len(b) and len(a.landmarks) == len(b.landmarks)
    return all(dict(a.query(view, 99)) == pytest.approx(dict(b.query(view, 99)), rel=1e-4) for view in views)


@pytest.mark.parametrize("count", [5, 16])
def test_a_loaded_index_answers_as_the_saved_one(
    tmp_path: Path, mapped: tuple[list[Node], list[View]], count: int
) -> None:
    nodes, views = mapped
    index = filled(nodes[:count])
    index.remove(nodes[2].id)
    assert index_file.save(tmp_path / "x", index, LOGS)
    again = index_file.load(tmp_path / "x", LOGS, SETTINGS)
    assert alike(index, again, views)
    known = {node.id: node for node in nodes}
    for node in nodes:
        assert again.overlaps(node, known.get) == pytest.approx(index.overlaps(node, known.get), rel=1e-4)
    # It goes on as if nothing had been: nodes come and go.
    for item in (index, again):
        item.extend(nodes)
        item.remove(nodes[1].id)
    assert alike(index, again, views)
    assert [path.name for path in tmp_path.iterdir()] == ["x"]


def test_nodes_that_are_newer_in_the_store_are_replaced(
    tmp_path: Path, mapped: tuple[list[Node], list[View]], monkeypatch: pytest.MonkeyPatch
) -> None:
    nodes, views = mapped
    index_file.save(tmp_path / "x", filled(nodes[:12]), LOGS)
    index = index_file.load(tmp_path / "x", LOGS, SETTINGS)
    true = [*nodes[3:6], changed(nodes[6]), *nodes[7:]]
    added: list[int] = []
    add = index.landmarks.add
    monkeypatch.setattr(index.landmarks, "add", lambda codes, ids: (added.append(len(ids)), add(codes, ids)))
    assert index.retain([node.id for node in true]) == 3
    index.extend(true)
    assert sum(added) == sum(len(node.landmarks) for node in [nodes[6], *nodes[12:]])
    assert alike(index, filled(true), views)


def test_few_landmarks_are_not_saved(tmp_path: Path, mapped: tuple[list[Node], list[View]]) -> None:
    nodes, _ = mapped
    assert not index_file.save(tmp_path / "x", filled(nodes[:1]), LOGS) and not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory, mapped: tuple[list[Node], list[View]]) -> bytes:
    path = tmp_path_factory.mktemp("saved") / "x"
    index_file.save(path, filled(mapped[0]), LOGS)
    return path.read_bytes()


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_any_bit_that_is_turned_is_noticed(tmp_path: Path, saved: bytes, at: float, bit: int) -> None:
    data = bytearray(saved)
    data[int(at * len(data))] ^= 1 << bit
    (tmp_path / "x").write_bytes(data)
    with pytest.raises(InvalidFile):
        index_file.load(tmp_path / "x", LOGS, SETTINGS)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.floats(0, 1, exclude_max=True), more=st.binary(max_size=50))
def test_any_cut_and_anything_behind_it_is_noticed(
    tmp_path: Path, saved: bytes, at: float, more: bytes
) -> None:
    data = saved[: int(at * len(saved))] + more
    if data == saved:
        return
    (tmp_path / "x").write_bytes(data)
    with pytest.raises(InvalidFile):
        index_file.load(tmp_path / "x", LOGS, SETTINGS)


@pytest.mark.parametrize(
    "logs", [{}, {MAP: Position(78, 5)}, {MAP: Position(77, 4)}, {MapId("b", 1): Position(77, 5)}]
)
def test_another_store_is_noticed(tmp_path: Path, saved: bytes, logs: index_file.Positions) -> None:
    (tmp_path / "x").write_bytes(saved)
    with pytest.raises(InvalidFile, match=r"a log of a\.1 that the store does not have"):
        index_file.load(tmp_path / "x", logs, SETTINGS)


def test_another_version_is_noticed(
    tmp_path: Path, mapped: tuple[list[Node], list[View]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(index_file, "TABLES", 99)
    index_file.save(tmp_path / "x", filled(mapped[0]), LOGS)
    monkeypatch.undo()
    with pytest.raises(InvalidFile, match="another version"):
        index_file.load(tmp_path / "x", LOGS, SETTINGS)
    with pytest.raises(InvalidFile, match="there is none"):
        index_file.load(tmp_path / "y", LOGS, SETTINGS)


def test_it_is_saved_while_nodes_come_and_go(tmp_path: Path, mapped: tuple[list[Node], list[View]]) -> None:
    """What was caught on the way is mended by the store."""
    nodes, views = mapped
    index, stop = filled(nodes[:8]), threading.Event()

    def busy() -> None:
        while not stop.is_set():
            index.extend([*nodes[8:], changed(nodes[1])])
            index.remove(nodes[2].id)
            index.extend([nodes[1], nodes[2]])
            index.remove(nodes[9].id)

    thread = threading.Thread(target=busy)
    thread.start()
    for _ in range(10):
        index_file.save(tmp_path / "x", index, LOGS)
        again = index_file.load(tmp_path / "x", LOGS, SETTINGS)
        again.retain([node.id for node in nodes])
        again.extend(nodes)
        assert alike(again, filled(nodes), views[:3])
    stop.set()
    thread.join()


def test_any_change_changes_the_fingerprint() -> None:
    rng = np.random.default_rng(3)
    codes = rng.integers(0, 64, (60, 32)).astype(np.uint8)
    whole, order = fingerprint(codes), rng.permutation(60)
    scattered = landmark_prints(codes[order], order).sum(dtype=np.uint64)
    assert int(scattered) == whole
    others = {whole, fingerprint(codes[1:]), fingerprint(codes[:-1]), fingerprint(codes[::-1])}
    for k in range(200):
        other = codes.copy()
        other[k % 60, k % 32] ^= 1 << k % 6
        others.add(fingerprint(other))
    assert len(others) == 204 and fingerprint(codes[:0]) == 0


def put(store: Store, contents: list[NodePut | NodeRetired], first: int = 1) -> None:
    changes = [Change(MAP, first + k, 0, body) for k, body in enumerate(contents)]
    entries = [Entry.read(MAP, entry.sequence, encode_change(entry)) for entry in changes]
    assert not store.apply(MAP, 77, entries).refusals


def many(count: int, first: int = 0) -> list[Node]:
    """Nodes of 140 landmarks from nothing."""
    rng = np.random.default_rng([7, first])
    base = take_map(room(0, 0, 5, 4, 300, rng), MAP, [Pose2(2, 2, 0)], rng)[0][0]
    out = []
    for k in range(count):
        codes = np.clip(32 + np.rint(30 * random_vectors(140, rng)), 0, 63).astype(np.uint8)
        pixels = np.stack([rng.uniform(5, 315, 140), rng.uniform(5, 235, 140)], axis=1).astype(np.float32)
        depths, sigmas = np.full(140, 2.0, np.float32), np.full(140, 0.1, np.float32)
        landmarks = Landmarks(pixels, codes, depths, sigmas)
        out.append(replace(base, id=NodeId("a", 1, first + k), landmarks=landmarks, camera=CAMERA))
    return out


def test_a_server_that_starts_again_has_its_places_at_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "mapweave.mapserver.retrieval.place_database")
    path = tmp_path / "store.db"
    store = SqliteStore(path)
    put(store, [NodePut(node) for node in many(90)])

    def replayed() -> list[Node]:
        return [entry.body.node for entry in store.replay(MAP) if isinstance(entry.body, NodePut)]

    places = PlaceDatabase(store, path)
    assert f"built again: {path}{SUFFIX}: there is none yet" in caplog.text and len(places) == 0
    places.put(replayed())
    places.close()
    put(store, [NodeRetired(NodeId("a", 1, 4)), *(NodePut(node) for node in many(3, 200))], 91)
    again = PlaceDatabase(store, path)
    assert "the place index of 89 nodes is as it was saved; 1 are gone" in caplog.text
    assert len(again) == 89 and all((NodeId("a", 1, k) in again) == (k != 4) for k in range(90))
    again.put(node for node in replayed() if node.id.number != 4)
    again.close()
    kept = path.with_name(path.name + SUFFIX)
    saved = index_file.load(kept, store.positions())
    assert len(again) == len(saved) == 92 and len(saved.landmarks) == 92 * 140
    kept.write_bytes(kept.read_bytes()[:-5])
    assert len(PlaceDatabase(store, path)) == 0 and "damaged or cut off" in caplog.text
    store.close()


def test_a_full_disk_is_reported_and_leaves_no_partial_file(
    tmp_path: Path, mapped: tuple[list[Node], list[View]], monkeypatch: pytest.MonkeyPatch
) -> None:
    index_file.save(tmp_path / "x", filled(mapped[0][:6]), LOGS)
    before = (tmp_path / "x").read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("mapweave.mapserver.retrieval.index_file.os.fsync", full)
    with pytest.raises(InvalidFile, match=r"cannot be saved \(No space left"):
        index_file.save(tmp_path / "x", filled(mapped[0]), LOGS)
    assert [path.name for path in tmp_path.iterdir()] == ["x"] and (tmp_path / "x").read_bytes() == before


def test_a_running_server_saves_when_enough_is_new(tmp_path: Path) -> None:
    store = SqliteStore(tmp_path / "store.db")
    kept = tmp_path / f"store.db{SUFFIX}"
    places = PlaceDatabase(store, tmp_path / "store.db")
    nodes = many(120)
    places.put(nodes[:100])
    places.save_if_worthwhile()
    first = kept.read_bytes()
    places.put(nodes[100:101])
    places.save_if_worthwhile()
    assert kept.read_bytes() == first
    places.put(nodes[101:])
    places.save_if_worthwhile()
    assert kept.read_bytes() != first
    places.close()
    assert len(index_file.load(kept, store.positions())) == 120
    store.close()
