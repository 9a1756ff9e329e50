"""The verdict names its outcome, and the answer says it in words."""

from dataclasses import replace

import numpy as np
import pytest

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import Certainty, View
from mapweave.mapserver.relocalization import verdict
from mapweave.mapserver.relocalization.candidates import retrieve
from mapweave.mapserver.relocalization.relocalizer import RelocalizationSettings, Relocalizer
from mapweave.mapserver.relocalization.verdict import Outcome
from mapweave.mapserver.retrieval.ranking import Ranked
from mapweave.merge.pose_graph.merged_map import MergedMap
from synthetic.world import room, take_node, take_view

WORLD = room(0, 0, 5, 4, 600, np.random.default_rng(1))
AT, ASIDE = Pose2(2.2, 2.0, 0.2), Pose2(2.2, 2.0, 3.0)
VIEW = take_view(WORLD, AT @ Pose2(0.05, 0.0, 0.02), np.random.default_rng(4))[0]
NODE = take_node(
    WORLD, NodeId("r0", 1, 1), AT, PoseGaussian.from_sigmas(Pose2(), 0.02, 0.01), np.random.default_rng(2)
)
LEAST = RelocalizationSettings().recognition.least_inliers


class Retrieved:
    """Retrieval that finds one node, and counts how often it is asked."""

    def __init__(self, *ranked: tuple[NodeId, float]) -> None:
        self.ranked, self.asked = Ranked(ranked), 0

    def query(self, view: View, k: int = 5) -> Ranked:
        self.asked += 1
        return self.ranked


def few(count: int) -> View:
    return View(VIEW.pixels[:count], VIEW.codes[:count], VIEW.camera)


FOUND = Retrieved((NODE.id, 2.0))
OTHER_WAY = take_view(WORLD, ASIDE, np.random.default_rng(5))[0]


@pytest.mark.parametrize(
    ("view", "index", "nodes", "alone", "outcome", "words"),
    [
        (
            few(LEAST - 1),
            FOUND,
            {NODE.id: NODE},
            18,
            Outcome.FEW_FEATURES,
            f"the view has {LEAST - 1} features",
        ),
        (VIEW, Retrieved(), {}, 18, Outcome.NO_CANDIDATE, "no node of any map"),
        (VIEW, FOUND, {}, 18, Outcome.NOT_RECOGNISED, "are gone"),
        (OTHER_WAY, FOUND, {NODE.id: NODE}, 18, Outcome.NOT_RECOGNISED, f"nearest is {NODE.id}"),
        (VIEW, FOUND, {NODE.id: NODE}, 1000, Outcome.ONE_WEAK_NODE, "no other node confirms it"),
        (VIEW, FOUND, {NODE.id: NODE}, 18, Outcome.FOUND, f"landmarks of {NODE.id} agree"),
    ],
    ids=["few features", "no candidate", "gone", "not recognised", "one weak node", "found"],
)
def test_each_outcome(
    view: View,
    index: Retrieved,
    nodes: dict[NodeId, Node],
    alone: int,
    outcome: Outcome,
    words: str,
    monkeypatch,
):
    monkeypatch.setattr(verdict, "ALONE", alone)
    service = Relocalizer(index, nodes.get, MergedMap.empty())
    candidates = retrieve(view, index, LEAST)
    decided = service.selection.decide(service.registration.register(candidates))
    assert decided.outcome is outcome
    answer = service.answer(view)
    assert words in answer.reason
    assert (answer.certainty is Certainty.FOUND) == (outcome is Outcome.FOUND)
    # What lacks nothing but landmarks is named: another view may confirm it.
    assert bool(answer.candidates) == (outcome in (Outcome.FOUND, Outcome.ONE_WEAK_NODE))


def test_retrieval_is_not_asked_about_a_view_that_cannot_be_registered():
    index = Retrieved((NODE.id, 2.0))
    assert not retrieve(few(LEAST - 1), index, LEAST).ranked and not index.asked
    assert retrieve(VIEW, index, LEAST).ranked == [(NODE.id, 2.0)] and index.asked == 1


def test_an_unknown_view_looks_like_places_with_a_turn_to_each(monkeypatch):
    monkeypatch.setattr(verdict, "ALONE", 1000)
    # Turned away by so much that some of the node's landmarks are still in the image.
    aside = take_view(WORLD, AT @ Pose2(0.05, 0.0, -0.35), np.random.default_rng(4))[0]
    service = Relocalizer(FOUND, {NODE.id: NODE}.get, MergedMap.empty())
    (weak,) = service.answer(aside).similar
    assert weak.node == NODE.id and LEAST <= weak.inliers <= weak.matches
    assert weak.turn == pytest.approx(0.35, abs=0.05), "to the left, where the node looked"
    assert "second node" in weak.lacks
    (far,) = service.answer(OTHER_WAY).similar
    assert far.inliers < far.needed == LEAST and far.lacks
    assert not service.answer(few(LEAST - 1)).similar
    monkeypatch.setattr(verdict, "ALONE", 18)
    assert not service.answer(VIEW).similar, "it is found"


def test_the_reason_names_the_place_that_is_listed_first():
    twin = replace(NODE, id=NodeId("r0", 1, 3))
    nodes = {node.id: node for node in (NODE, twin)}
    found = Retrieved(*((node, 2.0) for node in nodes))
    answer = Relocalizer(found, nodes.get, MergedMap.empty()).answer(OTHER_WAY)
    first, second = answer.similar
    assert first.matches == second.matches
    assert f"nearest is {first.node}: {first.lacks}" in answer.reason
