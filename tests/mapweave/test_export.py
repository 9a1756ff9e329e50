"""What others' tools read back is the map."""

import json
import math
from collections import Counter
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import gtsam
import networkx as nx
import numpy as np
import pytest
from evo.tools import file_interface
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mapweave import EdgeKind, MapId, NodeId, Pose2, write_map_file
from mapweave.cli import main
from mapweave.exit_status import NO
from mapweave.formats.export import FORMATS
from mapweave.formats.g2o import G2oEdge, G2oGraph, read_g2o, write_g2o
from mapweave.formats.g2o_optimum import optimum_of
from mapweave.formats.map_part import MapPart
from mapweave.hybridmap.errors import InvalidFile, InvalidValue
from mapweave.mapserver.map_files import map_file_of
from mapweave.merge.pose_graph.merged_map import MergedMap
from synthetic.maps import map_tours, merger_of
from synthetic.world import room


@pytest.fixture(scope="module")
def merged() -> MergedMap:
    """Two robots that share a room, and a third elsewhere."""
    rng = np.random.default_rng(9)
    world = room(0, 0, 5, 4, 700, rng) + room(20, 0, 5, 4, 500, rng)
    tours = {
        MapId(agent, 1): [Pose2(x + 2.4 + 0.1 * k, 2.0, 0.7 * k) for k in range(6)]
        for agent, x in (("r0", 0), ("r1", 0), ("r2", 20))
    }
    return merger_of(map_tours(world, tours, rng)).merged()


@pytest.fixture(scope="module")
def part(merged: MergedMap) -> MapPart:
    assert len(merged.components) == 2
    return MapPart(merged)


def test_gtsam_reads_the_pose_graph_and_is_at_its_optimum(part: MapPart, tmp_path):
    (path,) = FORMATS["g2o"](part, tmp_path / "map.g2o")
    graph, values = gtsam.readG2o(str(path), False)
    assert values.size() == len(part.nodes)
    measurements = part.measurements
    for node, number in part.numbers.items():
        pose, own = values.atPose2(number), part.pose(node)
        assert np.allclose([pose.x(), pose.y()], [own.x, own.y], atol=1e-9)
        assert abs(math.remainder(pose.theta() - own.heading, math.tau)) < 1e-9
    expected = 0.0
    for m in measurements:
        off = (m.a_from_b.mean.inverse() @ part.pose(m.a).inverse() @ part.pose(m.b)).vector
        expected += float(off @ np.linalg.solve(m.covariance, off))
    between = gtsam.NonlinearFactorGraph()
    for k in range(graph.size()):
        if isinstance(graph.at(k), gtsam.BetweenFactorPose2):
            between.add(graph.at(k))
    # GTSAM measures errors along the exponential map, we in the plane: the same to first order.
    assert 2.0 * between.error(values) == pytest.approx(expected, rel=5e-3)
    names = dict(line.split()[1:] for line in path.read_text().splitlines() if line.startswith("#"))
    assert names == {str(number): str(node) for node, number in part.numbers.items()}


def test_evo_reads_the_trajectories(part: MapPart, tmp_path):
    written = FORMATS["tum"](part, tmp_path / "places")
    assert [path.name for path in written] == ["r0.1.tum", "r1.1.tum"]
    for path in written:
        trajectory = file_interface.read_tum_trajectory_file(str(path))
        nodes = [node for node in part.nodes if f"{node.map}.tum" == path.name]
        assert np.allclose(trajectory.timestamps, [part.node(node).stamp_ns / 1e9 for node in nodes])
        assert np.allclose(
            trajectory.positions_xyz[:, :2], [part.pose(n).vector[:2] for n in nodes], atol=1e-5
        )
        headings = trajectory.get_orientations_euler("sxyz")[:, 2]
        off = [
            math.remainder(h - part.pose(n).heading, math.tau) for h, n in zip(headings, nodes, strict=True)
        ]
        assert np.abs(off).max() < 1e-5


def test_one_robot_needs_no_folder(merged: MergedMap, tmp_path):
    (path,) = FORMATS["tum"](MapPart(merged, 1), tmp_path / "r2.tum")
    assert path.is_file()


def test_networkx_reads_the_graph(part: MapPart, tmp_path):
    (path,) = FORMATS["graphml"](part, tmp_path / "map.graphml")
    graph = nx.read_graphml(path, force_multigraph=True)
    union = part.graph
    assert set(graph.nodes) == {str(node) for node in part.nodes}
    assert set(graph.edges(keys=True)) <= {
        tuple(ends) for e in union.edges.values()
        for ends in ((str(e.a), str(e.b), str(e.id)), (str(e.b), str(e.a), str(e.id)))
    }  # fmt: skip
    assert graph.number_of_edges() == len(union.edges)
    for _, _, key, data in graph.edges(keys=True, data=True):
        edge = union.edges[NodeId.parse(key)]
        assert data["kind"] == str(edge.kind) and data["x"] == pytest.approx(edge.a_from_b.mean.x)
        assert ("probability" in data) == (edge.kind in (EdgeKind.MERGED, EdgeKind.LOOP))
    for node, data in graph.nodes(data=True):
        assert data["heading"] == pytest.approx(part.pose(NodeId.parse(node)).heading)


