"""Exports of floor plans, read as those who want them read them."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from ruamel.yaml import YAML

from mapweave.formats.plan_export import FORMATS, export_json, export_nav2, export_rmf, export_tf, plan_words
from mapweave.hybridmap.floor_plan import FloorPlan, PlacedPlan, PlanImage, PlanPair
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.mapserver.floor_plans import check_plan
from mapweave.merge.pose_graph.component import Component
from mapweave.merge.pose_graph.factors import Factors, RelativePose
from mapweave.merge.pose_graph.merged_map import MergedMap, NodePoses

SCALE = 0.05
IMAGE = PlanImage("0" * 64, 400, 300, "office.pgm")
ORIGIN = Pose2(-10.0, -5.5, 0.25)
MERGED_FROM_CORNER = Pose2(2.0, -3.0, 0.7)
PIXELS = np.array([[20.0, 30.0], [350.0, 60.0], [200.0, 280.0], [40.0, 220.0]])


@pytest.fixture(params=[Pose2(), ORIGIN])
def placed(request: pytest.FixtureRequest) -> PlacedPlan:
    """Four nodes, exactly where four pixels are."""
    corner = SCALE * np.column_stack([PIXELS[:, 0], IMAGE.height - PIXELS[:, 1]])
    points = MERGED_FROM_CORNER.apply(corner)
    nodes = tuple(NodeId("a", 1, k) for k in range(4))
    means = np.column_stack([points, np.zeros(4)])
    step = [
        RelativePose(
            nodes[k], nodes[k + 1], PoseGaussian(Pose2(*(means[k + 1] - means[k])), 1e-4 * np.eye(3))
        )
        for k in range(3)
    ]
    graph = Component(nodes[0], nodes, means, Factors.of(step, [0, 1, 2], [1, 2, 3]))
    merged = MergedMap({}, (), (), (frozenset(nodes),), NodePoses([graph]), (graph,))
    pairs = [PlanPair(node, 0.0, 0.0, u, v) for node, (u, v) in zip(nodes, PIXELS.tolist(), strict=True)]
    plan = FloorPlan(tuple(pairs), IMAGE, SCALE, request.param)
    return PlacedPlan("3. floor: east", plan, check_plan(plan, merged).parts)


def estimated(source: Array, target: Array) -> tuple[float, float, Array]:
    """Rotation, scale and translation as `nudged.estimate` finds them: linear least squares."""
    rows, right = [], []
    for (x, y), (u, v) in zip(source, target, strict=True):
        rows += [[x, -y, 1.0, 0.0], [y, x, 0.0, 1.0]]
        right += [u, v]
    s, r, *shift = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
    return math.atan2(r, s), math.hypot(s, r), np.array(shift)


def test_rmf_estimates_the_transform_from_the_reference_coordinates(placed: PlacedPlan):
    text = export_rmf(placed, placed.part())
    ((level, coordinates),) = YAML(typ="safe").load(text)["reference_coordinates"].items()
    assert level == placed.name
    rmf, robot = np.array(coordinates["rmf"]), np.array(coordinates["robot"])
    # The traffic editor: metres from the upper left corner, y up.
    assert np.allclose(rmf, SCALE * PIXELS * (1.0, -1.0), atol=2e-3)
    rotation, scale, shift = estimated(rmf, robot)
    assert scale == pytest.approx(1.0, abs=1e-3)
    pixel = np.array([100.0, 120.0])
    corner = SCALE * np.array([pixel[0], IMAGE.height - pixel[1]])
    found = Pose2(*shift, rotation).apply(SCALE * pixel * (1.0, -1.0))
    assert np.allclose(found, MERGED_FROM_CORNER.apply(corner), atol=5e-3)
    words = re.search(r"rotation (\S+) rad, scale 1, translation \[(\S+), (\S+)\]", text)
    assert words is not None
    assert [float(word) for word in words.groups()] == pytest.approx([rotation, *shift], abs=5e-3)


def test_nav2_puts_each_pixel_under_the_map(placed: PlacedPlan):
    fields = YAML(typ="safe").load(export_nav2(placed, placed.part()))
    assert fields["image"] == "office.pgm" and fields["resolution"] == SCALE
    x, y, yaw = fields["origin"]
    # map_server: the origin is the pose of the lower left pixel.
    for u, v in PIXELS:
        along, up = SCALE * u, SCALE * (IMAGE.height - v)
        point = (
            x + math.cos(yaw) * along - math.sin(yaw) * up,
            y + math.sin(yaw) * along + math.cos(yaw) * up,
        )
        assert point == pytest.approx(tuple(MERGED_FROM_CORNER.apply(np.array([along, up]))), abs=2e-3)


@pytest.mark.parametrize("name", ["!!python/object/apply:os.system [id]", "a: b # c.png", "'\"*&.png"])
def test_the_name_of_an_image_is_a_text_and_no_yaml(placed: PlacedPlan, name: str):
    """Some programs of ROS 1 read a map.yaml with a loader that runs what such a tag names."""
    named = replace(placed, plan=replace(placed.plan, image=replace(placed.plan.image, file=name)))
    assert YAML(typ="safe").load(export_nav2(named, named.part()))["image"] == name


def test_tf_places_the_frame_of_the_plan_in_that_of_the_map(placed: PlacedPlan):
    words = export_tf(placed, placed.part()).split()
    options = dict(zip(words[4::2], words[5::2], strict=True))
    assert words[:4] == ["ros2", "run", "tf2_ros", "static_transform_publisher"]
    assert (options["--frame-id"], options["--child-frame-id"]) == ("map", "3__floor__east")
    map_from_plan = Pose2(float(options["--x"]), float(options["--y"]), float(options["--yaw"]))
    in_plan = placed.plan.origin.apply(np.array([1.0, 2.0]))
    assert np.allclose(
        map_from_plan.apply(in_plan), MERGED_FROM_CORNER.apply(np.array([1.0, 2.0])), atol=2e-3
    )


def test_json_has_both_directions_and_every_pair(placed: PlacedPlan):
    content = json.loads(export_json(placed, placed.part()))
    there, back = Pose2(*content["plan_from_merged"]), Pose2(*content["merged_from_plan"])
    assert np.allclose((there @ back).vector, 0.0, atol=1e-9)
    assert [pair["node"] for pair in content["pairs"]] == ["a.1.0", "a.1.1", "a.1.2", "a.1.3"]
    assert len(content["covariance"]) == 16 and set(FORMATS) == {"rmf", "nav2", "tf", "json"}
    text = "\n".join(plan_words(placed))
    assert "0.05 m/px as given, 0.05 by the pairs" in text and "pair 4: a.1.3" in text
