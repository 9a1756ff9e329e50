"""Superseded nodes leave the map after a time: what stays is where it was, also after a restart."""

import gc
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from mapweave.hybridmap.annotation import Annotations
from mapweave.hybridmap.change import Change, NodePut
from mapweave.hybridmap.constraint_subject import RetiredNodes
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.pruned_node import PrunedNode, PrunedNodes
from mapweave.mapserver.log.entry import ReceivedChange
from mapweave.mapserver.log.opening import open_store
from mapweave.mapserver.log.store import Store
from mapweave.mapserver.map_files import map_file_of, merged_of
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.merging.pruning import DAY_NS, PrunePlan, Pruning
from mapweave.mapserver.merging.pruning_record import PruningRecord
from mapweave.mapserver.places import PlaceResolver
from mapweave.mapserver.routes import Router
from mapweave.merge.pose_graph.marginalization import is_marginal
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.opened_map import open_map
from mapweave.storage.map_file import pack_map_file, unpack_map_file
from mapweave.wire.codec import encode_change
from synthetic.maps import changes_of, numbered
from synthetic.world import room, take_map

MAPS = OLD, OTHER, NEW = MapId("r0", 1), MapId("r1", 1), MapId("r0", 2)
BEGIN = 1_700_000_000_000_000_000
DAYS = 14.0


class Logs:
    """Two robots through one hall, and the first once more beside its way."""

    def __init__(self) -> None:
        rng = np.random.default_rng(3)
        world = room(0, 0, 8, 4, 1600, rng)
        self.changes: dict[MapId, list[Change]] = {}
        for map_id, y, heading in ((OLD, 2.0, 0.3), (OTHER, 1.8, 0.35), (NEW, 2.15, 0.25)):
            tour = [Pose2(1.5 + 0.6 * k, y, heading) for k in range(7)]
            nodes, edges = take_map(world, map_id, tour, rng, sigma_xy=0.01, sigma_heading=0.01)
            self.changes[map_id] = numbered(map_id, changes_of(nodes, edges), stamp_ns=BEGIN)


@pytest.fixture(scope="module")
def logs() -> Logs:
    return Logs()


@dataclass
class Server:
    """A merger with its store and its record of what was pruned."""

    store: Store
    named: list[object] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.merger = Merger()
        self.record = PruningRecord(self.store, DAYS, lambda: self.named, ())
        self.record.restore(self.merger)
        for map_id in self.store.maps():
            self.merger.read((map_id, change.body) for change in self.store.replay(map_id))

    def take(self, changes: list[Change]) -> None:
        map_id = changes[0].map
        entries = [ReceivedChange.read(map_id, one.sequence, encode_change(one)) for one in changes]
        for change in self.store.apply(map_id, 5, entries).changes:
            self.merger.on_change(change)

    def merged(self) -> MergedMap:
        return self.merger.merged()

    def prune(self, days: float) -> bool:
        self.merged()
        return self.record.prune(self.merger, BEGIN + round(days * DAY_NS))


@contextmanager
def serving(path: Path) -> Iterator[Server]:
    store = open_store(path)
    try:
        yield Server(store)
    finally:
        store.close()


def poses_apart(a: MergedMap, b: MergedMap) -> float:
    return max(a.pose(node).distance(b.pose(node)) for node in b.poses)


