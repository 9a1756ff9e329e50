"""Stories that come after a refuted one: views may refute them, unless robots' bodies speak for them."""

import math

import numpy as np
import pytest

from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.node import Edge, EdgeKind, MapId, NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.mutual_exclusion.exclusion import clash_of, evidence_in_all
from mapweave.merge.mutual_exclusion.refutation import Refutation
from mapweave.merge.mutual_exclusion.settings import ExclusionSettings
from mapweave.merge.mutual_exclusion.suspicion import suspicion
from mapweave.merge.outlier_rejection.segmentation import fragments_of
from mapweave.merge.pose_graph.component_solver import ComponentSolver
from mapweave.merge.pose_graph.links import Link
from tests.merge.mutual_exclusion.rooms import Room, meeting

A, B = MapId("a", 1), MapId("b", 1)
SURE = np.diag([1e-3, 1e-3, 1e-3]) ** 2


@pytest.mark.parametrize("changed", [(0, 1, 2), (0, 1, 2, 3)])
def test_views_that_show_nothing_at_three_places_are_enough(changed: tuple[int, ...]) -> None:
    told = meeting(Room(), Room(changed))
    assert clash_of(*told) is None, "views alone refute no first story"
    found = suspicion(*told)
    assert found is not None and found.blank == 6 * len(changed)
    assert found.evidence > -math.log(ExclusionSettings().doubt_again)
    assert found.reason == (
        f"other links between their maps were refuted, and {found.blank} views of a and b show nothing of "
        "what the other one mapped there"
    )


@pytest.mark.parametrize("changed", [(), (2,), (0, 3)])
def test_two_places_or_less_are_not(changed: tuple[int, ...]) -> None:
    assert suspicion(*meeting(Room(), Room(changed))) is None


def test_robots_that_see_each_other_are_not_suspected() -> None:
    """Somebody has painted the walls meanwhile."""
    told = meeting(Room(), Room((0, 1, 2, 3)), looks=12, seen=True)
    assert evidence_in_all(*told) < -5.0
    assert suspicion(*told) is None
    blind = meeting(Room(), Room((0, 1, 2, 3)))
    assert evidence_in_all(*blind) == 0.0 and suspicion(*blind) is not None


def test_nothing_is_said_of_one_robot_or_of_other_hours() -> None:
    graph, first, _ = meeting(Room(), Room((0, 1, 2, 3)))
    assert suspicion(graph, first, first) is None
    assert suspicion(*meeting(Room(), Room((0, 1, 2, 3)), late=4000.0)) is None


def test_only_where_another_story_was_refuted() -> None:
    """The same link, believed at first, and refused after others between the two maps have been refuted."""
    graph, first, second = meeting(Room(), Room((0, 1, 2)))
    maps: dict[MapId, HybridMap] = {}
    for one, trail in ((A, first), (B, second)):
        maps[one] = HybridMap([NodePut(node) for node in trail.views])
        for k, (a, b) in enumerate(zip(trail.views, trail.views[1:], strict=False)):
            between = graph.pose(a.id).inverse() @ graph.pose(b.id)
            edge = Edge(NodeId(*one, 100 + k), a.id, b.id, PoseGaussian(between, SURE), EdgeKind.TURNED)
            maps[one].apply(EdgePut(edge))
    ends = first.views[0].id, second.views[0].id
    link = Link(*ends, PoseGaussian(Pose2(0.5, 0.0, 0.0), SURE), np.zeros((9, 2), np.int64), {})
    fragments = fragments_of(maps)
    solved = ComponentSolver(fragments).solve([link])
    refutation = Refutation(maps, fragments, ExclusionSettings())
    assert refutation.impossible(solved, [link], ()) == {}
    key = refutation.key_of(link)
    found = refutation.impossible(solved, [link], {key})
    assert set(found) == {key} and "other links between their maps were refuted" in found[key]
