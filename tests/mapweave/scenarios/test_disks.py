"""Journals against the store: missing changes are counted, and a hash distinguishes maps."""

import numpy as np
import pytest

from mapweave import Camera, Edge, EdgeKind, Landmarks, MapId, Node, NodeId, Pose2, PoseGaussian
from mapweave.agent.replication.journal import Journal
from mapweave.hybridmap.change import Change, EdgePut, NodePut, NodeRetired
from mapweave.mapserver.log.entry import ReceivedChange
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.mapserver.log.store import Store
from mapweave.scenarios.disks import map_hash, read_disks
from mapweave.wire.codec import encode_change

CAMERA = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, 0.3)
MAP = MapId("r0", 1)


def node(number: int, x: float = 0.0) -> NodePut:
    pose = PoseGaussian.from_sigmas(Pose2(x), 0.1, 0.1)
    return NodePut(Node(NodeId("r0", 1, number), number, pose, CAMERA, Landmarks.empty()))


def edge(number: int, a: int, b: int) -> EdgePut:
    between = PoseGaussian.from_sigmas(Pose2(1.0), 0.1, 0.1)
    ends = NodeId("r0", 1, a), NodeId("r0", 1, b)
    return EdgePut(Edge(NodeId("r0", 1, number), *ends, between, EdgeKind.MAPPED, np.zeros((0, 2), np.int64)))


BODIES = [node(1), node(2, 1.0), edge(3, 1, 2), node(4, 2.0), NodeRetired(NodeId("r0", 1, 1))]


@pytest.fixture
def disks(tmp_path):
    """A journal with all, and a function that puts some of it into the store and compares."""
    journal = Journal(tmp_path / "r0.sqlite", "r0")
    journal.open_map(1)
    changes = journal.append(MAP, BODIES, 5)
    log_id = journal.log_id(MAP)
    size = sum(len(data) for _, data in journal.rows(MAP, 1, journal.head(MAP)))
    journal.close()

    def compare(kept: list[Change]):
        store = SqliteStore(tmp_path / "s0.sqlite")
        entries = [(c.sequence, encode_change(c)) for c in kept]
        fill(store, log_id, entries)
        store.close()
        return read_disks(tmp_path, tmp_path / "s0.sqlite", ["r0"])["r0"]

    return changes, size, compare


def fill(store: Store, log_id: int, entries):
    store.apply(MAP, log_id, [ReceivedChange.read(MAP, sequence, message) for sequence, message in entries])


def test_everything_is_there(disks):
    changes, size, compare = disks
    record = compare(changes)
    assert record.unsaved == 0
    assert record.map_bytes == size


def test_missing_changes_are_counted(disks):
    changes, _, compare = disks
    # Without the fourth change node 4 is missing; the retirement after it has not come either.
    record = compare(changes[:3])
    assert record.unsaved == 1


def test_nothing_came(disks):
    _, _, compare = disks
    assert compare([]).unsaved == 2  # nodes 2 and 4; node 1 is retired and its edge with it


def test_the_hash_depends_on_content_and_not_on_order():
    first = map_hash([(MAP, [node(1), node(2, 1.0)])])
    assert first == map_hash([(MAP, [node(2, 1.0), node(1)])])
    assert first != map_hash([(MAP, [node(1), node(2, 1.001)])])
    assert first != map_hash([(MapId("r0", 2), [node(1), node(2, 1.0)])])
    assert map_hash([]) != first
