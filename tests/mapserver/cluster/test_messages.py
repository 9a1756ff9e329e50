"""Messages of the cluster: what arrives is what was sent, and nothing else is taken."""

import pickle
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import cache
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.errors import InvalidMessage, MapweaveError
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.landmark_tables import SYMBOLS
from mapweave.hybridmap.limits import MAX_LANDMARKS, MAX_NUMBER
from mapweave.hybridmap.node import CODE_BYTES, Landmarks, Node
from mapweave.mapserver.cluster.frames import GatewayReply, GatewayRequest
from mapweave.mapserver.cluster.messages import (
    MOST_BYTES,
    Ask,
    ComparedNodes,
    Comparison,
    ComparisonAnswer,
    Hello,
    Ids,
    Nearest,
    NearestAnswer,
    Overlaps,
    OverlapsAnswer,
    Question,
    Reset,
    ShardChange,
    ShardRequest,
    State,
    answer_message,
    answer_to,
    decoded,
    encoded,
)
from mapweave.mapserver.cluster.shard import Shard, ShardServer
from mapweave.mapserver.cluster.shard_link import AT_ONCE
from mapweave.mapserver.cluster.work import answer_work
from mapweave.mapserver.merging.node_comparisons import compare
from mapweave.mapserver.retrieval.compared_landmarks import MOST_LANDMARKS
from mapweave.mapserver.retrieval.landmark_index import LandmarkIndexSettings
from mapweave.mapserver.retrieval.place_index import PlaceIndexSettings
from mapweave.mapserver.retrieval.ranking import NearestLandmarks
from mapweave.merge.pose_graph.links import Link
from synthetic.building import Building

NODES = [
    change.node
    for robot in range(2)
    for _, change in Building.draw(2, 8, 1).log(robot)
    if isinstance(change, NodePut)
]
PAIRS = [*combinations(NODES, 2)]
SERVER = ShardServer()
STATE = replace(SERVER._state, number=1)
SHARD = Shard()
SHARD.change(NODES)
NEAREST, OVERLAPS = Nearest(NODES[3].landmarks.codes, 16, 1000), Overlaps(ComparedNodes.of([NODES[5]]))


def same_landmarks(one: Landmarks, other: Landmarks) -> bool:
    columns = ("pixels", "codes", "depths", "depth_sigmas")
    return all(
        getattr(one, name).tobytes() == getattr(other, name).tobytes()
        and getattr(one, name).dtype == getattr(other, name).dtype
        for name in columns
    )


def test_nodes_arrive_bit_by_bit():
    other_camera = replace(NODES[1], camera=replace(NODES[1].camera, fx=300.1))
    empty = replace(NODES[2], landmarks=Landmarks.empty())
    for nodes in (NODES, [NODES[0], other_camera, empty, NODES[3]], [empty], []):
        gone = (NODES[4].id, NODES[0].id)[: len(nodes)]
        read = decoded(encoded(ShardChange(STATE, ComparedNodes.of(nodes), Ids.of(gone))), ShardRequest)
        assert isinstance(read, ShardChange) and (read.state, read.gone.nodes) == (STATE, gone)
        for one, node in zip(read.nodes.nodes, nodes, strict=True):
            assert (one.id, one.camera) == (node.id, node.camera)
            assert same_landmarks(one.landmarks, node.landmarks)
    assert isinstance(decoded(encoded(Hello()), ShardRequest), Hello)
    assert isinstance(decoded(encoded(Reset()), ShardRequest), Reset)


def test_answers_arrive_as_they_are():
    nearest = SHARD.answer(decoded(encoded(NEAREST), Question))
    assert isinstance(nearest, NearestLandmarks)
    read = answer_to(NEAREST, encoded(answer_message(nearest)))
    assert isinstance(read, NearestLandmarks)
    assert read.nodes == nearest.nodes and len(read.nodes)
    assert np.array_equal(read.squared, nearest.squared) and np.array_equal(read.owners, nearest.owners)
    overlaps = SHARD.answer(decoded(encoded(OVERLAPS), Question))
    assert isinstance(overlaps, dict) and overlaps == SHARD.overlaps(NODES[5])
    assert answer_to(OVERLAPS, encoded(answer_message(overlaps))) == overlaps and overlaps
    empty_shard = Shard().nearest(NEAREST.codes, 16, 1000)
    read = answer_to(NEAREST, encoded(answer_message(empty_shard)))
    assert isinstance(read, NearestLandmarks) and read.nodes == () and len(read.squared) == len(NEAREST.codes)
    assert answer_to(OVERLAPS, encoded(answer_message({}))) == {}