def test_the_route_graph_has_the_format_of_nav2(part: MapPart, tmp_path):
    """By hand: points with ids and a frame; lines both ways between them; no id twice."""
    (path,) = FORMATS["geojson"](part, tmp_path / "map.geojson")
    graph = json.loads(path.read_text())
    assert graph["type"] == "FeatureCollection"
    points, lines, ids = {}, [], []
    for feature in graph["features"]:
        assert feature["type"] == "Feature"
        properties, geometry = feature["properties"], feature["geometry"]
        assert type(properties["id"]) is int and 0 <= properties["id"] < 2**32
        ids.append(properties["id"])
        if geometry["type"] == "Point":
            assert properties["frame"] == "map"
            points[properties["id"]] = geometry["coordinates"]
        else:
            assert geometry["type"] == "MultiLineString"
            lines.append((properties, geometry["coordinates"]))
        for value in properties["metadata"].values():
            assert type(value) in (str, int, float, bool)
    assert len(set(ids)) == len(ids) and len(points) == len(part.nodes)
    for properties, (line,) in lines:
        assert line == [points[properties["startid"]], points[properties["endid"]]]
        assert properties["cost"] >= math.dist(*line) and type(properties["overridable"]) is bool
    ways = sorted((p["startid"], p["endid"]) for p, _ in lines)
    assert ways == sorted((b, a) for a, b in ways)


def test_nav2_is_led_as_robots_are(merged: MergedMap, tmp_path):
    """What the servo could not drive is no way; nodes in one place are joined, and superseded ones."""
    blind = merged.links[0].a
    count = len(merged.maps[blind.map].nodes[blind].landmarks)
    part = MapPart(replace(merged, faded={blind: np.ones(count, np.bool_)}))
    (path,) = FORMATS["geojson"](part, tmp_path / "map.geojson")
    features = json.loads(path.read_text())["features"]
    collected = [f["properties"]["metadata"] for f in features if f["geometry"]["type"] != "Point"]
    closed = {link.edge().id for link in merged.links if blind in link.pair}
    kinds = Counter(item["kind"] for item in collected)
    assert closed and {item["edge"] for item in collected}.isdisjoint(map(str, closed))
    assert len(collected) - kinds["near"] - kinds["superseded"] == 2 * (len(part.graph.edges) - len(closed))
    drivable = {frozenset((e.a, e.b)) for e in part.graph.edges.values() if e.id not in closed}
    near = [
        pair for pair in combinations(part.nodes, 2)
        if part.pose(pair[0]).distance(part.pose(pair[1])) <= 0.5 and frozenset(pair) not in drivable
    ]  # fmt: skip
    assert kinds["near"] == 2 * len(near)
    assert kinds["superseded"] == 2 * len(part.merged.superseded)


@pytest.mark.parametrize("form", list(FORMATS))
def test_the_command_writes_and_prints_what_is_left_out(merged: MergedMap, form: str, tmp_path, capfd):
    file = tmp_path / "m.mapweave"
    write_map_file(file, map_file_of(merged))
    assert main(["map", "export", str(file), "--format", form, "-o", str(tmp_path / "out")]) == 0
    out, err = capfd.readouterr()
    assert all(Path(line).stat().st_size > 100 for line in out.splitlines())
    assert "6 nodes of others are left out" in err
    arguments = ["map", "export", str(file), "--format", form, "-o", str(tmp_path / "no"), "--component", "7"]
    assert main(arguments) == NO
    assert "the map has no component 7; it has 0 to 1" in capfd.readouterr().err
    assert not (tmp_path / "no").exists()


finite = st.floats(-1e6, 1e6)
sigmas = st.floats(1e-3, 1e3)
edges = st.builds(
    lambda ends, x, y, h, a, b, c: G2oEdge.measured(*ends, Pose2(x, y, h), np.diag([a, b, c]) ** 2),
    st.sampled_from([(0, 1), (1, 2), (2, 0)]), finite, finite, st.floats(-4, 4), sigmas, sigmas, sigmas,
)  # fmt: skip


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.tuples(*[st.builds(Pose2, finite, finite, st.floats(-4, 4))] * 3), st.lists(edges, max_size=5))
def test_g2o_comes_back_to_the_last_bit(tmp_path, poses: tuple[Pose2, ...], drawn: list[G2oEdge]):
    graph = G2oGraph(dict(enumerate(poses)), drawn, (1,))
    write_g2o(tmp_path / "x.g2o", graph, {0: "r0.1.1"})
    back = read_g2o(tmp_path / "x.g2o")
    assert back.poses == graph.poses and back.fixed == (1,) and len(back.edges) == len(drawn)
    for first, second in zip(back.edges, drawn, strict=True):
        assert (first.i, first.j, first.i_from_j) == (second.i, second.j, second.i_from_j)
        assert np.array_equal(first.information, second.information)


