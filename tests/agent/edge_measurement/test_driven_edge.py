"""A drive writes back what it measured: how surely, how often, and what becomes of drives that disagree."""

from dataclasses import replace

import numpy as np
import pytest

from mapweave import Camera, Edge, EdgeKind, HybridMap, MapId, NodeId, Pose2, PoseGaussian
from mapweave.agent.edge_measurement.driven_edge import driven_edge
from mapweave.agent.edge_measurement.traverse import Traverse
from mapweave.agent.mapping.mapper import Mapper
from mapweave.agent.mission import GoTo, ServerAnswer
from mapweave.agent.observation import Observation, Odometry, RobotDescription
from mapweave.agent.pipeline import Pipeline
from mapweave.hybridmap.change import Change, EdgePut
from mapweave.mapserver.merging.merger import Merger
from mapweave.wire.codec import decode_body, encode_body

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.3)
REACH = 1.0
BEARINGS = tuple(np.linspace(-np.pi, np.pi, 16, endpoint=False))
ROBOT = RobotDescription(camera=CAMERA, ranger_bearings=BEARINGS, ranger_reach=REACH)
"""With rangers: without any it drives more slowly."""
FREE = np.full(len(BEARINGS), REACH)
MAP = MapId("r0", 1)
A, B, ELSEWHERE = NodeId("r0", 1, 1), NodeId("r0", 1, 2), NodeId("r1", 1, 7)
TRUE = Pose2(0.8, 0.1, 0.05)
SIGMAS = np.array([0.02, 0.01, 0.01])
CERTAIN = 16.27
"""99.9 % of chi-square with 3 degrees of freedom."""


def measured(start: NodeId, end: NodeId, start_from_end: Pose2, landmarks: int = 9) -> Traverse:
    return Traverse(start, end, PoseGaussian(start_from_end, np.diag(SIGMAS**2)), landmarks)


class Notebook:
    """A map into which traverses are written."""

    def __init__(self) -> None:
        self.map = HybridMap()
        self.numbers = iter(range(100, 200))

    def note(self, *traverses: Traverse) -> Edge:
        for traverse in traverses:
            edge = driven_edge(self.map, traverse, lambda: NodeId(*MAP, next(self.numbers)))
            self.map.apply(EdgePut(edge))
        return edge


def test_drives_both_ways_make_one_edge_with_counts():
    book = Notebook()
    there, back = measured(A, B, TRUE, 12), measured(B, A, TRUE.inverse(), 8)
    edge = book.note(there, back, there)
    assert (edge.a, edge.b, edge.kind) == (A, B, EdgeKind.DRIVEN)
    assert edge.evidence == {"there": 2.0, "back": 1.0, "inliers": 12.0}
    assert list(book.map.edges) == [NodeId(*MAP, 100)], "one id, and none drawn for nothing"
    assert edge.a_from_b.mean.vector == pytest.approx(TRUE.vector, abs=1e-9)


def test_an_edge_between_nodes_of_others_has_an_id_of_the_own_map():
    edge = Notebook().note(measured(ELSEWHERE, A, TRUE))
    assert edge.id.map == MAP and (edge.a, edge.b) == (A, ELSEWHERE)
    assert edge.a_from_b.mean.vector == pytest.approx(TRUE.inverse().vector)
    assert edge.evidence["back"] == 1.0
    assert encode_body(decode_body(encode_body(EdgePut(edge)))) == encode_body(EdgePut(edge))


def test_many_drives_err_less_without_overconfidence():
    """Half of each drive's error is the landmarks', and so the same in all drives."""
    rng, nees, ratio = np.random.default_rng(5), [], []
    for _ in range(200):
        common = rng.normal(0, SIGMAS / np.sqrt(2))
        drives = [TRUE @ Pose2.from_vector(common + rng.normal(0, SIGMAS / np.sqrt(2))) for _ in range(6)]
        edge = Notebook().note(*(measured(A, B, drive) for drive in drives))
        nees.append(edge.a_from_b.mahalanobis2(TRUE))
        ratio.append(edge.a_from_b.mean.distance(TRUE) / drives[0].distance(TRUE))
        assert edge.a_from_b.covariance == pytest.approx(np.diag(SIGMAS**2), rel=0.05, abs=1e-6)
    assert np.mean(nees) < 3.0
    assert np.median(ratio) < 0.95