@pytest.mark.slow
def test_what_is_superseded_for_long_leaves_and_the_rest_stays(logs: Logs, tmp_path):
    path = tmp_path / "s0.sqlite"
    with serving(path) as server:
        for map_id in MAPS:
            server.take(logs.changes[map_id])
        before = server.merged()
        anchor, old = before.graphs[0].nodes[0], sorted(before.superseded)
        assert len(before.components) == 1 and len(old) >= 6 and anchor in old
        kept = old[-1]
        server.named.append(ManualConstraint(RetiredNodes((kept,)), False, "anna", 1))
        assert not server.prune(0.0) and not server.prune(DAYS - 1.1), "not yet"
    with serving(path) as server:
        server.named.append(ManualConstraint(RetiredNodes((kept,)), False, "anna", 1))
        assert not server.prune(DAYS - 0.5), "a restart begins no new time, and it is looked once a day"
        assert server.prune(DAYS + 0.01)
        gone = set(old) - {anchor, kept}
        merged = server.merged()
        assert set(before.poses) - set(merged.poses) == gone and set(merged.pruned.nodes) == gone
        assert all(server.store.landmarks(node) is None for node in gone)
        assert not any(node in server.merger.places for node in gone)
        assert len(merged.components) == 1 and poses_apart(before, merged) < 0.01
        own = {link.pair for link in before.links if gone.isdisjoint(link.pair)}
        assert own <= {link.pair for link in merged.links}
        assert any(is_marginal(link) for link in merged.links) and not merged.contradicted
    with serving(path) as server:
        again = server.merged()
        assert set(again.poses) == set(merged.poses) and again.pruned == merged.pruned
        assert poses_apart(merged, again) < 1e-3
    # Who opens the store, or a file of the map, has the same map.
    for other in (open_map(path).merged(), merged_of(unpack_map_file(pack_map_file(map_file_of(again))))):
        assert set(other.poses) == set(again.poses) and poses_apart(again, other) < 2e-3


@pytest.fixture(scope="module")
def pruned(
    logs: Logs, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[MergedMap, MergedMap, Server]]:
    """Before, after, and the server."""
    with serving(tmp_path_factory.mktemp("store") / "s0.sqlite") as server:
        for map_id in MAPS:
            server.take(logs.changes[map_id])
        before = server.merged()
        server.prune(0.0)
        assert server.prune(DAYS + 1.0)
        yield before, server.merged(), server


def test_words_name_what_replaces_it(pruned: tuple[MergedMap, MergedMap, Server]):
    before, after, _ = pruned
    node = min(after.pruned.nodes)
    by = before.superseded[node].by
    with pytest.raises(InvalidValue, match=f"{node} left the map on 2023-11-29 .* UTC: {by} replaces it"):
        after.check(node)
    found = PlaceResolver(Router(after), Annotations()).resolve(str(node))
    assert found.node == by and str(node) in found.note


def test_routes_from_and_to_it_hold(pruned: tuple[MergedMap, MergedMap, Server]):
    before, after, _ = pruned
    nodes = sorted(after.pruned.nodes)
    for start, goal in ((nodes[0], nodes[-1]), (nodes[-1], nodes[0])):
        legs = Router(after).route(start, goal).legs
        assert legs, "there is a way"
        assert all(leg.node.id in after.poses for leg in legs)
        # Along the legs the robot gets to where the goal was, or next to it.
        at = before.pose(start)
        for leg in legs:
            at = at @ leg.previous_from_node.mean
        assert at.distance(after.pose(legs[-1].node.id)) < 0.02
        assert at.distance(before.pose(goal)) < 2.5
        near = Router(after).route(start, goal, start_from_robot=Pose2(0.1, 0.0, 0.0)).legs
        assert near[-1].node.id == legs[-1].node.id


def test_a_node_that_is_sent_again_is_there_again(logs: Logs, pruned: tuple[MergedMap, MergedMap, Server]):
    _, after, server = pruned
    node = min(after.pruned.nodes)
    body = next(
        one.body
        for one in logs.changes[node.map]
        if isinstance(one.body, NodePut) and one.body.node.id == node
    )
    assert isinstance(body, NodePut)
    last = logs.changes[node.map][-1].sequence
    server.take([Change(node.map, last + 1, BEGIN, replace(body, node=replace(body.node, stamp_ns=7)))])
    merged = server.merged()
    assert node in merged.poses and len(merged.components) <= 2
    merged.check(node)


def test_a_line_of_successors_is_followed():
    a, b, c, d = (NodeId("r0", k, 1) for k in range(1, 5))
    step = Pose2(1.0, 0.0, math.pi / 2)
    nodes = PrunedNodes(
        {a: PrunedNode(b, step, BEGIN), b: PrunedNode(c, step, BEGIN), d: PrunedNode(d, step, 0)}
    )
    found = nodes.successor(a, {c})
    assert found is not None and found[0] == c
    assert found[1].vector == pytest.approx([1.0, 1.0, -math.pi])
    assert nodes.successor(b, {b}) == (b, Pose2()) and nodes.successor(a, set()) is None
    assert nodes.successor(d, set()) is None, "it was sent again, and pruned again"