def square(noise: float, seed: int) -> G2oGraph:
    """A loop of four by two sides, with measurements that are off."""
    rng = np.random.default_rng(seed)
    true = [Pose2(x, y, h) for x, y, h in ((0, 0, 0), (2, 0, 1.57), (2, 2, 3.14), (0, 2, -1.57))]
    covariance = np.diag([0.1, 0.1, 0.02]) ** 2
    measured = [
        G2oEdge.measured(
            i, j, true[i].inverse() @ true[j] @ Pose2(*(noise * rng.normal(0, [0.1, 0.1, 0.02]))), covariance
        )
        for i, j in ((0, 1), (1, 2), (2, 3), (3, 0), (0, 2))
    ]
    return G2oGraph({k: pose @ Pose2(0.1 * k, 0, 0.05 * k) for k, pose in enumerate(true)}, measured)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_back_end_finds_gtsam_s_optimum_of_others_graphs(seed: int, tmp_path, capfd):
    graph = square(1.0, seed)
    write_g2o(tmp_path / "in.g2o", graph)
    factors, values = gtsam.readG2o(str(tmp_path / "in.g2o"), False)
    factors.add(gtsam.PriorFactorPose2(0, values.atPose2(0), gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)))
    best = 2.0 * factors.error(gtsam.GaussNewtonOptimizer(factors, values).optimize())
    wrong = tmp_path / "out.mapweave"
    assert main(["map", "import", str(tmp_path / "in.g2o"), "-o", str(wrong)]) == 2
    assert "what is written is a pose graph, no map" in capfd.readouterr().err and not wrong.exists()
    arguments = ["map", "import", str(tmp_path / "in.g2o"), "-o", str(tmp_path / "out.g2o"), "--json"]
    assert main(arguments) == 0
    result = json.loads(capfd.readouterr().out)
    assert result["chi2"] == pytest.approx(best, rel=1e-5) and result["chi2_before"] > 2 * result["chi2"]
    assert read_g2o(tmp_path / "out.g2o").chi2() == pytest.approx(result["chi2"])


def test_a_graph_whose_numbers_are_too_large_is_refused_in_one_line(tmp_path, capfd):
    path = tmp_path / "in.g2o"
    edge = "EDGE_SE2 0 1 1 0 0 1e308 0 0 1 0 1\n"
    path.write_text(f"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1e308 0 0\n{edge}")
    assert main(["map", "import", str(path), "-o", str(tmp_path / "out.g2o")]) == 1
    words = "its numbers are too large to be added up: give metres and radians"
    assert capfd.readouterr().err == f"mapweave: {path}: {words}\n"
    assert not (tmp_path / "out.g2o").exists()


def test_vertices_without_a_line_are_placed_along_edges(tmp_path):
    graph = square(0.0, 0)
    path = tmp_path / "edges.g2o"
    write_g2o(path, graph)
    path.write_text("\n".join(line for line in path.read_text().splitlines() if line.startswith("EDGE")))
    back = read_g2o(path)
    assert len(back.poses) == 4 and back.chi2() == pytest.approx(0.0, abs=1e-12)


LINE = "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 0 0 0\n"


@pytest.mark.parametrize(("text", "words"), [
    ("", "holds neither vertex nor edge"),
    ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n", "line 1: 'VERTEX_SE3:QUAT' is none of"),
    ("VERTEX_SE2 0 0 0\n", "line 1: VERTEX_SE2 needs 4 numbers, not 3"),
    ("VERTEX_SE2 0 0 zero 0\n", "line 1: a word is no number"),
    ("VERTEX_SE2 0 nan 0 0\n", "line 1: a number is not finite"),
    (LINE + "EDGE_SE2 0 1 0 0 0 1 2 0 1 0 1\n", "line 3: the information must be positive definite"),
    (LINE + "EDGE_SE2 4 5 0 0 0 1 0 0 1 0 1\n", "neither a vertex nor a chain of edges gives the pose of 4"),
    ("\x89PNG", "is none of"),
])  # fmt: skip
def test_non_planar_graphs_are_reported_with_the_line(text: str, words: str, tmp_path):
    path = tmp_path / "bad.g2o"
    path.write_text(text)
    with pytest.raises(InvalidFile, match=words):
        read_g2o(path)


def test_pieces_are_not_optimised_as_one():
    with pytest.raises(InvalidValue, match="in 2 pieces"):
        optimum_of(G2oGraph({0: Pose2(), 1: Pose2()}, []))