def test_verdicts_arrive_as_they_are():
    pairs = PAIRS[:40]
    found, expected = decoded(answer_work(encoded(Comparison.of(pairs))), ComparisonAnswer), [*compare(pairs)]
    links = 0
    for one, other in zip(found.verdicts_on(pairs), expected, strict=True):
        assert (type(one), one.a, one.b) == (type(other), other.a, other.b)
        if isinstance(one, Link) and isinstance(other, Link):
            links += 1
            assert one.a_from_b.mean == other.a_from_b.mean and one.evidence == other.evidence
            assert np.array_equal(one.a_from_b.covariance, other.a_from_b.covariance)
            assert np.array_equal(one.shared, other.shared)
        else:
            assert one.reason == other.reason  # type: ignore[union-attr]
    assert links


def large(name: str, count: int) -> Node:
    """A node with the longest name and so many landmarks."""
    rng = np.random.default_rng(1)
    landmarks = Landmarks(
        rng.uniform(0.0, 300.0, (count, 2)).astype(np.float32),
        rng.integers(0, SYMBOLS, (count, CODE_BYTES)).astype(np.uint8),
        np.ones(count, np.float32),
        np.ones(count, np.float32),
    )
    return replace(NODES[0], id=NodeId(name * 32, MAX_NUMBER, MAX_NUMBER), landmarks=landmarks)


def test_the_longest_messages_that_there_may_be_are_taken():
    node = large("a", MAX_LANDMARKS)
    some = [replace(node, id=NodeId(f"{k:032}", MAX_NUMBER, MAX_NUMBER)) for k in range(AT_ONCE)]
    change = encoded(ShardChange(STATE, ComparedNodes.of(some), Ids.of(one.id for one in some)))
    assert len(decoded(change, ShardRequest).nodes.nodes[-1].landmarks) == MOST_LANDMARKS
    votes = PlaceIndexSettings().votes
    question = Nearest(node.landmarks.codes, votes, 1 << 40)
    owners = np.arange(MAX_LANDMARKS * votes).reshape(-1, votes)
    nodes = tuple(NodeId(f"{k:032}", MAX_NUMBER, MAX_NUMBER) for k in range(owners.size))
    nearest = NearestLandmarks(np.zeros(owners.shape, np.float32), owners, nodes)
    answer = encoded(answer_message(nearest))
    read = answer_to(question, answer)
    assert isinstance(read, NearestLandmarks) and len(read.nodes) == owners.size
    exact = LandmarkIndexSettings().exact
    overlaps = encoded(answer_message(dict.fromkeys(nodes[:exact], 0.3)))
    assert len(answer_to(OVERLAPS, overlaps)) == exact
    assert max(map(len, (change, answer, overlaps))) < MOST_BYTES


def test_too_long_a_message_is_refused_before_it_is_read():
    with pytest.raises(InvalidMessage, match="bytes, at most"):
        decoded(bytes(MOST_BYTES + 1), ShardRequest)


def test_nothing_is_unpickled():
    class Run:
        def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
            return pytest.fail, ("it ran",)

    for message in (pickle.dumps(Run()), pickle.dumps(("hello", ()))):
        for answered in (ShardServer().call, answer_work):
            with pytest.raises(InvalidMessage):
                answered(message)
        for kind in (State, ComparisonAnswer, Question, NearestAnswer, OverlapsAnswer):
            with pytest.raises(InvalidMessage):
                decoded(message, kind)


def changed(message: object, old: NDArray[Any], new: NDArray[Any]) -> bytes:
    """A message with other numbers than the sender would take: of the same kind and shape."""
    data = encoded(message)
    assert data.count(old.tobytes()) == 1 and (old.shape, old.dtype) == (new.shape, new.dtype)
    return data.replace(old.tobytes(), new.tobytes())


def answered() -> NearestAnswer:
    nearest = SHARD.answer(NEAREST)
    assert isinstance(nearest, NearestLandmarks)
    answer = answer_message(nearest)
    assert isinstance(answer, NearestAnswer)
    return answer


@pytest.mark.parametrize("owner", [-2, 99])
def test_an_answer_of_owners_that_are_not_there_is_refused(owner: int):
    answer = answered()
    wrong = answer.owners.copy()
    wrong[1, 2] = owner
    with pytest.raises(InvalidMessage, match="a number that is not from -1"):
        answer_to(NEAREST, changed(answer, answer.owners, wrong))


def test_an_answer_about_other_features_is_refused():
    answer = answered()
    fewer = replace(answer, owners=answer.owners[1:], squared=answer.squared[1:])
    with pytest.raises(InvalidMessage, match="other features"):
        answer_to(NEAREST, encoded(fewer))


def test_verdicts_on_other_pairs_are_none():
    pairs = next([p] for p in PAIRS if isinstance(next(iter(compare([p]))), Link))
    answer = ComparisonAnswer.of(compare(pairs))
    (link,) = answer.verdicts
    assert len(answer.verdicts_on([pairs[0][::-1]])) == 1
    others = next([p] for p in PAIRS if p[0].id != pairs[0][0].id)
    for asked in (pairs * 2, [], others):
        with pytest.raises(InvalidMessage, match="other pairs"):
            answer.verdicts_on(asked)
    for row in (-1, len(pairs[0][0].landmarks)):
        wrong = replace(link, shared=np.array([[row, 0]]))  # type: ignore[type-var]
        with pytest.raises(InvalidMessage, match="a number that is not from 0"):
            ComparisonAnswer((wrong,)).verdicts_on(pairs)


