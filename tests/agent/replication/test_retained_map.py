"""What a journal has kept of a map: what is in force, numbers that were never used, and what is damaged."""

import sqlite3
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave import Camera, Edge, EdgeKind, HybridMap, Landmarks, MapId, Node, NodeId, Pose2, PoseGaussian
from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.retained_map import RetainedMap
from mapweave.hybridmap.change import ChangeBody, EdgePut, EdgeRetired, NodePut, NodeRetired
from mapweave.hybridmap.errors import InvalidValue
from mapweave.wire.codec import encode_body

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.25)
MAP = MapId("r0", 1)


def node(number: int, x: float = 0.0) -> NodePut:
    here = PoseGaussian.from_sigmas(Pose2(x, 0, 0), 0.1, 0.1)
    return NodePut(Node(NodeId(*MAP, number), 0, here, CAMERA, Landmarks.empty()))


def edge(number: int, a: int, b: int) -> EdgePut:
    relative = PoseGaussian.from_sigmas(Pose2(), 0.1, 0.1)
    ends = NodeId(*MAP, a), NodeId(*MAP, b)
    return EdgePut(Edge(NodeId(*MAP, number), *ends, relative, EdgeKind.MAPPED))


def kept_of(path: Path, log: list[ChangeBody], damage: tuple[int, ...] = ()) -> RetainedMap:
    """The rest of a log, after some changes were damaged on the disk."""
    journal = Journal(path, "r0")
    journal.append(journal.open_map(1), log, 0)
    journal.close()
    with sqlite3.connect(path) as disk:
        for sequence in damage:
            disk.execute("UPDATE change SET body = zeroblob(length(body)) WHERE sequence = ?", (sequence,))
    disk.close()
    journal = Journal(path, "r0")
    kept = RetainedMap.of(journal, MAP)
    journal.close()
    return kept


def numbers(kept: RetainedMap) -> list[int]:
    return [b.node.id.number if isinstance(b, NodePut) else b.edge.id.number for b in kept.contents]


ids, edge_ids = st.integers(1, 5), st.integers(11, 15)
bodies = st.one_of(
    st.builds(node, ids, st.floats(0, 9)),
    st.builds(lambda k: NodeRetired(NodeId(*MAP, k)), ids),
    st.builds(lambda k, ends: edge(k, *ends[:2]), edge_ids, st.permutations([1, 2, 3, 4, 5])),
    st.builds(lambda k: EdgeRetired(NodeId(*MAP, k)), edge_ids),
)


@settings(max_examples=25, deadline=None)
@given(st.lists(bodies, min_size=1, max_size=30), st.booleans())
def test_a_sound_log_gives_its_replay_and_numbers_above_all(
    tmp_path_factory, log: list[ChangeBody], pruned: bool
):
    path = tmp_path_factory.mktemp("kept") / "j"
    journal = Journal(path, "r0")
    journal.append(journal.open_map(1), log, 0)
    if pruned:
        journal.acknowledge("s0", MAP, len(log))
        journal.prune(MAP, ["s0"])
    kept = RetainedMap.of(journal, MAP)
    journal.close()
    whole = HybridMap(log)
    loose = [e.id for e in whole.edges.values() if e.a not in whole.nodes or e.b not in whole.nodes]
    for item in loose:
        whole.apply(EdgeRetired(item))
    assert sorted(map(encode_body, kept.contents)) == sorted(map(encode_body, whole.contents()))
    used = {b.node.id.number for b in log if isinstance(b, NodePut)}
    used |= {b.edge.id.number for b in log if isinstance(b, EdgePut)}
    used |= {b.id.number for b in log if isinstance(b, NodeRetired | EdgeRetired)}
    assert kept.next_number == max(used) + 1
    assert kept.complaint == ""


def test_an_empty_map_begins_with_one(tmp_path):
    assert kept_of(tmp_path / "j", []) == RetainedMap((), 1)


def test_retired_numbers_are_not_given_again(tmp_path):
    kept = kept_of(tmp_path / "j", [node(1), node(2), node(7), NodeRetired(NodeId(*MAP, 7))])
    assert numbers(kept) == [1, 2]
    assert kept.next_number == 8


def test_a_damaged_node_is_missing_with_its_edges_and_reported(tmp_path):
    kept = kept_of(tmp_path / "j", [node(1), node(2), edge(3, 1, 2), node(4), edge(5, 1, 4)], damage=(4,))
    assert numbers(kept) == [1, 2, 3]
    assert kept.next_number == 6
    assert kept.complaint == (
        "1 of 5 changes of map r0.1 are damaged on the disk, the first is 4: the map goes on without them "
        "and without 1 edges at nodes that are missing"
    )


def test_the_last_number_counts_even_if_it_is_damaged(tmp_path):
    kept = kept_of(tmp_path / "j", [node(1), node(9)], damage=(2,))
    assert numbers(kept) == [1]
    assert kept.next_number == 10


def test_a_damaged_retirement_still_retires(tmp_path):
    log = [node(1), node(2), edge(3, 1, 2), EdgeRetired(NodeId(*MAP, 3)), NodeRetired(NodeId(*MAP, 2))]
    assert numbers(kept_of(tmp_path / "j", log, damage=(4, 5))) == [1]


def test_an_older_state_is_used_where_the_newer_is_damaged(tmp_path):
    kept = kept_of(tmp_path / "j", [node(1, 1.0), node(1, 2.0)], damage=(2,))
    (put,) = kept.contents
    assert isinstance(put, NodePut)
    assert put.node.map_from_robot.mean.x == pytest.approx(1.0)
    assert "damaged" in kept.complaint
    assert "\n" not in kept.complaint


def test_another_agents_map_is_refused(tmp_path, opened):
    journal = opened(Journal(tmp_path / "j", "r0"))
    with pytest.raises(InvalidValue, match="has no map r1"):
        RetainedMap.of(journal, MapId("r1", 1))


def test_drives_among_nodes_of_others_are_kept(tmp_path):
    """They are not in this journal, and not missing for that; an own node that is damaged is."""
    here = PoseGaussian.from_sigmas(Pose2(1.0), 0.1, 0.1)
    other = NodeId("r1", 1, 4)

    def driven(number: int, a: NodeId) -> EdgePut:
        return EdgePut(Edge(NodeId(*MAP, number), a, other, here, EdgeKind.DRIVEN))

    log = [
        node(1), node(2), driven(3, NodeId(*MAP, 1)), driven(4, NodeId(*MAP, 2)),
        driven(5, NodeId("r1", 1, 3)),
    ]  # fmt: skip
    assert numbers(kept_of(tmp_path / "j", log, damage=(2,))) == [1, 3, 5]
