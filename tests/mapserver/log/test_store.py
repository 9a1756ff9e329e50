"""Both stores: exactly once, in order, and nothing that is half done."""

import sqlite3
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.change import Change, ChangeBody, EdgePut, EdgeRetired, NodePut, NodeRetired
from mapweave.hybridmap.errors import InvalidFile, InvalidValue, MapweaveError
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import EdgeId, MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Landmarks, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.mapserver.log import sqlite_store
from mapweave.mapserver.log.entry import Applied, ReceivedChange
from mapweave.mapserver.log.integrity import Gap
from mapweave.mapserver.log.opening import open_store
from mapweave.mapserver.log.postgres_store import PostgresStore
from mapweave.mapserver.log.sql_sizes import ROW_BYTES, SqlSizes
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.mapserver.log.store import LogChanges, Store
from mapweave.wire.codec import encode_body, encode_change
from mapweave.wire.log_messages import Refusal, StoredChange
from synthetic.postgres_server import PostgresServer

MAP, OTHER = MapId("r0", 1), MapId("r1", 1)
CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.25)
HERE = PoseGaussian.from_sigmas(Pose2(), 0.1, 0.1)


def node_put(number: int, landmarks: int = 0, map_id: MapId = MAP) -> NodePut:
    seen = Landmarks(
        np.zeros((landmarks, 2), np.float32), np.zeros((landmarks, 32), np.uint8),
        np.full(landmarks, np.nan, np.float32), np.full(landmarks, np.nan, np.float32),
    )  # fmt: skip
    return NodePut(Node(NodeId(*map_id, number), 0, HERE, CAMERA, seen))


def edge_put(number: int, a: int, b: int, shared: list[tuple[int, int]] | None = None) -> EdgePut:
    pairs = np.array(shared or [], np.int64).reshape(-1, 2)
    ends = (NodeId(*MAP, a), NodeId(*MAP, b))
    return EdgePut(Edge(NodeId(*MAP, number), *ends, HERE, EdgeKind.LOOP, pairs))


def entry(sequence: int, body: ChangeBody | None = None, map_id: MapId = MAP) -> ReceivedChange:
    change = Change(map_id, sequence, 7, body or NodeRetired(NodeId(*map_id, sequence)))
    return ReceivedChange.read(map_id, sequence, encode_change(change))


def entries(bodies: Iterable[ChangeBody], first: int = 1) -> list[ReceivedChange]:
    return [entry(sequence, body) for sequence, body in enumerate(bodies, first)]


def broken(sequence: int) -> ReceivedChange:
    return ReceivedChange.read(MAP, sequence, b"\xc1garbage")