@pytest.mark.parametrize("row", [-1, 2])
def test_a_comparison_of_a_node_that_is_not_there_is_refused(row: int):
    comparison = Comparison.of(PAIRS[:1])
    message = changed(comparison, comparison.pairs, np.array([[0, row]]))
    with pytest.raises(InvalidMessage, match="a number that is not from 0 to 1"):
        answer_work(message)


def test_codes_that_are_none_are_refused():
    wrong = NEAREST.codes.copy()
    wrong[0, 0] = SYMBOLS
    message = changed(NEAREST, NEAREST.codes, wrong)
    with pytest.raises(InvalidMessage, match="a number that is not from 0 to 63"):
        decoded(message, Question)
    codes = OVERLAPS.nodes.landmarks.codes
    wrong = codes.copy()
    wrong[-1, -1] = 255
    message = changed(OVERLAPS, codes, wrong)
    with pytest.raises(InvalidMessage, match="a number that is not from 0 to 63"):
        decoded(message, Question)


def test_columns_of_nodes_that_do_not_belong_together_are_refused():
    nodes = ComparedNodes.of(NODES[:3])
    change = ShardChange(STATE, nodes, Ids.of([]))
    for ends, words in (
        (nodes.ends + 1, "do not belong together"),
        (nodes.ends[::-1].copy(), "a number that is not from 0"),
        (nodes.ends - nodes.ends[0] - 1, "a number that is not from 0"),
    ):
        with pytest.raises(InvalidMessage, match=words):
            decoded(changed(change, nodes.ends, ends), ShardRequest)
    for place, number in ((0, 1), (0, -1), (1, -1)):
        wrong = nodes.ids.rows.copy()
        wrong[0, place] = number
        with pytest.raises(InvalidMessage, match="a number that is not from 0"):
            decoded(changed(change, nodes.ids.rows, wrong), ShardRequest)
    with pytest.raises(InvalidMessage, match="overlaps of 3 nodes"):
        Overlaps(nodes)


@cache
def samples() -> list[tuple[bytes, Callable[[bytes], object]]]:
    """Messages, and what reads each."""
    return [
        (encoded(ShardChange(STATE, ComparedNodes.of(NODES[:2]), Ids.of([NODES[0].id]))), SERVER.call),
        (encoded(Ask(State(SERVER._state.incarnation, 0), encoded(NEAREST))), SERVER.call),
        (encoded(NEAREST), lambda data: SHARD.answer(decoded(data, Question))),
        (encoded(OVERLAPS), lambda data: SHARD.answer(decoded(data, Question))),
        (encoded(answered()), lambda data: answer_to(NEAREST, data)),
        (encoded(answer_message(SHARD.overlaps(NODES[5]))), lambda data: answer_to(OVERLAPS, data)),
        (encoded(STATE), lambda data: decoded(data, State)),
        (
            encoded(ComparisonAnswer.of(compare(PAIRS[:4]))),
            lambda data: decoded(data, ComparisonAnswer).verdicts_on(PAIRS[:4]),
        ),
        (encoded(Comparison.of(PAIRS[:2])), lambda data: decoded(data, Comparison).node_pairs()),
        (GatewayRequest(7, 2, b"abc").packed(), GatewayRequest.read),
        (GatewayReply(7, words="it failed").packed(), GatewayReply.read),
    ]  # fmt: skip


@settings(max_examples=300, deadline=None)
@given(
    which=st.deferred(lambda: st.integers(0, len(samples()) - 1)),
    changes=st.lists(st.tuples(st.floats(0.0, 1.0, exclude_max=True), st.integers(0, 255)), max_size=4),
    length=st.floats(0.0, 1.0) | st.just(1.0),
)
def test_a_damaged_message_is_taken_or_refused(which: int, changes: list[tuple[float, int]], length: float):
    """Nothing but a MapweaveError comes of it."""
    sample, read = samples()[which]
    data = bytearray(sample)
    for place, value in changes:
        data[int(place * len(data))] = value
    with suppress(MapweaveError):
        read(bytes(data[: int(length * len(data))]))


def test_frames_arrive_as_they_were_sent():
    for request in (GatewayRequest(2**40, -1, b""), GatewayRequest(1, 3, b"\0\1")):
        assert GatewayRequest.read(request.packed()) == request
    for reply in (
        GatewayReply(2**40),
        GatewayReply(0, b"\0\1"),
        GatewayReply(1, words="nothing listens at ü"),
    ):
        assert GatewayReply.read(reply.packed()) == reply
    for read in (GatewayRequest.read, GatewayReply.read):
        with pytest.raises(InvalidMessage, match="at least"):
            read(b"short")
