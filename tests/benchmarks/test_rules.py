"""With each rule of the table switched off everything still runs: what takes its place fits."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.rules.drives import mapped, recorded
from benchmarks.rules.fleets import single_links
from benchmarks.rules.frame_faults import FAULTS, Drive
from benchmarks.rules.look_alikes import PAIRS, look_alikes
from benchmarks.rules.own_loops import draw, own_loops, would_send
from benchmarks.rules.switches import (
    ALL,
    FRAME_RULES,
    LOOP_RULES,
    PLACE_RULES,
    RECOGNITION_RULES,
    SINGLE_RULES,
    TRIAL_RULES,
    Switch,
    by_rule,
    switched_off,
)
from mapweave import EdgeKind, MapId, Pose2, PoseGaussian, RobotDescription, View
from mapweave.hybridmap.change import ChangeBody, EdgePut, NodePut
from mapweave.mapserver.answers import Answers
from mapweave.mapserver.merging.merger import Merger
from synthetic.wrong_geometry import SCENES, OdometryFault, draw_fleet
from tests.examined import examined_once
from tests.quick import first_quick


@cache
def logs() -> list[tuple[MapId, ChangeBody]]:
    """Robots with one clock and a size: each may have been where another one was."""
    fleet = draw_fleet(11, SCENES["room"], OdometryFault.NONE, stops=1, views=4)
    bodies = {
        map_id: [*(NodePut(replace(node, clock="utc", radius=0.16)) for node in nodes), *map(EdgePut, edges)]
        for map_id, (nodes, edges) in fleet.maps.items()
    }
    return [(map_id, body) for map_id, some in bodies.items() for body in some]


@pytest.mark.parametrize("rule", first_quick([*TRIAL_RULES, *PLACE_RULES], 3))
def test_fleets_are_merged_and_answered_without_a_rule(rule: str, caplog):
    """None of these rules is on how nodes are compared, so each pair of them is compared once."""
    switches: tuple[Switch, ...] = {**TRIAL_RULES, **PLACE_RULES}[rule]
    merger = Merger()
    merger.read(logs())
    with examined_once(), switched_off(switches):
        merged = merger.merged()
        assert merged.links
        node = next(iter(merged.poses))
        first = merger.node(node)
        assert first is not None
        view = View(first.landmarks.pixels, first.landmarks.codes, first.camera)
        assert Answers.of(merger, merged, merger.node).relocalizer.answer(view)
    assert "the merge fails" not in caplog.text


def test_one_link_joins_two_maps_only_if_it_is_strong():
    found = by_rule(SINGLE_RULES, lambda: single_links(seed=4, count=30))
    assert found["one strong link"]["joined_alone"] < found[ALL]["joined_alone"] < found[ALL]["fleets"] == 30


def test_own_loop_closures_are_drawn_as_they_are_called():
    fleet, own, true = draw(seed=3, run=0, share=50, resumed=3)
    ways = [edge for edge in own.edges.values() if edge.kind is EdgeKind.MAPPED]
    assert len(own.nodes) - len(ways) == 4
    for edge_id, right in true.items():
        edge = own.edges[edge_id]
        off = (fleet.truth[edge.a].inverse() @ fleet.truth[edge.b]).inverse() @ edge.a_from_b.mean
        assert right == (np.hypot(off.x, off.y) < 0.2)


def test_a_robot_sends_no_loop_closure_to_where_it_was_not():
    """Nor one that is measured 10 m further on than its own poses say."""
    _, own, true = draw(seed=3, run=0, share=50, resumed=3)
    loops = [edge for edge in own.edges.values() if edge.kind is EdgeKind.LOOP]
    sent = [edge for edge in loops if would_send(own, edge)]
    assert sent and all(true[edge.id] for edge in sent)
    for edge in sent:
        further = PoseGaussian(edge.a_from_b.mean @ Pose2(10.0), edge.a_from_b.covariance)
        assert not would_send(own, replace(edge, a_from_b=further))


@pytest.mark.slow
def test_without_a_rule_on_own_loop_closures_more_is_wrong():
    found = by_rule(LOOP_RULES, lambda: own_loops(seed=4, count=1))
    assert found["own loops that agree"]["whole"]["50"]["false_loops"] > 0
    assert found[ALL]["whole"]["50"]["false_loops"] == 0
    kept = {rule: figures["whole"]["20"]["true_loops"] for rule, figures in found.items()}
    assert kept["drives against loops"] < kept[ALL] <= found[ALL]["whole"]["20"]["of_true"]


def test_without_a_rule_of_recognition_what_it_is_against_is_linked():
    found = by_rule(RECOGNITION_RULES, lambda: look_alikes(seed=4, count=12))
    assert found[ALL]["larger copy"]["wrong"] == 0 < found["depths"]["larger copy"]["wrong"]
    assert found[ALL]["picture"]["wrong"] < found["image cells"]["picture"]["wrong"]
    for figures in found.values():
        for kind, figure in figures.items():
            assert found[ALL][kind]["links"] <= figure["links"] <= figure["pairs"] == 12
            assert figure["wrong"] <= figure["links"]
    assert set(found[ALL]) == set(PAIRS)


@pytest.fixture(scope="module")
def drive() -> tuple[RobotDescription, Drive]:
    """The beginning of an exploration."""
    return recorded(5, seconds=12.0)


@pytest.mark.slow
def test_a_drive_without_faults_is_mapped_well(drive: tuple[RobotDescription, Drive]):
    found = mapped(*drive)
    assert found["edges"] > 0 and found["wrong_edges"] == 0 and found["used"] > 0.9 * found["ticks"]
    assert found["error_m"] < 0.05


@pytest.mark.parametrize("rule", first_quick(FRAME_RULES, 1))
def test_a_drive_is_mapped_without_a_rule_on_frames(rule: str, drive: tuple[RobotDescription, Drive]):
    """Without faults it is as good as with it."""
    with switched_off(FRAME_RULES[rule]):
        found = mapped(drive[0], drive[1][:60])
    assert found["wrong_edges"] == 0 and found["used"] > 50


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_spoils_images_or_wheels_and_nothing_else(fault: str, drive: tuple[RobotDescription, Drive]):
    spoiled = FAULTS[fault](drive[1], np.random.default_rng(0))
    stamps = [one.observation.stamp_ns for one in spoiled]
    assert len(set(stamps)) == len(stamps) and stamps == sorted(stamps)
    if fault == "carried":
        assert len(spoiled) > len(drive[1])
        return
    changed = [
        not np.array_equal(np.asarray(one.observation.image), np.asarray(before.observation.image))
        or one.observation.odometry != before.observation.odometry
        for one, before in zip(spoiled, drive[1], strict=True)
    ]
    assert sum(changed) > 0 and not changed[0]
    assert [one.truth for one in spoiled] == [one.truth for one in drive[1]]