@pytest.fixture(params=["sqlite", "postgres"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Path | str:
    """Where a store is made."""
    if request.param == "sqlite":
        return tmp_path / "s0.sqlite"
    postgres: PostgresServer = request.getfixturevalue("postgres")
    return postgres.database()


@pytest.fixture
def store(place: Path | str) -> Iterator[Store]:
    store = open_store(place)
    yield store
    store.close()


def sequences(store: Store, map_id: MapId = MAP) -> list[int]:
    return [change.sequence for change in store.replay(map_id)]


@pytest.mark.parametrize("acknowledged", [4, 5, 6])
def test_a_log_is_compared_where_the_store_once_had_more_of_it(store: Store, acknowledged: int):
    store.doubt(MAP, acknowledged)
    assert store.unverified(MAP) is None, "there is nothing of this log"
    store.apply(MAP, 5, entries(node_put(k) for k in range(1, 6)))
    store.doubt(MAP, acknowledged)
    assert store.unverified(MAP) == ((MAP, 1, 5) if acknowledged > 5 else None)


def test_the_newest_change_is_known_by_its_body(store: Store):
    store.apply(MAP, 5, [entry(1), entry(2), broken(3)])
    second = StoredChange(2, zlib.crc32(encode_body(NodeRetired(NodeId(*MAP, 2)))))
    assert store.newest_change(MAP, 3) == store.newest_change(MAP, 2) == second, (
        "what was refused is not here"
    )
    assert store.newest_change(MAP, 1) != second and store.newest_change(MAP, 0) is None


def test_a_change_that_the_disk_damages_later_contradicts_no_robot(tmp_path):
    with closing(SqliteStore(tmp_path / "s0.sqlite")) as store:
        store.apply(MAP, 5, [entry(1), entry(2)])
        assert store.newest_change(MAP, 2) is not None
        with closing(sqlite3.connect(tmp_path / "s0.sqlite")) as disk, disk:
            disk.execute("UPDATE change SET body = zeroblob(length(body)) WHERE sequence = 2")
        assert store.newest_change(MAP, 2) is None and store.newest_change(MAP, 1) is not None


def test_an_unknown_map_is_empty(store: Store):
    assert (store.maps(), store.watermark(MAP), store.positions(), sequences(store)) == ([], 0, {}, [])


def test_doubles_are_left_out_and_gaps_stop(store: Store):
    assert store.apply(MAP, 5, [entry(1), entry(1), entry(2)]).watermark == 2
    applied = store.apply(MAP, 5, [entry(1), entry(2), entry(3), entry(5)])
    assert ([c.sequence for c in applied.changes], applied.watermark) == ([3], 3)
    assert store.apply(MAP, 5, [entry(5)]).changes == ()
    assert sequences(store) == [1, 2, 3]


def test_an_answer_for_a_range_may_have_holes(store: Store):
    applied = store.apply(MAP, 5, [entry(2), entry(5)], covered=7)
    assert ([c.sequence for c in applied.changes], applied.watermark) == ([2, 5], 7)
    assert store.apply(MAP, 5, [], covered=3).watermark == 7
    assert sequences(store) == [2, 5]


def test_all_is_there_after_a_restart(place: Path | str):
    store = open_store(place)
    store_id = store.id
    store.apply(MAP, 2**64 - 1, [entry(1, node_put(1, 3)), broken(2), entry(3)])
    store.apply(OTHER, 5, [])
    store.close()
    store = open_store(place)
    assert store.id == store_id
    assert store.maps() == [MAP, OTHER]
    assert (store.maps("r1"), store.maps("r")) == ([OTHER], [])
    assert store.positions([MAP]) == {MAP: (2**64 - 1, 3)}
    replayed = list(store.replay(MAP))
    assert [(c.sequence, c.stamp_ns) for c in replayed] == [(1, 7), (3, 7)]
    assert encode_body(replayed[0].body) == encode_body(node_put(1, 3))
    assert [refusal.sequence for refusal in store.refusals(MAP)] == [2]
    store.close()


def test_a_bad_change_is_kept_aside_and_the_log_goes_on(store: Store):
    applied = store.apply(MAP, 5, [entry(1), broken(2), entry(3)])
    assert [c.sequence for c in applied.changes] == [1, 3]
    assert applied.watermark == 3
    assert [refusal.sequence for refusal in applied.refusals] == [2]
    assert "MessagePack" in applied.refusals[0].reason
    assert store.refusals(MAP) == list(applied.refusals)
    assert store.refused() == 1
    assert store.apply(MAP, 5, [entry(2)]).changes == (), "it was settled"


def test_only_the_newest_refusals_are_given(store: Store):
    store.apply(MAP, 5, [broken(k) for k in range(1, 31)])
    assert [refusal.sequence for refusal in store.refusals(MAP, newest=3)] == [28, 29, 30]
    assert store.refused() == 30


@pytest.mark.parametrize(
    ("claimed", "sequence"), [(MapId("r1", 1), 1), (MapId("r0", 2), 1), (MapId("r0", 1), 2)]
)
def test_a_change_must_match_its_log(claimed: MapId, sequence: int):
    message = encode_change(Change(MAP, 1, 0, NodeRetired(NodeId(*MAP, 1))))
    read = ReceivedChange.read(claimed, sequence, message)
    assert isinstance(read.change, str)
    assert "came as" in read.change


def test_another_log_of_the_same_name_is_refused(store: Store):
    store.apply(MAP, 5, [entry(1)])
    with pytest.raises(InvalidValue, match=r"another log goes by the name r0\.1"):
        store.apply(MAP, 6, [entry(2)])
    assert sequences(store) == [1]


def test_many_logs_in_one_transaction(store: Store):
    store.apply(MAP, 5, [entry(1)])
    foreign = entry(1, node_put(1, 10, OTHER), OTHER)
    taken, other, mine, again = store.apply_all(
        [
            LogChanges(MAP, 6, [entry(2)]),
            LogChanges(OTHER, 7, [foreign]),
            LogChanges(MAP, 5, [entry(1), entry(2)]),
            LogChanges(MAP, 5, [entry(2), broken(3), entry(9)]),
        ]
    )
    assert isinstance(taken, InvalidValue) and "another log goes by the name r0.1" in str(taken)
    assert isinstance(other, Applied) and other.watermark == 1 and len(other.changes) == 1
    assert isinstance(mine, Applied) and [change.sequence for change in mine.changes] == [2]
    assert isinstance(again, Applied) and (again.watermark, len(again.refusals)) == (3, 1)
    assert (sequences(store), sequences(store, OTHER)) == ([1, 2], [1])
    assert store.apply_all([]) == []


def test_edges_to_landmarks_that_are_not_there_are_refused(store: Store):
    bodies: list[ChangeBody] = [
        node_put(1, landmarks=3), edge_put(11, 1, 2, [(2, 500)]),
        node_put(2, landmarks=5), edge_put(12, 1, 2, [(2, 4), (0, 0)]),
        edge_put(13, 1, 2, [(0, 0), (3, 0)]), edge_put(14, 1, 2, [(0, 5)]),
    ]  # fmt: skip
    applied = store.apply(MAP, 5, entries(bodies))
    assert applied.refusals == (
        Refusal(5, "edge r0.1.13 shares landmark 3 of r0.1.1, which has 3"),
        Refusal(6, "edge r0.1.14 shares landmark 5 of r0.1.2, which has 5"),
    )
    assert [c.sequence for c in applied.changes] == [1, 2, 3, 4], "2 is about a node that is unknown yet"


@settings(max_examples=25, deadline=None)
@given(st.lists(st.lists(st.integers(1, 12), max_size=8), max_size=12))
def test_any_input_makes_a_log(tmp_path_factory, batches: list[list[int]]):
    """Against the plain meaning: a set of what came, and the longest run from one."""
    store = SqliteStore(tmp_path_factory.mktemp("store") / "s")
    expected = 0
    passed_on: list[int] = []
    for batch in batches:
        applied = store.apply(MAP, 5, [entry(sequence) for sequence in sorted(batch)])
        while expected + 1 in batch:
            expected += 1
        passed_on += [change.sequence for change in applied.changes]
        assert applied.watermark == store.watermark(MAP) == expected
    assert passed_on == sequences(store) == list(range(1, expected + 1))
    store.close()


def fill_the_disk(store: Store) -> Callable[[], None]:
    """As if the disk were full at the fourth change of a log; returns what makes room."""
    if isinstance(store, SqliteStore):
        run = store._database.connection.execute
        run(
            "CREATE TRIGGER full BEFORE INSERT ON change WHEN NEW.sequence = 4 "
            "BEGIN SELECT RAISE(ABORT, 'database or disk is full'); END"
        )
        return lambda: run("DROP TRIGGER full")
    assert isinstance(store, PostgresStore)
    rows = store._reader.connection
    rows.execute(
        "CREATE FUNCTION refuse() RETURNS trigger LANGUAGE plpgsql AS "
        "$$ BEGIN RAISE disk_full USING MESSAGE = 'database or disk is full'; END $$"
    )
    rows.execute(
        "CREATE TRIGGER room BEFORE INSERT ON change FOR EACH ROW WHEN (NEW.sequence = 4) "
        "EXECUTE FUNCTION refuse()"
    )
    return lambda: rows.execute("DROP TRIGGER room ON change")


def test_a_transaction_that_fails_leaves_nothing(store: Store):
    store.apply(MAP, 5, [entry(1)])
    make_room = fill_the_disk(store)
    with pytest.raises(InvalidFile, match="disk is full"):
        store.apply(MAP, 5, [entry(2), broken(3), entry(4)])
    third = MapId("r2", 1)
    results = store.apply_all(
        [LogChanges(OTHER, 9, [], 4), LogChanges(MAP, 5, [entry(4)], 4), LogChanges(third, 9, [], 4)]
    )
    assert all(isinstance(one, InvalidFile) and "disk is full" in str(one) for one in results)
    assert len(results) == 3
    assert (store.watermark(MAP), store.refused(), sequences(store)) == (1, 0, [1])
    assert store.maps() == [MAP], "nothing of the other runs either"
    make_room()
    assert store.apply(MAP, 5, [entry(2), broken(3), entry(4)]).watermark == 4


def test_what_is_pruned_is_gone_and_is_not_taken_again(place: Path | str, monkeypatch):
    def refuse(*_: object) -> None:
        raise InvalidFile("the disk is full")

    store = open_store(place)
    log = entries([node_put(1, 3), node_put(2, 5), edge_put(11, 1, 2), node_put(3, 2), edge_put(12, 2, 3)])
    store.apply(MAP, 5, log)
    store.apply(OTHER, 6, [entry(1, node_put(1, 4, OTHER), OTHER)])
    edges = [EdgeId(*MAP, k) for k in (11, 12)]
    with monkeypatch.context() as patch, pytest.raises(InvalidFile, match="full"):
        patch.setattr(store, "_put", refuse)
        store.prune([NodeId(*MAP, 2)], edges, {"pruned 0": b"one node"})
    assert sequences(store) == [1, 2, 3, 4, 5] and store.landmarks(NodeId(*MAP, 2)) == 5
    store.prune([NodeId(*MAP, 2)], edges, {"pruned 0": b"one node"})
    for _ in range(2):
        assert sequences(store) == [1, 4] and store.result("pruned 0") == b"one node"
        assert sequences(store, OTHER) == [1]
        assert store.kept("r0") == {MAP: (2, 5)} and store.landmarks(NodeId(*MAP, 2)) is None
        assert store.watermark(MAP) == 5 and store.damaged() == []
        assert store.apply(MAP, 5, log).changes == (), "a robot that sends all again changes nothing"
        store.close()
        store = open_store(place)
    store.close()


def test_what_comes_while_nodes_are_pruned_stays(store: Store):
    """A node that is put again behind what was known then is there again, by its new change alone."""
    store.apply(MAP, 5, entries([node_put(1, 3), node_put(2, 5), edge_put(11, 1, 2)]))
    store.apply(MAP, 5, entries([node_put(2, 4), edge_put(11, 1, 2)], 4))
    nodes, edges = [NodeId(*MAP, 1), NodeId(*MAP, 2)], [EdgeId(*MAP, 11)]
    assert store.prune(nodes, edges, {"pruned 0": b"two nodes"}, {OTHER: 9}), "nothing of this log was known"
    assert sequences(store) == [1, 2, 3, 4, 5] and store.kept("r0") == {MAP: (2, 7)}
    assert store.prune(nodes, edges, {"pruned 0": b"two nodes"}, {MAP: 3})
    assert sequences(store) == [4, 5] and store.kept("r0") == {MAP: (1, 4)}
    assert [store.landmarks(node) for node in nodes] == [None, 4]


def test_what_another_server_has_pruned_by_then_is_not_written_over(store: Store):
    store.apply(MAP, 5, [entry(1, node_put(1, 3)), entry(2, node_put(2, 5))])
    nodes = [NodeId(*MAP, 1)]
    assert store.prune(nodes, [], {"mark": b"1", "pruned 0": b"one"}, None, {"mark": None})
    for known in (None, b"0", b""):
        assert not store.prune(
            [NodeId(*MAP, 2)], [], {"mark": b"2", "pruned 0": b"two"}, None, {"mark": known}
        )
    assert sequences(store) == [2] and (store.result("mark"), store.result("pruned 0")) == (b"1", b"one")
    assert store.prune([NodeId(*MAP, 2)], [], {"mark": b"2"}, None, {"mark": b"1"})
    assert sequences(store) == [] and store.result("mark") == b"2"


def test_what_a_lost_retirement_undid_goes_when_the_robot_has_dropped_it(place: Path | str):
    store = open_store(place)
    before = [node_put(1, 3), node_put(2, 5), edge_put(11, 1, 2), node_put(2, 4)]
    store.apply(MAP, 5, entries([*before, node_put(3, 2), edge_put(11, 1, 3)]), 8)
    assert store.unverified(MAP) is None
    whole = store.restore(MAP, 7, 7, [entry(7, node_put(4, 1))])
    assert [change.sequence for change in whole] == [7] and store.unverified(MAP) is None
    assert list(store.restore(MAP, 8, 8, [])) == []
    assert store.unverified(MAP) == Gap(MAP, 1, 7), "the robot has no change 8 any more"
    # Node 2 is retired; of edge 11 the later form is there.
    assert [change.body for change in store.verify(MAP, 1, 4, {1})] == [NodeRetired(NodeId(*MAP, 2))]
    for _ in range(2):
        assert store.unverified(MAP) == Gap(MAP, 5, 7) and store.unverified(OTHER) is None
        assert sequences(store) == [1, 5, 6, 7] and store.landmarks(NodeId(*MAP, 2)) is None
        store.close()
        store = open_store(place)
    assert [change.body for change in store.verify(MAP, 5, 7, {5, 7})] == [EdgeRetired(EdgeId(*MAP, 11))]
    assert store.unverified(MAP) is None and sequences(store) == [1, 5, 7]
    assert store.kept("r0") == {MAP: (3, 6)} and store.traffic(MAP).edge_puts == 0
    store.close()


def test_the_wire_bytes_of_the_maps(store: Store):
    assert store.traffic().node_puts == 0
    log = entries([node_put(1, 100), node_put(1, 120), node_put(2, 50), edge_put(11, 1, 2)])
    store.apply(MAP, 5, log)
    store.apply(MAP, 5, log)
    sizes = [len(first.message) for first in log]
    traffic = store.traffic(MAP)
    assert (traffic.nodes, traffic.node_puts, traffic.edge_puts) == (2, 3, 1)
    assert (traffic.node_bytes, traffic.edge_bytes) == (sum(sizes[:3]), sizes[3])
    assert store.traffic(OTHER).node_puts == 0
    assert store.traffic() == traffic
    second = entry(1, node_put(1, 10, OTHER), OTHER)
    store.apply(OTHER, 5, [second])
    assert store.traffic().nodes == 3
    assert store.traffic().payload_bytes == sum(sizes) + len(second.message)


def test_results_are_kept_by_name(store: Store):
    assert store.result("poses") is None
    store.put_result("poses", b"1")
    store.put_result("poses", b"2")
    assert store.result("poses") == b"2"


def test_a_secret_is_drawn_once_for_all_servers_of_a_store(place: Path | str):
    first = open_store(place)
    drawn = first.secret("choice")
    assert len(drawn) == 16
    assert drawn not in (first.secret("another"), first.id.to_bytes(8, "big") * 2)
    if isinstance(first, PostgresStore):
        with closing(open_store(place, "s1")) as second:
            assert second.secret("choice") == drawn
    first.close()
    with closing(open_store(place)) as again:
        assert again.secret("choice") == drawn


def test_a_secret_that_the_disk_does_not_take_is_used_all_the_same(tmp_path, monkeypatch):
    with closing(SqliteStore(tmp_path / "s0.sqlite")) as store:

        def full(*_: object) -> None:
            raise InvalidFile("the disk is full")

        monkeypatch.setattr(SqliteStore, "_put", full)
        assert len(store.secret("choice")) == 16
        assert store.result("choice") is None


def test_a_journal_is_no_store(tmp_path):
    from mapweave.agent.replication.journal import Journal

    Journal(tmp_path / "j", "r0").close()
    with pytest.raises(InvalidFile, match="is not a Mapweave map store"):
        SqliteStore(tmp_path / "j")


def contents(store: Store) -> set[bytes]:
    """What the map is, by its replay."""
    return {encode_body(body) for body in HybridMap(change.body for change in store.replay(MAP)).contents()}


def test_what_later_changes_supersede_is_compacted(place: Path | str):
    gone = NodeRetired(NodeId(*MAP, 3))
    bodies: list[ChangeBody] = [
        node_put(1, 3), node_put(2, 5), edge_put(11, 1, 2), node_put(1, 4), node_put(3, 1), gone,
        edge_put(11, 1, 2), node_put(1, 6), node_put(3, 2), gone, EdgeRetired(EdgeId(*MAP, 11)),
        edge_put(11, 2, 1), edge_put(12, 1, 3), node_put(3, 7),
    ]  # fmt: skip
    store = open_store(place)
    log = entries(bodies)
    store.apply(MAP, 5, log)
    store.apply(OTHER, 5, [entry(1, node_put(1, 4, OTHER), OTHER)])
    before, size = contents(store), store.stored_bytes(MAP, 0, 14)
    assert size == sum(len(one.message) + ROW_BYTES for one in log)
    assert store.stored_bytes(MAP, 3, 13) == sum(len(one.message) + ROW_BYTES for one in log[3:13])
    found = dict(store.superseded(MAP, 100))
    assert sorted(found) == [1, 3, 4, 5, 6, 7, 9] and len(store.superseded(MAP, 3)) == 3
    assert found == {sequence: len(log[sequence - 1].message) + ROW_BYTES for sequence in found}
    store.drop(MAP, list(found))
    for _ in range(2):
        assert sequences(store) == [2, 8, 10, 11, 12, 13, 14], "of each the newest, and the last retirement"
        assert contents(store) == before and sequences(store, OTHER) == [1]
        assert store.landmarks(NodeId(*MAP, 1)) == 6 and store.kept("r0") == {MAP: (3, 18)}
        assert store.watermark(MAP) == 14 and store.damaged() == [] and store.unverified(MAP) is None
        assert store.apply(MAP, 5, log).changes == (), "a robot that sends all again changes nothing"
        assert store.stored_bytes(MAP, 0, 14) < size
        store.close()
        store = open_store(place)
    store.close()


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 3), st.integers(1, 4), st.integers(5, 6)), max_size=30))
def test_a_compacted_map_is_the_same(tmp_path_factory, steps: list[tuple[int, int, int]]):
    """Also for a server that has read a part of the log before, and reads the rest of it afterwards."""
    bodies: list[ChangeBody] = []
    for kind, number, other in steps:
        node, edge = NodeId(*MAP, number), EdgeId(*MAP, 10 + number)
        made = [node_put(number, len(bodies)), NodeRetired(node), edge_put(10 + number, number, other),
                EdgeRetired(edge)]  # fmt: skip
        bodies.append(made[kind])
    store = SqliteStore(tmp_path_factory.mktemp("store") / "s")
    store.apply(MAP, 5, entries(bodies))
    whole = contents(store)
    read_before = [HybridMap(bodies[:known]) for known in range(len(bodies) + 1)]
    store.drop(MAP, [sequence for sequence, _ in store.superseded(MAP, 10_000)])
    assert contents(store) == whole
    for known, hybrid in enumerate(read_before):
        for change in store.replay(MAP, known):
            hybrid.apply(change.body)
        assert {encode_body(body) for body in hybrid.contents()} == whole, f"after {known}"
    store.close()


