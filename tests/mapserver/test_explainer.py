"""A server that explains merges, applies manual constraints, and does so after it was started again."""

import logging
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mapweave.hybridmap.change import ChangeBody, EdgePut, NodePut
from mapweave.hybridmap.constraint_subject import Apart, Ends
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.explanation import (
    FleetExplanation,
    MapsExplanation,
    PairExplanation,
    RouteExplanation,
    Standing,
)
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.limits import MAX_STAMP_NS
from mapweave.hybridmap.manual_constraint import ConstraintRequest, ManualConstraint, ManualConstraints
from mapweave.hybridmap.query import ExplainRequest, RouteRequest
from mapweave.mapserver.admission_control import AdmissionControl, AdmissionSettings
from mapweave.mapserver.base_map import BaseMap
from mapweave.mapserver.explainer import ConstraintRecord, Explainer
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.mapserver.map_files import map_file_of, merged_of
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.own_maps import maps_of
from mapweave.mapserver.routes import Router
from mapweave.mapserver.schedule import LockstepSchedule
from mapweave.mapserver.server import MapServer, ServerSettings
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.settings import ConsistencySettings, MergeSettings
from mapweave.storage.map_file import MapFile, pack_map_file, unpack_map_file
from mapweave.wire.bus import Reply
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import decode_record
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.messages import decode, encode
from synthetic.maps import looked_around, write_store

A, B = MapId("a", 1), MapId("b", 1)
KEYS = Keys("fleet")


def logs() -> dict[MapId, list[ChangeBody]]:
    """Two robots have looked around in one room."""
    return looked_around((A, B), seed=6, stops=6)


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The bytes of a server's store."""
    return write_store(tmp_path_factory.mktemp("store") / "s0.sqlite", logs()).read_bytes()


@pytest.fixture
def path(stored: bytes, tmp_path: Path) -> Path:
    path = tmp_path / "s0.sqlite"
    path.write_bytes(stored)
    return path


class Asker:
    """A person at the bus."""

    def __init__(self, bus: MemoryBus) -> None:
        self.bus = bus

    def ask(self, key: str, payload: bytes) -> Reply:
        (reply,) = self.bus.ask(key, payload, 20.0)
        return reply

    def explained(self, request: ExplainRequest, kind: type[Any]) -> Any:
        return decode(self.ask(KEYS.explain("s0"), encode(request)).payload, kind)

    def maps(self) -> MapsExplanation:
        (explanation,) = self.explained(ExplainRequest((A, B)), FleetExplanation).maps
        return explanation

    def constrain(self, ends: Ends, apart: bool = True) -> Reply:
        constraint = ManualConstraint(Apart(ends), apart, "anna", 10**18, "two kitchens")
        return self.ask(KEYS.constrain("s0"), encode(ConstraintRequest(constraint)))

    def status(self) -> dict[str, object]:
        return dict(decode_record(self.ask(KEYS.server_status("s0"), b"").payload))

    def merged(self) -> MapFile:
        return unpack_map_file(self.ask(KEYS.server_map("s0"), b"").payload)


@contextmanager
def serving(path: Path, settings: ServerSettings | None = None) -> Iterator[Asker]:
    hub, settings = MemoryHub(), settings or ServerSettings()
    with (
        closing(MemoryBus(hub)) as bus,
        closing(MemoryBus(hub)) as asker,
        MapServer(bus, KEYS, path, "s0", settings, LockstepSchedule()),
    ):
        yield Asker(asker)


def links(content: MapFile) -> set[tuple[NodeId, NodeId]]:
    return {link.pair for link in merged_of(content).links}


def same(first: MergedMap, second: MergedMap) -> None:
    assert [link.pair for link in first.links] == [link.pair for link in second.links]
    assert [(r.pair, r.reason, r.edge) for r in first.refused] == [
        (r.pair, r.reason, r.edge) for r in second.refused
    ]
    assert first.components == second.components and first.constraints.made == second.constraints.made
    for node, place in first.poses.items():
        other = second.poses[node]
        assert place.component == other.component
        one, two = place.merged_from_robot, other.merged_from_robot
        assert np.allclose(one.mean.vector, two.mean.vector, atol=1e-5)
        assert np.allclose(one.covariance, two.covariance, rtol=1e-3, atol=1e-8)


