"""`mapweave map show` on files that are written here."""

import json
import math
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from mapweave import Area, Edge, EdgeKind, MapFile, MapId, NodeId, Pose2, PoseGaussian, write_map_file
from mapweave.cli import main
from mapweave.drawing.map_picture import MapPicture
from mapweave.hybridmap.annotation import Annotation, Place
from mapweave.hybridmap.change import ChangeBody, EdgePut, NodePut
from mapweave.mapserver.content_hash import content_hash
from synthetic.maps import changes_of
from synthetic.world import room, take_map

TOUR = [Pose2(2.5, 2.0, h) for h in np.arange(0, 2 * math.pi, math.pi / 3)]


def changes(agent: str) -> list[ChangeBody]:
    """A full turn in a room."""
    rng = np.random.default_rng(0)
    return changes_of(*take_map(room(0, 0, 5, 4, 700, rng), MapId(agent, 1), TOUR, rng))


@pytest.fixture
def agent_file(tmp_path: Path) -> Path:
    """One robot's map."""
    path = tmp_path / "r0.mapweave"
    write_map_file(path, MapFile("agent", "r0.1", tuple(changes("r0"))))
    return path


@pytest.fixture
def merged_file(tmp_path: Path) -> Path:
    """Two robots' maps that are joined, and a node without a component."""
    contents = [*changes("r0"), *changes("r1")]
    nodes = [change.node for change in contents if isinstance(change, NodePut)]
    near = PoseGaussian.from_sigmas(Pose2(), 0.02, 0.02)
    link = Edge(NodeId("s0", 1, 1), nodes[0].id, NodeId("r1", 1, 1), near, EdgeKind.MERGED)
    poses = {n.id: (1 if n.id == NodeId("r1", 1, 11) else 0, n.map_from_robot) for n in nodes}
    path = tmp_path / "merged.mapweave"
    write_map_file(path, MapFile("merged", "two robots", (*contents, EdgePut(link)), poses))
    return path


def summary(capfd: pytest.CaptureFixture[str], *arguments: object) -> dict[str, object]:
    assert main(["map", "show", *map(str, arguments), "--json"]) == 0
    out, err = capfd.readouterr()
    assert err == ""
    assert len(out.splitlines()) == 1
    collected: dict[str, object] = json.loads(out)
    return collected


def test_the_summary_of_an_agents_map(agent_file, capfd):
    contents = changes("r0")
    counts = [len(change.node.landmarks) for change in contents if isinstance(change, NodePut)]
    assert summary(capfd, agent_file) == {
        "file": str(agent_file),
        "source": "map file",
        "kind": "agent",
        "title": "r0.1",
        "content_hash": content_hash(MapFile("agent", "", tuple(contents))),
        "bytes": agent_file.stat().st_size,
        "maps": ["r0.1"],
        "nodes": len(TOUR),
        "superseded": 0,
        "edges": {"turned": len(TOUR) - 1},
        "links": 0,
        "refused": 0,
        "constraints": 0,
        "components": 1,
        "landmarks_per_node_median": float(np.median(counts)),
        "picture": str(agent_file.with_suffix(".png")),
    }
    image = cv2.imread(str(agent_file.with_suffix(".png")))
    assert image is not None
    assert image.std() > 5


def test_the_summary_of_a_merged_map(merged_file, capfd, tmp_path):
    values = summary(capfd, merged_file, "--out", tmp_path / "pictures" / "m.png")
    assert values["kind"] == "merged"
    assert values["maps"] == ["r0.1", "r1.1"]
    assert values["nodes"] == 2 * len(TOUR)
    assert values["edges"] == {"turned": 2 * (len(TOUR) - 1), "merged": 1}
    assert (values["links"], values["components"]) == (1, 2)
    assert (tmp_path / "pictures" / "m.png").stat().st_size > 5000
    assert values["drawn"] == f"component 0, {2 * len(TOUR) - 1} nodes"
    values = summary(capfd, merged_file, "--out", tmp_path / "other.png", "--component", 1)
    assert values["drawn"] == "component 1, 1 node"
    assert (tmp_path / "other.png").read_bytes() != (tmp_path / "pictures" / "m.png").read_bytes()
    assert main(["map", "show", str(merged_file), "--component", "2"]) == 4
    assert "has no component 2; it has 0 to 1" in capfd.readouterr().err


def test_without_a_picture_none_is_drawn(agent_file, capfd):
    assert "picture" not in summary(capfd, agent_file, "--no-picture")
    assert not agent_file.with_suffix(".png").exists()


