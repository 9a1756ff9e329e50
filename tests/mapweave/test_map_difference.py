"""`mapweave map diff`: what a merge changed, by maps whose difference is known."""

import json
from dataclasses import replace

import numpy as np
import pytest

from mapweave import MapFile, NodeId, Pose2, PoseGaussian, read_map_file, write_map_file
from mapweave.cli import main
from mapweave.exit_status import NO
from mapweave.hybridmap.change import NodePut
from mapweave.map_difference import difference
from mapweave.mapserver.map_files import merged_of
from mapweave.merge.pose_graph.merged_map import MergedMap, Placement
from tests.mapweave.test_opened_map import LOGS, R0, R1


@pytest.fixture(scope="module")
def own() -> MergedMap:
    return merged_of(MapFile("agent", "r0.1", tuple(LOGS[R0])))


def placed(merged: MergedMap, move: dict[NodeId, Pose2], frame: Pose2) -> MergedMap:
    """The same map in another frame, some nodes elsewhere in it."""
    poses = {
        node: Placement(
            place.component,
            PoseGaussian(
                frame @ place.merged_from_robot.mean @ move.get(node, Pose2()),
                place.merged_from_robot.covariance,
            ),
        )
        for node, place in merged.poses.items()
    }
    return replace(merged, poses=poses)


def test_a_frame_is_no_change_and_a_node_that_moved_is_found(own: MergedMap):
    (same,) = difference(own, placed(own, {}, Pose2(5.0, -3.0, 2.0))).moved
    assert same.nodes == 4 and same.largest == pytest.approx(0.0, abs=1e-9)
    assert same.turn == pytest.approx(0.0, abs=1e-9)
    node = sorted(own.poses)[2]
    (moved,) = difference(own, placed(own, {node: Pose2(0.8, 0.0, 0.0)}, Pose2(5.0, -3.0, 2.0))).moved
    # Rotation and shift of the least squares take a part of it.
    assert moved.node == node and 0.2 < moved.largest <= 0.8
    assert moved.median < moved.largest


def test_what_a_merge_changed_is_said(tmp_path, capfd):
    paths = []
    for map_id in (R0, R1):
        paths.append(tmp_path / f"{map_id}.mapweave")
        write_map_file(paths[-1], MapFile("agent", str(map_id), tuple(LOGS[map_id])))
    both = tmp_path / "both.mapweave"
    assert main(["map", "merge", *map(str, paths), "-o", str(both)]) == 0
    links = {link.pair for link in merged_of(read_map_file(both)).links}
    capfd.readouterr()
    assert main(["map", "diff", str(paths[0]), str(both), "--json"]) == NO
    said = json.loads(capfd.readouterr().out)
    added = [str(body.node.id) for body in LOGS[R1] if isinstance(body, NodePut)]
    assert said["same"] is False and said["added"] == added and said["removed"] == []
    assert {tuple(NodeId.parse(end) for end in pair) for pair in said["linked"]} == links
    assert said["moved"][0]["nodes"] == 4 and said["moved"][0]["largest"] < 0.1
    assert main(["map", "diff", str(both), str(paths[0])]) == NO
    lines = capfd.readouterr().out.splitlines()
    assert any(line.startswith("4 nodes removed: r1.1.1, ") for line in lines)
    assert main(["map", "diff", str(both), str(both)]) == 0
    assert capfd.readouterr().out == "the maps are the same\n"
    # One bit of a landmark: nothing else follows from it.
    content = read_map_file(both)
    put = content.changes[0]
    assert isinstance(put, NodePut)
    codes = put.node.landmarks.codes.copy()
    codes[0, 0] ^= np.uint8(1)
    other = replace(put.node, landmarks=replace(put.node.landmarks, codes=codes))
    write_map_file(both, replace(content, changes=(NodePut(other), *content.changes[1:])))
    merged = tmp_path / "merged.mapweave"
    assert main(["map", "merge", *map(str, paths), "-o", str(merged)]) == 0
    capfd.readouterr()
    assert main(["map", "diff", str(merged), str(both)]) == NO
    said = f"landmarks or edges differ, and nothing that follows: node {put.node.id}\n"
    assert capfd.readouterr().out == said


def test_what_people_said_is_a_difference(tmp_path, capfd):
    path, named = tmp_path / "r0.mapweave", tmp_path / "named.mapweave"
    write_map_file(path, MapFile("agent", "r0.1", tuple(LOGS[R0])))
    words = ["place", "add", "kitchen", "r0.1.1", "--by", "anna", "--map", str(path), "-o", str(named)]
    assert main(words) == 0
    capfd.readouterr()
    assert main(["map", "diff", str(path), str(named)]) == NO
    assert capfd.readouterr().out == "new: place kitchen is node r0.1.1, by anna\n"
    assert main(["map", "diff", str(named), str(path), "--json"]) == NO
    decided = json.loads(capfd.readouterr().out)["decided"]
    assert decided == ["not in the record: place kitchen is node r0.1.1, by anna"]