def test_a_link_explains_itself_over_the_bus(path: Path):
    with serving(path) as asker:
        content = asker.merged()
        pair = min(pair for pair in links(content) if pair[0].map != pair[1].map)
        result = asker.explained(ExplainRequest(pair), PairExplanation)
        assert result.standing is Standing.LINKED and (result.a.id, result.b.id) == pair
        assert len(result.shared) == result.evidence["inliers"] and result.other_links
        assert asker.maps().joined
        assert asker.explained(ExplainRequest(), FleetExplanation).maps == (asker.maps(),)
        unknown = ExplainRequest((NodeId("z", 1, 1), pair[0]))
        reply = asker.ask(KEYS.explain("s0"), encode(unknown))
        assert "there is no map z.1; known are: a.1, b.1" in reply.error


def test_blocked_edges_are_used_in_route_explanations(path: Path):
    node_id, two = NodeId("a", 1, 1), NodeId("a", 1, 3)
    with serving(path) as asker:

        def way() -> RouteExplanation:
            return asker.explained(ExplainRequest((node_id, two), route=True), RouteExplanation)

        free = way()
        assert free.found and not free.gaps and [hop.b for hop in free.hops] == [two]
        blocked = encode(RouteRequest(node_id, two, ((node_id, two),)))
        assert not asker.ask(KEYS.route("s0"), blocked).error
        result = way()
        said = [hop.words for hop in (*result.hops, *result.gaps)]
        assert result.found and any("recently could not get through" in words for words in said)
        assert [hop.b for hop in result.gaps] == [two]
        assert sum(hop.cost for hop in result.hops) > free.hops[0].cost


def test_undone_links_stay_undone_after_a_restart(path: Path, caplog):
    caplog.set_level(logging.WARNING)
    with serving(path) as asker:
        assert str(asker.status()["event"]).startswith("a.1 and b.1 are one map now, by ")
        assert asker.maps().joined
        reply = asker.constrain((A, B))
        assert "two kitchens" in str(decode_record(reply.payload)["said"])
        assert not asker.maps().joined and "undone with all links" in asker.maps().reason
        event = str(asker.status()["event"])
        assert event.startswith("a.1 and b.1 are no longer one map: ") and "anna" in event
        assert event in caplog.messages
        assert asker.status()["constraints"] == 1
    with serving(path) as asker:
        result = asker.maps()
        assert not result.joined and [r.because for r in result.constraints] == ["two kitchens"]
        assert "apart already" in asker.constrain((A, B)).error
        assert not asker.constrain((A, B), apart=False).error
        assert asker.maps().joined and len(asker.maps().constraints) == 2
        assert "no manual constraint keeps" in asker.constrain((A, B), apart=False).error
    with serving(path) as asker:
        assert asker.maps().joined


def test_one_link_of_many_can_be_undone(path: Path):
    with serving(path) as asker:
        before = links(asker.merged())
        pair = min(before)
        assert not asker.constrain(pair).error
        assert links(asker.merged()) == before - {pair}
        neighbours = (NodeId("a", 1, 1), NodeId("a", 1, 3))
        if neighbours not in before:
            assert "joined by their robot's way" in asker.constrain(neighbours).error


def test_merged_without_a_server_is_the_same(path: Path):
    with serving(path) as asker:
        asker.constrain(min(links(asker.merged())))
        served = asker.merged()
    offline = Merger()
    for map_id, changes in logs().items():
        # As robots' files hold them.
        content = unpack_map_file(pack_map_file(MapFile("agent", str(map_id), tuple(changes))))
        for change in content.changes:
            offline.apply(map_id, change)
    offline.constrain(merged_of(served).constraints)
    same(offline.merged(), merged_of(served))


def test_a_file_holds_the_whole_merged_map(path: Path):
    with serving(path) as asker:
        asker.constrain((A, B))
        content = asker.merged()
    merged = merged_of(content)
    again = unpack_map_file(pack_map_file(map_file_of(merged)))
    same(merged, merged_of(again))
    assert {r.pair: r.link is None for r in merged.refused} == {
        r.pair: r.link is None for r in merged_of(again).refused
    }
    whole = {map_id: (set(one.nodes), set(one.edges)) for map_id, one in maps_of(content).items()}
    for map_id, changes in logs().items():
        assert whole[map_id] == (
            {change.node.id for change in changes if isinstance(change, NodePut)},
            {change.edge.id for change in changes if isinstance(change, EdgePut)},
        )
    for link in merged.links:
        (edge,) = [b.edge for b in content.changes if isinstance(b, EdgePut) and b.edge.id == link.edge().id]
        assert 0.0 < edge.evidence["probability"] < 1.0


