"""The journal: appended changes are there, whatever happens to the process or the file."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave import Camera, Edge, EdgeKind, HybridMap, Landmarks, MapId, Node, NodeId, Pose2, PoseGaussian
from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.retained_map import RetainedMap
from mapweave.hybridmap.change import Change, ChangeBody, EdgePut, EdgeRetired, NodePut, NodeRetired
from mapweave.hybridmap.errors import InvalidFile, InvalidValue
from mapweave.wire.codec import decode_change, encode_body, encode_change
from tests.programs import python

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.25)
MAP = MapId("r0", 1)


def node_put(number: int, x: float = 0.0) -> NodePut:
    here = PoseGaussian.from_sigmas(Pose2(x, 0, 0), 0.1, 0.1)
    return NodePut(Node(NodeId(*MAP, number), 0, here, CAMERA, Landmarks.empty()))


def edge_put(number: int, a: int, b: int, x: float = 0.0) -> EdgePut:
    relative = PoseGaussian.from_sigmas(Pose2(x, 0, 0), 0.1, 0.1)
    ends = (NodeId(*MAP, a), NodeId(*MAP, b))
    return EdgePut(Edge(NodeId(*MAP, number), *ends, relative, EdgeKind.MAPPED))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "r0.sqlite"


@pytest.fixture
def journal(path: Path, opened) -> Journal:
    return opened(Journal(path, "r0"))


def as_bytes(changes: list[Change]) -> list[bytes]:
    return [encode_change(change) for change in changes]


def test_appended_changes_come_back_after_a_restart(path: Path):
    journal = Journal(path, "r0")
    map_id = journal.open_map(None)
    assert map_id == MAP
    first = journal.append(map_id, [node_put(1), node_put(2, 0.5)], 10)
    second = journal.append(map_id, [edge_put(3, 1, 2)], 20)
    assert [c.sequence for c in first + second] == [1, 2, 3]
    journal.close()

    journal = Journal(path, "r0")
    assert journal.open_map(1) == map_id
    assert journal.head(map_id) == 3
    assert as_bytes(journal.changes(map_id, 1, 99)) == as_bytes(first + second)
    assert as_bytes(journal.changes(map_id, 2, 2)) == as_bytes(first[1:])
    assert [c.stamp_ns for c in journal.changes(map_id, 1, 3)] == [10, 10, 20]
    assert [encode_body(b) for b in journal.replay(map_id)] == [encode_body(c.body) for c in first + second]
    assert [decode_change(row).sequence for _, row in journal.rows(map_id, 2, 3)] == [2, 3]
    assert journal.append(map_id, [NodeRetired(NodeId(*MAP, 1))], 30)[0].sequence == 4
    journal.close()


def test_a_fresh_map_is_another_and_keeps_the_first(journal: Journal):
    one, two, far = journal.open_map(None), journal.open_map(None), journal.open_map(1_700_000_000_000)
    assert (one.epoch, two.epoch) == (1, 2)
    assert journal.open_map(None).epoch == far.epoch + 1
    journal.append(one, [node_put(1)], 0)
    assert (journal.head(one), journal.head(two)) == (1, 0)
    assert len({journal.log_id(map_id) for map_id in (one, two, far)}) == 3
    assert [map_id.epoch for map_id in journal.maps()] == [1, 2, far.epoch, far.epoch + 1]


def test_two_disks_never_have_the_same_log(tmp_path):
    ids = []
    for k in range(2):
        journal = Journal(tmp_path / f"{k}", "r0")
        ids.append(journal.log_id(journal.open_map(1)))
        journal.close()
    assert ids[0] != ids[1]


def test_long_replays_are_read_in_pieces(journal: Journal):
    map_id = journal.open_map(None)
    journal.append(map_id, [node_put(k) for k in range(1, 601)], 0)
    assert [body.node.id.number for body in journal.replay(map_id) if isinstance(body, NodePut)] == list(
        range(1, 601)
    )


def test_all_of_a_batch_or_nothing(journal: Journal):
    map_id = journal.open_map(None)
    journal.append(map_id, [node_put(1)], 0)
    foreign = NodeRetired(NodeId("r1", 1, 1))
    broken = edge_put(5, 2, 2)
    for bad in (foreign, broken):
        with pytest.raises(InvalidValue):
            journal.append(map_id, [node_put(2), bad], 0)
    with pytest.raises(InvalidValue, match="never opened"):
        journal.append(MapId("r0", 7), [], 0)
    with pytest.raises(InvalidValue, match="has no map r1"):
        journal.head(MapId("r1", 1))
    assert journal.head(map_id) == 1


def test_acknowledgements_only_grow_and_stay(path: Path, journal: Journal, opened):
    map_id = journal.open_map(None)
    journal.append(map_id, [node_put(k) for k in range(1, 6)], 0)
    journal.acknowledge("s0", map_id, 4)
    journal.acknowledge("s0", map_id, 2)
    journal.acknowledge("s1", map_id, 1)
    with pytest.raises(InvalidValue, match="there are 5"):
        journal.acknowledge("s0", map_id, 6)
    journal.close()
    again = opened(Journal(path, "r0"))
    assert again.acknowledged(map_id) == {"s0": 4, "s1": 1}


def test_pruning_waits_for_every_required_server(journal: Journal):
    map_id = journal.open_map(None)
    journal.append(map_id, [node_put(1, x) for x in range(5)], 0)
    assert journal.prune(map_id, ["s0", "s1"]) == 0
    journal.acknowledge("s0", map_id, 5)
    assert journal.prune(map_id, ["s0", "s1"]) == 0
    assert journal.prune(map_id, []) == 0
    journal.acknowledge("s1", map_id, 3)
    assert journal.prune(map_id, ["s0", "s1"]) == 2
    assert [change.sequence for change in journal.changes(map_id, 1, 5)] == [3, 4, 5]
    assert journal.head(map_id) == 5


def test_of_what_is_retired_nothing_stays_once_all_have_it(journal: Journal):
    map_id = journal.open_map(None)
    retired = [NodeRetired(NodeId(*MAP, 2)), EdgeRetired(NodeId(*MAP, 13))]
    nodes, edges = map(node_put, (1, 2, 3)), [edge_put(11, 1, 2), edge_put(12, 2, 3), edge_put(13, 1, 3)]
    log = [*nodes, *edges, *retired, node_put(20)]
    journal.append(map_id, log, 0)
    before = state(journal.replay(map_id))
    journal.acknowledge("s0", map_id, 9)
    journal.acknowledge("s1", map_id, 7)
    # Another server that has had the log lacks a retirement; the node's is on its disk.
    assert journal.prune(map_id, ["s0"]) == 5
    assert [change.sequence for change in journal.changes(map_id, 1, 9)] == [1, 3, 8, 9]
    journal.acknowledge("s1", map_id, 9)
    assert journal.prune(map_id, ["s0"]) == 1
    assert [change.sequence for change in journal.changes(map_id, 1, 9)] == [1, 3, 9]
    assert state(journal.replay(map_id)) == before and RetainedMap.of(journal, map_id).next_number == 21


def test_the_greatest_number_stays_and_what_takes_it_away(journal: Journal):
    map_id = journal.open_map(None)
    journal.append(map_id, [node_put(1), node_put(2), edge_put(11, 1, 2), NodeRetired(NodeId(*MAP, 2))], 0)
    journal.append(map_id, [node_put(1, 3.0)], 0)
    before = state(journal.replay(map_id))
    journal.acknowledge("s0", map_id, 5)
    assert journal.prune(map_id, ["s0"]) == 2
    assert state(journal.replay(map_id)) == before and RetainedMap.of(journal, map_id).next_number == 12


def state(contents: Iterator[ChangeBody]) -> tuple[dict[NodeId, bytes], dict[NodeId, bytes], set[object]]:
    """What a replay makes, without the order of nodes."""
    hybrid = HybridMap(contents)
    nodes = {key: encode_body(NodePut(node)) for key, node in hybrid.nodes.items()}
    edges = {key: encode_body(EdgePut(edge)) for key, edge in hybrid.edges.items()}
    return nodes, edges, {frozenset(component) for component in hybrid.components()}


ids = st.integers(1, 4)
bodies = st.one_of(
    st.builds(node_put, ids, st.floats(0, 9)),
    st.builds(lambda k: NodeRetired(NodeId(*MAP, k)), ids),
    st.builds(
        lambda k, ends, x: edge_put(k, ends[0], ends[1], x),
        st.integers(11, 14), st.permutations([1, 2, 3, 4]), st.floats(0, 9),
    ),
    st.builds(lambda k: EdgeRetired(NodeId(*MAP, k)), st.integers(11, 14)),
)  # fmt: skip


@settings(max_examples=30, deadline=None)
@given(st.lists(bodies, min_size=1, max_size=30), st.data())
def test_pruning_never_changes_the_map(tmp_path_factory, log: list[ChangeBody], data: st.DataObject):
    acknowledged = data.draw(st.integers(0, len(log)))
    with closing(Journal(tmp_path_factory.mktemp("prune") / "j", "r0")) as journal:
        map_id = journal.open_map(None)
        journal.append(map_id, log, 0)
        before, number = state(journal.replay(map_id)), RetainedMap.of(journal, map_id).next_number
        journal.acknowledge("s0", map_id, acknowledged)
        dropped = journal.prune(map_id, ["s0"])
        assert state(journal.replay(map_id)) == before
        assert RetainedMap.of(journal, map_id).next_number == number
        assert journal.head(map_id) == len(log)
        kept = {change.sequence for change in journal.changes(map_id, 1, len(log))}
        assert len(kept) == len(log) - dropped
        assert set(range(acknowledged + 1, len(log) + 1)) <= kept


def test_another_agents_journal_is_refused(path: Path, journal: Journal):
    journal.close()
    with pytest.raises(InvalidFile, match=r"r0\.sqlite: is the journal of agent r0, not of r1"):
        Journal(path, "r1")
    Journal(path, "r0").close()


def test_a_journal_in_use_is_refused(path: Path, journal: Journal):
    journal.open_map(None)
    program = (
        "import sqlite3, sys, mapweave.storage.database as d\n"
        "connect = sqlite3.connect\n"
        "d.sqlite3.connect = lambda *a, **k: connect(*a, **{**k, 'timeout': 0.1})\n"
        "from mapweave.agent.replication.journal import Journal\n"
        "from mapweave.hybridmap.errors import InvalidFile\n"
        "from pathlib import Path\n"
        f"try: Journal(Path({str(path)!r}), 'r0')\n"
        "except InvalidFile as error: print(error)\n"
    )
    assert python("-c", program, check=True).stdout == (
        f"{path}: agent journal is in use by another process; stop it first\n"
    )


@pytest.mark.parametrize("data", [b"no database at all" * 100, b"SQLite format 3\0" + b"\xff" * 4096])
def test_no_database_is_refused(path: Path, data: bytes):
    path.write_bytes(data)
    with pytest.raises(InvalidFile, match=r"r0\.sqlite: agent journal cannot be used") as error:
        Journal(path, "r0")
    assert "\n" not in str(error.value)


def test_another_programs_database_is_refused(path: Path):
    other = sqlite3.connect(path)
    other.execute("CREATE TABLE song (name TEXT)")
    other.commit()
    other.close()
    with pytest.raises(InvalidFile, match="is not a Mapweave agent journal"):
        Journal(path, "r0")
    other = sqlite3.connect(path)
    assert other.execute("SELECT count(*) FROM song").fetchone() == (0,), "it is left as it was"
    other.close()


def test_a_newer_format_is_refused(path: Path, journal: Journal):
    journal.close()
    other = sqlite3.connect(path)
    other.execute("PRAGMA user_version = 9")
    other.close()
    with pytest.raises(
        InvalidFile, match=r"of format 9, this program uses 1: a newer version .*: upgrade this"
    ):
        Journal(path, "r0")


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(InvalidFile, match="cannot be used"):
        Journal(tmp_path / "nowhere" / "r0.sqlite", "r0")


def test_a_truncated_journal_is_refused(path: Path, journal: Journal):
    journal.append(journal.open_map(None), [node_put(k) for k in range(1, 300)], 0)
    journal.close()
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(InvalidFile, match=r"r0\.sqlite: agent journal"):
        Journal(path, "r0")


def test_a_damaged_change_is_found(path: Path, journal: Journal):
    map_id = journal.open_map(None)
    changes = journal.append(map_id, [node_put(k, 1.5) for k in range(1, 10)], 0)
    journal.close()
    # A flipped bit inside a pose: it would decode without complaint.
    data = bytearray(path.read_bytes())
    place = data.rfind(np.float32(1.5).tobytes())
    data[place] ^= 1
    path.write_bytes(data)
    journal = Journal(path, "r0")
    with pytest.raises(InvalidFile, match=r"r0\.sqlite: change \d is damaged"):
        list(journal.replay(map_id))
    rows = journal.rows(map_id, 1, 9)
    assert [row for _, row in rows].count(b"") == 1, "servers get an empty message in its place"
    assert [s for s, _ in rows] == [change.sequence for change in changes]
    journal.close()