def test_a_summary_comes_also_where_no_picture_can_be_written(agent_file, merged_file, capfd, monkeypatch):
    """As from a disk that is read-only, beside the map; a picture that is asked for must be written."""
    monkeypatch.setattr(os, "access", lambda *_: False)
    monkeypatch.setattr(os, "statvfs", lambda _: SimpleNamespace(f_flag=os.ST_RDONLY))
    for file in (agent_file, merged_file):
        assert main(["map", "show", str(file), "--json"]) == 0
        out, err = capfd.readouterr()
        assert not {"picture", "drawn"} & json.loads(out).keys() and json.loads(out)["nodes"]
        (line,) = err.splitlines()
        assert "the disk is read-only" in line and line.endswith("; give -o PNG, or --no-picture")
    assert main(["map", "show", str(agent_file), "-o", str(agent_file.with_suffix(".png"))]) == 1
    assert capfd.readouterr().out == ""


def test_people_read_lines(agent_file, capfd):
    assert main(["map", "show", str(agent_file), "--no-picture"]) == 0
    lines = dict(line.split(maxsplit=1) for line in capfd.readouterr().out.splitlines() if line)
    assert lines["nodes"] == str(len(TOUR))
    assert lines["edges"] == f"{len(TOUR) - 1} turned"
    assert lines["maps"] == "r0.1"


def test_a_map_of_nothing(tmp_path, capfd):
    path = tmp_path / "empty.mapweave"
    write_map_file(path, MapFile("agent", "nothing", ()))
    values = summary(capfd, path)
    assert (values["nodes"], values["edges"], values["components"]) == (0, {}, 0)
    assert "picture" not in values


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.99])
def test_a_truncated_file_is_refused(agent_file, capfd, share):
    data = agent_file.read_bytes()
    agent_file.write_bytes(data[: int(share * len(data))])
    assert main(["map", "show", str(agent_file)]) == 1
    out, err = capfd.readouterr()
    assert out == ""
    (line,) = err.splitlines()
    assert line.startswith(f"mapweave: {agent_file}: is ")
    assert not agent_file.with_suffix(".png").exists()


def test_a_robots_own_map_is_drawn_with_its_loop_closure_applied(tmp_path, monkeypatch):
    """Four steps of 1 m and a loop closure of 3.6 m, all equally sure: the optimum divides 0.4 m by five."""
    nodes = [body.node for body in changes("r0") if isinstance(body, NodePut)][:5]
    relative = [*(((k, k + 1), 1.0, EdgeKind.MAPPED) for k in range(4)), ((0, 4), 3.6, EdgeKind.LOOP)]
    contents: list[ChangeBody] = []
    for k, node in enumerate(nodes):
        at = PoseGaussian.from_sigmas(Pose2(float(k)), 0.1, 0.01)
        contents.append(NodePut(replace(node, map_from_robot=at)))
    for number, ((a, b), x, kind) in enumerate(relative):
        measured = PoseGaussian.from_sigmas(Pose2(x), 0.1, 0.01)
        contents.append(
            EdgePut(Edge(NodeId("r0", 1, 100 + number), nodes[a].id, nodes[b].id, measured, kind))
        )
    path = tmp_path / "r0.mapweave"
    write_map_file(path, MapFile("agent", "r0.1", tuple(contents)))
    drawn: list[MapPicture] = []
    monkeypatch.setattr("mapweave.drawing.map_picture.draw_map", lambda picture, out: drawn.append(picture))
    assert main(["map", "show", str(path)]) == 0
    x = [drawn[0].poses[node.id].x for node in nodes]
    assert np.diff(x) == pytest.approx([0.92] * 4, abs=1e-3)


def test_named_places_are_drawn(tmp_path, monkeypatch):
    contents = tuple(changes("r0"))
    node = next(body.node for body in contents if isinstance(body, NodePut))
    area = Area(node.id, ((1.0, 0.0), (3.0, 0.0), (3.0, 2.0), (1.0, 2.0)))
    said = (
        Annotation("dock", Place(node.id), False, "anna", 1),
        Annotation("hall", Place(area=area), False, "anna", 2),
        Annotation("gone", Place(node.id), False, "anna", 3),
        Annotation("gone", Place(node.id), True, "anna", 4),
    )
    path = tmp_path / "r0.mapweave"
    write_map_file(path, MapFile("agent", "r0.1", contents, annotations=said))
    drawn: list[MapPicture] = []
    monkeypatch.setattr("mapweave.drawing.map_picture.draw_map", lambda picture, out: drawn.append(picture))
    assert main(["map", "show", str(path)]) == 0
    at = drawn[0].poses[node.id]
    assert drawn[0].places.keys() == {"dock", "hall"}
    assert drawn[0].places["dock"] == pytest.approx((at.x, at.y))
    assert drawn[0].places["hall"] == pytest.approx(at.apply(np.array([[2.0, 1.0]]))[0])
