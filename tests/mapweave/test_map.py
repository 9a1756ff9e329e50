"""A map in Python: of a file and of a running fleet the same, held against other ways to the same numbers."""

import math
import shutil
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import networkx as nx
import numpy as np
import pytest

import mapweave
from mapweave.agent.fleet_client import FleetClient
from mapweave.agent.mission_control import MissionControl
from mapweave.cli import main
from mapweave.hybridmap.agent_status import Status
from mapweave.hybridmap.errors import InvalidValue, NotConnected
from mapweave.hybridmap.explanation import PairExplanation
from mapweave.mapserver.server import MapServer
from mapweave.storage.map_file import unpack_map_file
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from synthetic.maps import changes_of, write_store
from synthetic.world import room, take_map, take_view
from tests.waiting import eventually

KEYS = Keys("fleet")
WORLD = room(0, 0, 5, 4, 600, np.random.default_rng(1))
TOUR = [mapweave.Pose2(2.2 + 0.1 * k, 1.8, 0.9 * k) for k in range(4)]
MAPS = [mapweave.MapId("r0", 1), mapweave.MapId("r1", 1)]


@dataclass
class Running:
    """A fleet whose two robots have mapped one room.

    Attributes:
        fleet: as a person sees it.
        bus: of another participant.
        places: where each node really is, in the room.
        nodes: as the robots made them.
    """

    fleet: mapweave.Fleet
    bus: MemoryBus
    places: dict[str, mapweave.Pose2]
    nodes: dict[str, mapweave.Node]


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Running]:
    rng = np.random.default_rng(2)
    places: dict[str, mapweave.Pose2] = {}
    made: dict[str, mapweave.Node] = {}
    logs = {}
    for map_id in MAPS:
        nodes, edges = take_map(WORLD, map_id, TOUR, rng)
        logs[map_id] = changes_of(nodes, edges)
        made |= {str(node.id): node for node in nodes}
        places |= {str(node.id): place for node, place in zip(nodes, TOUR, strict=True)}
    write_store(tmp_path / "s.sqlite", logs)
    hub = MemoryHub()
    served, person, other = MemoryBus(hub), MemoryBus(hub), MemoryBus(hub)
    with MapServer(served, KEYS, tmp_path / "s.sqlite", "s0") as server:
        eventually(lambda: server.status()["nodes"] == 8 and server.status()["settled"])
        with mapweave.Fleet(fleet="fleet", by="anna", bus=person) as fleet:
            yield Running(fleet, other, places, made)
    for bus in (served, person, other):
        bus.close()


def test_a_map_is_fetched_into_a_file_and_read_once(running: Running, tmp_path, monkeypatch, capsys):
    """It was read twice, a second each for 250 nodes; that takes as long as fetching them."""
    read: list[int] = []
    monkeypatch.setattr(
        "mapweave.fleet_map.unpack_map_file", lambda data: read.append(len(data)) or unpack_map_file(data)
    )
    monkeypatch.setattr(
        "mapweave.storage.map_file.unpack_map_file", lambda data: pytest.fail("it is read again")
    )
    monkeypatch.setattr("mapweave.commands.map_fetch.fleet_of", lambda _: nullcontext(running.fleet))
    out = tmp_path / "office.mapweave"
    assert main(["map", "fetch", str(out)]) == 0
    assert read == [out.stat().st_size]
    assert capsys.readouterr().out == f"{out}: {running.fleet.map().title}, {read[0] / 1e6:.1f} MB\n"