def test_nothing_is_remembered_of_a_node_that_has_left(logs: Logs, tmp_path):
    with serving(tmp_path / "s0.sqlite") as server:
        for map_id in MAPS:
            server.take(logs.changes[map_id])
        server.prune(0.0)
        assert server.prune(DAYS + 1.0)
        merged = server.merged()
        gone = set(merged.pruned.nodes)
        # What the last merge has changed, the next one forgets.
        stays = server.merger.node(min(node for node in merged.poses if node.map == NEW))
        assert stays is not None
        server.take([Change(NEW, len(logs.changes[NEW]) + 1, BEGIN, NodePut(replace(stays, stamp_ns=7)))])
        server.merged()
        # All but the lines that say what replaces them.
        server.merger.pruning.pruned, server.merger.pruning._part = PrunedNodes(), {}
        server.merger._merged = MergedMap.empty()
        left = [some for some in reachable(server.merger) if isinstance(some, NodeId) and some in gone]
        assert gone and not left


def reachable(root: object) -> Iterator[object]:
    """All values that something of this project holds, itself among them."""
    seen, stack = set[int](), [root]
    while stack:
        value = stack.pop()
        own = type(value).__module__.startswith(("mapweave.", "networkx."))
        if id(value) not in seen and (own or isinstance(value, dict | list | tuple | set | frozenset)):
            seen.add(id(value))
            yield value
            stack.extend(gc.get_referents(value))


@pytest.mark.parametrize("years", [-50.0, 50.0], ids=["behind", "ahead"])
def test_a_clock_that_is_set_makes_nothing_older(logs: Logs, tmp_path, years: float):
    """A machine without a clock of its own begins in another year, until it has heard what time it is."""
    day, off = 0.0, years * 365.0
    with serving(tmp_path / "s0.sqlite") as server:
        server.record = PruningRecord(server.store, DAYS, tuple, (), lambda: day * 86_400.0)
        for map_id in MAPS:
            server.take(logs.changes[map_id])
        nodes = len(server.merged().poses)
        assert server.merged().superseded
        for day in (0.0, 0.1):
            assert not server.prune(day + off)
        set_right = day
        for day in (0.2, 1.3, 5.0, DAYS - 1.0):
            assert not server.prune(day), day
        assert len(server.merged().poses) == nodes
        day = set_right + DAYS + 1.5
        assert server.prune(day), "kept for as long as ever, and then it leaves"


@pytest.mark.parametrize("years", [-50.0, 0.1], ids=["behind", "ahead"])
def test_no_clock_of_a_server_that_takes_over_is_enough_for_nodes_to_leave(
    logs: Logs, tmp_path, years: float
):
    path, off = tmp_path / "s0.sqlite", years * 365.0
    with serving(path) as server:
        for map_id in MAPS:
            server.take(logs.changes[map_id])
        nodes = len(server.merged().poses)
        assert server.merged().superseded and not server.prune(1.0)
    with serving(path) as server:
        assert not server.prune(2.0 + off)
    with serving(path) as server:
        for day in (3.0, 3.0 + 0.4 * DAYS):
            assert not server.prune(day), day
        assert len(server.merged().poses) == nodes
        assert server.prune(4.0 + DAYS), "it leaves all the same"


def test_what_is_left_of_many_nodes_takes_few_records(monkeypatch):
    monkeypatch.setattr("mapweave.mapserver.merging.pruning.PART_NODES", 4)
    results: dict[str, bytes] = {}
    pruning = Pruning()
    left = {
        NodeId("r0", 1, k): PrunedNode(NodeId("r0", 2, k), Pose2(0.5, 0.0, 0.1), BEGIN) for k in range(11)
    }
    for day in range(11):
        node = NodeId("r0", 1, day)
        plan = PrunePlan({node: left[node]}, (), (), frozenset())
        results |= pruning.records(plan)
        pruning.take(plan)
        if day % 3 == 2:
            pruning = Pruning()
            pruning.restore(results.get)
    again = Pruning()
    again.restore(results.get)
    assert again.pruned == pruning.pruned == PrunedNodes(left)
    assert len(results) == 1 + 3, "a state, and three records of four nodes at most"