def test_of_drives_that_contradict_each_other_the_majority_counts():
    right, wrong = measured(A, B, TRUE), measured(A, B, TRUE @ Pose2(0.5))
    book = Notebook()
    assert book.note(right, right, wrong).a_from_b.mean.distance(TRUE) < 1e-9
    assert book.note(right).evidence["there"] == 2.0
    book = Notebook()
    first = book.note(wrong)
    edge = book.note(right)
    assert edge.id == first.id and edge.a_from_b.mean.distance(TRUE) < 1e-9
    assert edge.evidence["there"] == 1.0


# A robot drives


@pytest.fixture(scope="module")
def two_nodes(walls) -> HybridMap:
    """A at the origin, B 0.8 m ahead."""
    mapper = Mapper(MAP, ROBOT)
    there, before = np.arange(0.0, 0.81, 0.025), Pose2()
    for tick, x in enumerate([*there, *there[::-1]]):
        observation = walls.observe(before, Pose2(x), tick)
        mapper.step(observation)
        if not mapper.started:
            mapper.begin(observation)
        if tick == len(there) - 1:
            mapper.add_view(observation)
        before = Pose2(x)
    mapper.finish(observation)
    for nodes in (1, 2):
        mapper.step(replace(observation, odometry=Odometry(0.0, 0.0)))  # a view becomes a node in each
        assert len(mapper.map.nodes) == nodes
    return mapper.map


def drive(pipeline: Pipeline, walls, begin: Pose2, goal: NodeId, slip: float) -> tuple[Pose2, list[EdgePut]]:
    """Drive to a goal without any server; the wheels say `slip` too much. Returns the end and the changes."""
    pose, odometry = begin, Odometry(0.0, 0.0)
    changes: list[EdgePut] = []
    pipeline.set_mission(GoTo(goal))
    answers: tuple[ServerAnswer, ...] = ()
    for tick in range(600):
        step = pipeline.step(Observation(tick * 100_000_000, odometry, walls.render(pose), FREE), answers)
        answers = tuple(ServerAnswer(question.number, None, "no server") for question in step.questions)
        changes += [change for change in step.changes if isinstance(change, EdgePut)]
        if step.status.finished:
            return pose, changes
        moved = Odometry(step.command.forward * ROBOT.tick, step.command.turn * ROBOT.tick)
        pose = pose @ moved.motion()
        odometry = Odometry(moved.forward * (1 + slip), moved.turn * (1 + slip))
    raise AssertionError(f"not there: {step.status.doing}; {step.status.detail}")


@pytest.mark.slow
@pytest.mark.parametrize(("begin", "slip"), [(Pose2(0.1, -0.05), -0.02), (Pose2(-0.3, 0.05, 0.05), 0.0)])
def test_a_robot_that_drives_to_and_fro_measures_the_edge_both_ways(walls, two_nodes, begin, slip):
    """What it measured is as near to the truth as it says, and the server takes it into the merged map."""
    a, b = sorted(two_nodes.nodes)
    truth = {a: Pose2(), b: Pose2(0.8)}
    contents = list(two_nodes.contents())
    before = set(two_nodes.edges)
    pipeline = Pipeline(MAP, ROBOT, contents=contents, next_number=max(*two_nodes.nodes, *before).number + 1)
    pose, there = drive(pipeline, walls, begin, b, slip)
    pose, back = drive(pipeline, walls, pose, a, slip)
    assert pose.distance(truth[a]) < 0.02
    assert [change.edge.evidence["there"] for change in there] == [1.0]
    [last] = back
    edge = last.edge
    assert (edge.kind, edge.a, edge.b) == (EdgeKind.DRIVEN, a, b) and edge.id not in before
    assert edge.evidence["back"] == 1.0 and edge.evidence["inliers"] >= 4
    assert pipeline.map.edges[edge.id] is edge
    for item in (there[0].edge, edge):
        assert item.a_from_b.mahalanobis2(truth[b]) < CERTAIN
        assert item.a_from_b.mean.distance(truth[b]) < 0.05
        assert np.sqrt(item.a_from_b.covariance[0, 0]) < 0.05
    merger = Merger()
    for sequence, body in enumerate([*contents, *there, *back], start=1):
        merger.on_change(Change(MAP, sequence, 0, body))
    merged = merger.merged()
    assert not merged.refused and edge.id in merged.union().edges
    relative = merged.relative(a, b)
    assert relative is not None and relative.mean.distance(truth[b]) < 0.02