def test_a_file_and_a_fleet_say_the_same(running: Running, tmp_path):
    fleet = running.fleet
    fleet.annotate("place", "kitchen", node="r1.1.3")
    fleet.save(tmp_path / "both.mapweave")
    file = mapweave.open(tmp_path / "both.mapweave")
    shutil.copy(tmp_path / "s.sqlite", tmp_path / "copy.sqlite")
    assert set(mapweave.open(tmp_path / "copy.sqlite").nodes.ids) == set(file.nodes.ids), "merged on opening"
    assert file.hash == fleet.hash and len(file.hash) == 64
    assert repr(file) == f"<FileMap: {file.content.title}>" and repr(fleet) == "<Fleet fleet>"
    for table in (file.nodes, fleet.nodes):
        assert len(table) == 8 and list(table.ids) == sorted(running.places)
        assert (table.component == 0).all()
        gone = {str(node) for node in fleet.content.superseded}
        assert set(table.ids[table.superseded]) == gone and 0 < len(gone) < 8
        for k, name in enumerate(table.ids):
            node, pose = running.nodes[name], file.pose(name)
            assert table.stamp_ns[k] == node.stamp_ns and table.landmarks[k] == len(node.landmarks)
            assert [table.x[k], table.y[k], table.heading[k]] == pose.mean.vector.tolist()
            assert table.sigma[k] == pytest.approx(np.sqrt(np.diag(pose.covariance)))
        # As the robots really drove, but for where the frame lies: by distances and turns.
        for (i, a), (j, b) in pairwise(enumerate(table.ids)):
            really, turn = running.places[a], running.places[b].heading - running.places[a].heading
            apart = math.hypot(table.x[j] - table.x[i], table.y[j] - table.y[i])
            assert apart == pytest.approx(really.distance(running.places[b]), abs=0.1)
            assert math.cos(table.heading[j] - table.heading[i] - turn) > 0.99
        assert {name: len(column) for name, column in table.columns().items()}.keys() >= {
            "id",
            "sigma_heading",
        }

    graph = fleet.graph()
    assert nx.utils.graphs_equal(graph, file.graph())
    assert set(graph) == set(running.places) and nx.is_connected(graph)
    links = [data for *_, data in graph.edges(data=True) if data["kind"] == "merged"]
    assert links and all(0.5 < data["probability"] <= 1.0 for data in links)

    way, same = fleet.route("r0.1.1", "r1.1.5"), file.route("r0.1.1", "r1.1.5")
    assert way.found and str(way.hops[0].a) == "r0.1.1" and str(way.hops[-1].b) == "r1.1.5"
    assert [(hop.a, hop.b, hop.kind) for hop in way.hops] == [(hop.a, hop.b, hop.kind) for hop in same.hops]
    for asked in (fleet, file):
        assert str(asked.node("kitchen").id) == "r1.1.3"
        assert asked.route("r0.1.1", "kitchen").hops == asked.route("r0.1.1", "r1.1.3").hops != ()
        assert asked.annotations().last("place", "kitchen") is not None
    for asked in (fleet, file):
        stops = ("r0.1.1", "r1.1.5", "kitchen", "r0.1.5")
        legs = [asked.route(*ends) for ends in pairwise(stops)]
        over = asked.route(stops[0], stops[-1], via=stops[1:-1])
        assert over.found and (str(over.start), str(over.goal)) == ("r0.1.1", "r0.1.5")
        assert over.hops == tuple(hop for leg in legs for hop in leg.hops)
        assert all(leg.reason in over.reason for leg in legs)
    walls = [("r1.1.5", node) for node in graph if node != "r1.1.5"]
    none = file.route("r0.1.1", "r0.1.5", blocked=walls, via=["r0.1.3", "r1.1.5"])
    assert not none.found and not none.hops and "r0.1.3 to r1.1.5: " in none.reason
    assert not file.route("r0.1.1", "r0.1.3", blocked=[(a, b) for a in graph for b in graph if a < b]).found
    for asked in (fleet, file):
        # The letters of one name were looked for one by one.
        for one in (
            {"via": "kitchen"},
            {"via": mapweave.NodeId("r1", 1, 3)},
            {"blocked": ("r0.1.1", "r0.1.3")},
        ):
            with pytest.raises(mapweave.MapweaveError, match=r"is a list, such as .*, and not one place"):
                asked.route("r0.1.1", "r1.1.5", **one)
        with pytest.raises(mapweave.MapweaveError, match="`blocked` is a list of pairs of nodes"):
            asked.route("r0.1.1", "r1.1.5", blocked=[("r0.1.1",)])
    with pytest.raises(mapweave.MapweaveError, match="`via` is a list"):
        fleet.go("r0", "kitchen", via="kitchen")
    for asked in (fleet, file):
        pair = asked.explain("r0.1.1", mapweave.NodeId("r1", 1, 1))
        assert isinstance(pair, PairExplanation) and pair.standing == "linked" and pair.evidence
        (maps,) = asked.explain_maps()
        assert maps.joined and asked.explain_maps("r0.1", "r1.1") == (maps,)
        for wrong in (["r0.1.1", "r9.1.1"], ["r0.1.1", "nothing"]):
            for question in (asked.explain, asked.route):
                with pytest.raises(mapweave.Refused, match=r"r9\.1|nothing"):
                    question(*wrong)
            for look in (asked.node, asked.pose):
                with pytest.raises(mapweave.Refused, match=r"r9\.1|nothing"):
                    look(wrong[1])
        with pytest.raises(mapweave.Refused, match=r"r9\.1"):
            asked.explain_maps("r0.1", "r9.1")
        with pytest.raises(InvalidValue, match="is a node"):
            asked.explain_maps("r0.1.1", "r1.1.1")
        with pytest.raises(InvalidValue, match=r"r0\.1 is a map: `explain_maps` is for two"):
            asked.explain("r0.1", "r1.1")

    view, _ = take_view(WORLD, TOUR[2] @ mapweave.Pose2(0.1, 0.05, 0.05), np.random.default_rng(5))
    here, there = (asked.locate(view) for asked in (fleet, file))
    assert here.certainty is there.certainty is mapweave.Certainty.FOUND
    assert [place.node for place in here.candidates] == [place.node for place in there.candidates]


