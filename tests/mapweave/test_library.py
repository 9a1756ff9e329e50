"""`import mapweave`: what it offers, that it loads nothing before it is used, and a map's way through it."""

import ast
import json
import subprocess
import sys
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
import pytest

import mapweave
from synthetic.maps import changes_of
from synthetic.world import room, take_map, take_view
from tests.mapweave.command_line import CAMERA
from tests.waiting import free_port

SOURCE = Path(mapweave.__file__)
WORLD = room(0, 0, 5, 4, 600, np.random.default_rng(1))
TOUR = [mapweave.Pose2(2.2 + 0.1 * k, 1.8, 0.9 * k) for k in range(4)]


PUBLIC = """
    AgentStatus Area Camera Certainty Command Edge EdgeKind FileMap Fleet FleetEvent FleetStatus
    HybridMap Landmarks ManualConstraint Map MapChanged MapEvent MapEventKind MapFile MapId
    MapsExplanation MapweaveError MissionKind MissionReport MissionState Node NodeId NodeTable NotConnected
    Observation Odometry PairExplanation Pose2 PoseGaussian Refused RelocalizeAnswer Relocalizer Robot
    RobotDescription RobotEntry RouteExplanation View connect maps_of merge_map_files open read_camera
    read_grey read_map_file relocalizer_of view_of write_map_file
"""


def python(code: str, *arguments: str) -> str:
    """What another process prints."""
    process = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    return process.stdout


def test_nothing_is_loaded_before_it_is_used():
    code = """
import json, sys
before = {*sys.modules}
import mapweave
from_import = sorted({*sys.modules} - before)
dir(mapweave)
mapweave.Pose2
libraries = ("cv2", "zenoh", "networkx", "scipy", "numba")
print(json.dumps([from_import, [name for name in libraries if name in sys.modules]]))
"""
    loaded, heavy = json.loads(python(code))
    # All else comes with Python.
    assert {name.split(".")[0] for name in loaded} <= {"mapweave", *sys.stdlib_module_names}
    assert [name for name in loaded if name.startswith("mapweave")] == ["mapweave"]
    assert heavy == []


def test_each_name_is_what_type_checkers_see():
    """The block for type checkers lists the same names from the same modules."""
    (block,) = (node for node in ast.parse(SOURCE.read_text()).body if isinstance(node, ast.If))
    imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    declared = {alias.asname: (node.module, alias.name) for node in imports for alias in node.names}
    assert set(mapweave.__all__) == declared.keys()
    for name, (module, original) in declared.items():
        assert name == original
        assert getattr(mapweave, name) is getattr(import_module(str(module)), name)
        assert name in dir(mapweave)


def test_what_is_public_is_this_list():
    """Others' programs depend on these names: one that is added stays."""
    assert sorted(mapweave.__all__) == PUBLIC.split()
    assert set(dir(mapweave)) == {*mapweave.__all__, "__version__"}


def test_advice_is_also_of_use_in_python():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with pytest.raises(mapweave.MapweaveError) as refused:
        mapweave.connect(endpoint)
    advice = "start `mapweave server`, or give the endpoint of its router (--connect)"
    assert str(refused.value) == f"no router at {endpoint}: {advice}"


def test_what_is_not_there():
    with pytest.raises(AttributeError, match="'mapweave' has no attribute 'merge_maps'"):
        _ = mapweave.merge_maps  # type: ignore[attr-defined]
    with pytest.raises(ImportError, match="cannot import name 'NoSuch'"):
        exec("from mapweave import NoSuch")


def test_the_version_is_that_of_the_installed_package():
    assert mapweave.__version__ == version("mapweave")