def test_faded_landmarks_are_in_the_file(path: Path):
    with serving(path) as asker:
        merged = merged_of(asker.merged())
    node = min(merged.poses)
    gone = np.arange(len(merged.maps[node.map].nodes[node].landmarks)) % 3 == 0
    content = unpack_map_file(pack_map_file(map_file_of(replace(merged, faded={node: gone}))))
    (again,) = merged_of(content).faded.items()
    assert again[0] == node and np.array_equal(again[1], gone)
    data = pack_map_file(replace(content, faded={node: gone}))
    assert np.array_equal(unpack_map_file(data).faded[node], gone)
    with pytest.raises(InvalidValue, match="do not fit"):
        pack_map_file(replace(content, faded={node: np.ones(len(gone) + 8, np.bool_)}))
    with pytest.raises(InvalidValue, match="which is not there"):
        pack_map_file(replace(content, faded={NodeId("z", 1, 1): gone}))


def test_an_incomplete_merge_is_reported(stored: bytes, path: Path):
    bus, merged = MemoryBus(MemoryHub()), MergedMap.empty()
    with serving(path) as asker:
        merged = merged_of(asker.merged())
    store, admission, settled = SqliteStore(path), AdmissionControl(AdmissionSettings(workers=1)), False
    answers = SimpleNamespace(merged=merged, router=Router(merged))
    explainer = Explainer(
        bus, KEYS, "s0", lambda: answers, admission, ConstraintRecord(store),
            lambda constraints: None, lambda: settled,
        MergeSettings(), tuple, tuple,
    )  # fmt: skip
    pair = merged.links[0].pair
    for request in (*map(ExplainRequest, ((A, B), pair, None)), ExplainRequest(pair, route=True)):
        settled = False
        explanation = explainer.explain(request)
        early = explanation.maps[0] if isinstance(explanation, FleetExplanation) else explanation
        settled = True
        explanation = explainer.explain(request)
        late = explanation.maps[0] if isinstance(explanation, FleetExplanation) else explanation
        assert early.reason == f"{late.reason} (still merging: ask again)"
    explainer.close()
    admission.close()
    store.close()
    bus.close()


def test_other_links_use_the_gate_of_the_merge(path: Path):
    with serving(path) as asker:
        pair = min(links(asker.merged()))
    strict = ServerSettings(merge=MergeSettings(ConsistencySettings(gate=1e-9)))
    with serving(path, strict) as asker:
        result = asker.explained(ExplainRequest(pair), PairExplanation)
        assert not any(link.agrees for link in result.other_links)


def test_an_unreadable_constraint_costs_only_itself(path: Path, caplog):
    store = SqliteStore(path)
    store.add_constraint(b"rubbish")
    ConstraintRecord(store).add(ManualConstraint(Apart((MapId("r0", 1), MapId("r1", 1))), True, "anna", 5))
    assert [constraint.who for constraint in ConstraintRecord(store).constraints.made] == ["anna"]
    assert "a manual constraint cannot be read" in caplog.text
    store.close()


def test_beside_a_base_map_a_constraint_of_far_ahead_can_be_taken_back(path: Path):
    """Records are joined by date; each stays in its own order."""
    pairs = [Apart((MapId("r0", 1), MapId(f"r{number}", 1))) for number in (1, 2, 3)]
    base = BaseMap(constraints=ManualConstraints([ManualConstraint(pairs[0], True, "ben", 3)]))
    store = SqliteStore(path)
    record = ConstraintRecord(store, base)
    for pair, holds, stamp_ns in ((pairs[1], True, 2), (pairs[2], True, MAX_STAMP_NS), (pairs[2], False, 5)):
        record.add(ManualConstraint(pair, holds, "anna", stamp_ns))
    record = ConstraintRecord(store, base)
    wanted = [("anna", 2, True), ("ben", 3, True), ("anna", MAX_STAMP_NS, True), ("anna", 5, False)]
    assert [(one.who, one.stamp_ns, one.holds) for one in record.constraints.made] == wanted
    store.close()