def test_a_fleet_tells_what_happens_and_its_map_is_fetched_again_on_request(running: Running):
    fleet, bus = running.fleet, running.bus
    before = fleet.hash
    events = fleet.events(60.0)
    client = FleetClient(bus, KEYS, MAPS[0], MissionControl("r0"))
    client.report(Status("standing", "", 4, 0, mapweave.Pose2(), False), 1)
    status = next(event for event in events if isinstance(event, mapweave.AgentStatus))
    assert status.robot == "r0" and status.status.doing == "standing"
    # A person parts the two maps.
    assert "twins" in fleet.unlink("r0.1", "r1.1", "twins")
    happened = []
    for event in events:
        happened.append(event)
        if isinstance(event, mapweave.MapChanged) and "2 components" in event.summary:
            break
    kinds = {event.kind for event in happened if isinstance(event, mapweave.MapEvent)}
    assert mapweave.MapEventKind.CONSTRAINED in kinds and mapweave.MapEventKind.PARTED in kinds
    assert kinds == {event.kind for event in fleet.history()} - {mapweave.MapEventKind.JOINED}
    assert fleet.hash == before, "what was fetched does not change by itself"
    fleet.refresh()
    assert fleet.hash != before and set(fleet.nodes.component) == {0, 1}
    assert not fleet.route("r0.1.1", "r1.1.5").found
    client.close()
    assert list(fleet.events(0.0)) == []


def test_a_robots_own_map_is_optimised_exported_and_drawn(running: Running, tmp_path, monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "agg")
    own = [node for name, node in running.nodes.items() if name.startswith("r0")]
    edges = [edge for edge in map_of(running.fleet).edges.values() if edge.id.agent == "r0"]
    content = mapweave.MapFile("agent", "r0.1", tuple(changes_of(own, edges)))
    mine = mapweave.FileMap(content)
    assert len(mine.nodes) == 4 and mine.hash != running.fleet.hash
    (written,) = mine.export(tmp_path / "mine.graphml")
    read, graph = nx.read_graphml(written, force_multigraph=True), mine.graph()
    assert dict(read.nodes(data=True)) == dict(graph.nodes(data=True))
    assert {key: data for *_, key, data in read.edges(keys=True, data=True)} == {
        key: data for *_, key, data in graph.edges(keys=True, data=True)
    }
    with pytest.raises(InvalidValue, match="g2o, tum, graphml, geojson"):
        mine.export(tmp_path / "mine.dxf")

    axes = mine.plot()
    drawn = np.concatenate([line.get_xydata() for line in axes.lines if "nodes" in str(line.get_label())])
    assert drawn == pytest.approx(np.column_stack([mine.nodes.x, mine.nodes.y]))
    with pytest.raises(InvalidValue, match="no component 7"):
        mine.plot(axes, component=7)


def map_of(fleet: mapweave.Fleet) -> mapweave.HybridMap:
    return mapweave.HybridMap(fleet.content.changes)


def test_what_is_no_image_of_the_camera_is_refused(running: Running, tmp_path):
    camera = mapweave.Camera(64, 48, 60.0, 60.0, 32.0, 24.0, 0.3)
    noise = np.random.default_rng(0).integers(0, 255, (48, 64), dtype=np.uint8)
    assert running.fleet.relocalize(noise, camera).certainty is mapweave.Certainty.UNKNOWN
    for image in (noise[:-1], noise.astype(float), np.stack([noise] * 3, axis=-1)):
        with pytest.raises(InvalidValue, match=r"give \(48, 64\) of uint8, grey"):
            running.fleet.relocalize(image, camera)
    with pytest.raises(mapweave.MapweaveError, match="no such file"):
        running.fleet.relocalize(tmp_path / "none.png", camera)


def test_without_a_server_one_line_says_so(opened):
    bus = opened(MemoryBus(MemoryHub()))
    fleet = mapweave.Fleet(fleet="fleet", bus=bus)
    for ask in (lambda: fleet.nodes, lambda: fleet.route("r0.1.1", "r0.1.3"), fleet.history, fleet.refresh):
        with pytest.raises(NotConnected, match="no map server of fleet fleet answers"):
            ask()
    assert list(fleet.events(0.01)) == []


def test_map_bytes_are_a_map_file(running: Running):
    assert len(unpack_map_file(running.fleet.map_bytes()).poses) == 8