def test_a_name_whose_extra_is_missing_says_which():
    code = """
import sys
from tests.mapweave.without_libraries import Without
sys.meta_path[:] = [Without(finder, frozenset({"faiss", "gtsam"})) for finder in sys.meta_path]
import mapweave
mapweave.read_map_file, mapweave.HybridMap, mapweave.Robot
try:
    mapweave.relocalizer_of
except ImportError as error:
    print(error)
"""
    said = python(code).strip()
    assert said.startswith('mapweave.relocalizer_of needs the extra "server": ')
    assert said.endswith("pip install 'mapweave[server]'")


def test_maps_are_written_read_merged_and_say_where_a_view_was_taken(tmp_path):
    rng = np.random.default_rng(2)
    paths = [tmp_path / f"{name}.mapweave" for name in ("r0", "r1")]
    places: dict[mapweave.NodeId, mapweave.Pose2] = {}
    for path in paths:
        nodes, edges = take_map(WORLD, mapweave.MapId(path.stem, 1), TOUR, rng)
        places |= {node.id: place for node, place in zip(nodes, TOUR, strict=True)}
        content = mapweave.MapFile("agent", path.stem, tuple(changes_of(nodes, edges)))
        mapweave.write_map_file(path, content)
    own = mapweave.read_map_file(paths[0])
    assert mapweave.HybridMap(own.changes).nodes.keys() == {node for node in places if node.agent == "r0"}

    merged = mapweave.merge_map_files(paths)
    assert merged.kind == "merged" and {component for component, _ in merged.poses.values()} == {0}
    together = tmp_path / "together.mapweave"
    mapweave.write_map_file(together, merged)
    read = mapweave.read_map_file(together)
    assert {map_id.agent for map_id in mapweave.maps_of(read)} == {"r0", "r1"}

    # Where it was is known: beside the third place.
    moved = mapweave.Pose2(0.1, 0.05, 0.05)
    view, _ = take_view(WORLD, TOUR[2] @ moved, np.random.default_rng(5))
    for content in (own, read):
        answer = mapweave.relocalizer_of(content).answer(view)
        assert answer.certainty is mapweave.Certainty.FOUND, answer.reason
        best = answer.candidates[0]
        there = places[best.node] @ best.node_from_robot.mean
        true = TOUR[2] @ moved
        assert np.hypot(there.x - true.x, there.y - true.y) < 0.05
        assert abs(there.heading - true.heading) < 0.03
    elsewhere = room(0, 0, 5, 4, 600, np.random.default_rng(9))
    view, _ = take_view(elsewhere, TOUR[2], np.random.default_rng(5))
    assert mapweave.relocalizer_of(read).answer(view).certainty is mapweave.Certainty.UNKNOWN


def test_one_path_is_no_list_of_map_files(tmp_path):
    for one in ("one.mapweave", tmp_path / "one.mapweave"):
        with pytest.raises(mapweave.MapweaveError, match="give a list of map files, such as"):
            mapweave.merge_map_files(one)  # type: ignore[arg-type]


def test_a_path_may_be_text(tmp_path):
    """As of `mapweave.open`; what is wrong with one is an error of one line."""
    at = str(tmp_path / "empty.mapweave")
    mapweave.write_map_file(at, mapweave.MapFile("merged", "nothing", ()))
    assert mapweave.read_map_file(at).title == "nothing"
    (tmp_path / "camera.toml").write_text(CAMERA)
    camera, _ = mapweave.read_camera(str(tmp_path / "camera.toml"))
    assert (camera.width, camera.height) == (64, 48)
    cv2.imwrite(str(tmp_path / "0.png"), np.full((48, 64), 90, np.uint8))
    assert mapweave.read_grey(str(tmp_path / "0.png"), camera).shape == (48, 64)
    for read in (mapweave.read_map_file, mapweave.read_camera, mapweave.read_grey):
        for missing in (str(tmp_path / "none"), str(tmp_path)):
            with pytest.raises(mapweave.MapweaveError) as refused:
                read(missing)
            assert str(refused.value).startswith(missing) and "\n" not in str(refused.value)
    with pytest.raises(mapweave.MapweaveError, match="Is a directory"):
        mapweave.read_grey(tmp_path)