def test_reasons_of_refusals_are_bounded(store: Store, monkeypatch):
    monkeypatch.setattr("mapweave.mapserver.log.store.MOST_REFUSED_KEPT", 3)
    monkeypatch.setattr("mapweave.mapserver.log.store.MOST_REFUSALS", 10)
    store.apply(MAP, 5, [broken(k) for k in range(1, 41)])
    assert store.refused() == 10 and store.watermark(MAP) == 40
    assert [refusal.sequence for refusal in store.refusals(MAP)] == [1, 2, 3, *range(34, 41)]
    assert store.stored_bytes(MAP, 0, 40) < 10 * (ROW_BYTES + 200)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 5), st.sampled_from([MAP, OTHER]), st.integers(1, 4)), max_size=20))
def test_what_is_remembered_of_nodes_is_what_the_rows_say(
    tmp_path_factory, steps: list[tuple[int, MapId, int]]
):
    store = SqliteStore(tmp_path_factory.mktemp("store") / "s")
    nodes = [NodeId(*map_id, number) for map_id in (MAP, OTHER) for number in range(1, 5)]
    log_ids = {MAP: 5, OTHER: 6}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sqlite_store, "MOST_MAPS", 1)
        for count, (kind, map_id, number) in enumerate(steps, 1):
            put = node_put(number, count, map_id)
            last = store.watermark(map_id)
            coming = entry(last + 1, put, map_id)
            run = LogChanges(map_id, log_ids[map_id], [coming])
            if kind <= 1:
                assert not isinstance(store.apply_all([run])[0], MapweaveError)
            elif kind == 2:
                with patch.context() as failing:
                    failing.setattr(store, "_apply", failing_behind(store._apply))
                    with pytest.raises(ZeroDivisionError):
                        store.apply_all([run])
            elif kind == 3:
                store.prune([NodeId(*map_id, number)], [], {})
            elif kind == 4 and last:
                store.drop(map_id, [sequence for sequence, _ in store.superseded(map_id, 100)])
            elif last:
                list(store.restore(map_id, last, last, [replace(coming, sequence=last)]))
                store.verify(map_id, 1, last - 1, {1})
            assert [store.landmarks(n) for n in nodes] == [SqlSizes.landmarks(store, n) for n in nodes]
    store.close()


def failing_behind(apply: Callable[..., object]) -> Callable[..., object]:
    """What has been written by then is rolled back."""

    def fail(*args: Any) -> object:
        apply(*args)
        raise ZeroDivisionError

    return fail
