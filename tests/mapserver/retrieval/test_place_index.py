"""The place index against exhaustive search."""

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from mapweave.hybridmap.descriptor import decode, quantise
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Landmarks, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import View
from mapweave.mapserver.retrieval import ranking
from mapweave.mapserver.retrieval.coarse_quantizer import coarse_quantizers
from mapweave.mapserver.retrieval.compared_landmarks import MOST_LANDMARKS
from mapweave.mapserver.retrieval.inverted_file import InvertedFile
from mapweave.mapserver.retrieval.landmark_index import MOST_WITHIN, LandmarkIndexSettings
from mapweave.mapserver.retrieval.place_index import SLOT_BITS, PlaceIndex, PlaceIndexSettings
from synthetic.world import CAMERA, World, random_vectors, room, take_map, take_view
from tests.merge.pose_graph.all_pairs import overlaps

Building = tuple[World, list[Node], list[Pose2]]


@pytest.fixture(scope="module")
def building() -> Building:
    """Four rooms, six nodes in each."""
    rng = np.random.default_rng(1)
    rooms = [room(5.0 * k, 0, 5, 4, 500, rng) for k in range(4)]
    world = rooms[0] + rooms[1] + rooms[2] + rooms[3]
    tour = [
        Pose2(5.0 * r + rng.uniform(1.5, 3), rng.uniform(1.5, 2.5), k) for r in range(4) for k in range(6)
    ]
    return world, take_map(world, MapId("a", 1), tour, rng)[0], tour


def filled(nodes: list[Node], settings: PlaceIndexSettings | None = None) -> PlaceIndex:
    index = PlaceIndex(settings)
    for node in nodes:
        index.add(node)
    return index


def brute_force(nodes: list[Node], view: View, s: PlaceIndexSettings) -> dict[NodeId, float]:
    """The votes by plain loops over all descriptors of all nodes."""
    scores = dict.fromkeys((node.id for node in nodes), 0.0)
    everything = [(v, node.id) for node in nodes for v in decode(node.landmarks.codes)]
    for feature in decode(view.codes):
        nearest = sorted((float(((feature - v) ** 2).sum()), node) for v, node in everything)[: s.votes]
        best: dict[NodeId, float] = {}
        for squared, node in nearest:
            if squared < ranking.REACH**2:
                best[node] = max(best.get(node, 0.0), 1 - squared / ranking.REACH**2)
        for node, weight in best.items():
            scores[node] += weight / np.sqrt(len(best))
    return scores


def test_scores_against_brute_force(building: Building):
    world, nodes, tour = building
    few, s = nodes[:8], PlaceIndexSettings(votes=6)
    view, _ = take_view(world, tour[2], np.random.default_rng(2))
    view = View(view.pixels[:40], view.codes[:40], view.camera)
    expected = brute_force(few, view, s)
    result = filled(few, s).query(view, k=8)
    assert result
    for node, score in result:
        assert score == pytest.approx(expected[node], rel=1e-3)
    assert [node for node, _ in result] == sorted(
        (n for n in expected if expected[n] > 0), key=lambda n: -expected[n]
    )


def test_the_right_place_comes_first(building: Building):
    world, nodes, tour = building
    index, rng = filled(nodes), np.random.default_rng(3)
    first = 0
    for node, stop in zip(nodes, tour, strict=True):
        view, _ = take_view(world, stop @ Pose2(0.1, -0.1, 0.05), rng)
        first += index.query(view, 1)[0][0] == node.id
    assert first >= 22


def test_overlaps_are_those_of_the_exhaustive_table(building: Building):
    _, nodes, _ = building
    table = overlaps(nodes)
    index = filled(nodes)
    assert len(table) > 10
    for node in nodes:
        expected = {(a if b == node.id else b): v for (a, b), v in table.items() if node.id in (a, b)}
        result = index.overlaps(node, {}.get)
        assert set(result) == set(expected)
        for other, value in result.items():
            assert value == pytest.approx(expected[other], rel=1e-3)


def test_nodes_with_equal_landmarks_cost_no_more_than_others():
    """Pairs of them would grow by the square: 12 million for the third such node."""
    rng, index = np.random.default_rng(5), PlaceIndex()
    nodes = []
    for k in range(3):
        vectors = np.repeat(random_vectors(1, np.random.default_rng(6)), 2000, axis=0)
        codes = quantise(vectors + rng.normal(0.0, 0.005, vectors.shape))
        depths = np.full(2000, 2.0, np.float32)
        marks = Landmarks(np.ones((2000, 2), np.float32), codes, depths, 0.1 * depths)
        pose = PoseGaussian(Pose2(), np.zeros((3, 3)))
        nodes.append(Node(NodeId("a", 1, k), k, pose, CAMERA, marks))
        index.add(nodes[-1])
    assert len(index.landmarks) == 3 * MOST_LANDMARKS
    result = index.landmarks.within(nodes[0].landmarks.codes[:10], 0.5)
    assert result is not None and np.bincount(result[0]).max() <= MOST_WITHIN
    # The first of equals are returned: they need not be of every node.
    assert index.overlaps(nodes[2], {}.get).keys() <= {nodes[0].id, nodes[1].id}
    index.remove(nodes[1].id, nodes[1].landmarks.codes)
    assert len(index.landmarks) == 2 * MOST_LANDMARKS


def test_overlaps_of_compared_nodes_are_exact_in_a_large_fleet(building: Building):
    _, nodes, _ = building
    table, known = overlaps(nodes), {node.id: node for node in nodes}
    landmarks = LandmarkIndexSettings(exact=600)
    few, all_of_them = (
        filled(nodes, PlaceIndexSettings(landmarks=landmarks, compared=compared)) for compared in (3, 99)
    )
    assert few.landmarks.within(nodes[0].landmarks.codes, 0.5) is None
    missed = 0
    for node in nodes:
        expected = {(a if b == node.id else b): v for (a, b), v in table.items() if node.id in (a, b)}
        result = all_of_them.overlaps(node, known.get)
        assert all(result[other] == pytest.approx(expected[other], rel=1e-3) for other in result)
        missed += len(expected) - len(result)
        best = few.overlaps(node, known.get)
        assert len(best) <= 3 and best.items() <= result.items() and node.id not in best
    assert missed <= 0.1 * 2 * len(table)
    assert few.overlaps(nodes[0], {}.get) == {}


def test_added_is_found_at_once_and_removed_never(building: Building):
    world, nodes, tour = building
    index = filled(nodes[:-1])
    view, _ = take_view(world, tour[-1], np.random.default_rng(4))
    last = nodes[-1]
    assert last.id not in dict(index.query(view, 99))
    index.add(last)
    assert index.query(view, 1)[0][0] == last.id and last.id in index
    assert last.id not in dict(index.query(view, 99, exclude=[last.id]))
    index.remove(last.id)
    index.remove(last.id)
    assert last.id not in dict(index.query(view, 99)) and last.id not in index
    assert len(index.landmarks) == sum(len(node.landmarks) for node in nodes[:-1])


@pytest.mark.parametrize("exact", [100_000, 600], ids=["all are compared", "cells are searched"])
def test_what_another_robot_adds_changes_nothing_once_it_is_hidden(building: Building, exact: int):
    """However many copies of a place it adds: all nearest landmarks are copies then."""
    world, nodes, tour = building
    index = filled(nodes, PlaceIndexSettings(landmarks=LandmarkIndexSettings(exact=exact)))
    assert (index.landmarks.cells(len(index.landmarks)) == 0) == (exact == 100_000)
    views = [take_view(world, stop, np.random.default_rng(12))[0] for stop in tour[::4]]
    before = [index.query(view, 16) for view in views]
    copies = [replace(node, id=NodeId("liar", k, node.id.number)) for node in nodes[::4] for k in range(20)]
    index.extend(copies)
    assert "liar" in {node.agent for node, _ in index.query(views[0], 3)}, "as long as nothing is hidden"
    hidden = [node.id for node in copies]
    assert [index.query(view, 16, hidden) for view in views] == before


def test_adding_again_replaces(building: Building):
    _, nodes, _ = building
    index = filled(nodes)
    before = len(index.landmarks)
    index.add(nodes[3])
    assert len(index.landmarks) == before and len(index) == len(nodes)


def test_large_indexes_search_cells_and_still_find(building: Building):
    world, nodes, tour = building
    index = filled(nodes, PlaceIndexSettings(landmarks=LandmarkIndexSettings(exact=1500)))
    assert index.landmarks.cells(len(index.landmarks)) > 0
    rng = np.random.default_rng(5)
    hits = 0
    for node, stop in zip(nodes, tour, strict=True):
        view, _ = take_view(world, stop, rng)
        hits += node.id in dict(index.query(view, 3))
    assert hits >= 23
    index.remove(nodes[0].id)
    index.add(nodes[0])
    assert len(index.landmarks) == sum(len(node.landmarks) for node in nodes)


@pytest.mark.parametrize("named", ["its own", "some of them", "another's", "none"])
def test_a_removed_node_stays_removed_despite_its_landmarks(building: Building, named: str):
    nodes = building[1]
    index = PlaceIndex(PlaceIndexSettings(landmarks=LandmarkIndexSettings(exact=100)))
    index.extend(nodes)
    before, codes = len(index.landmarks), nodes[3].landmarks.codes
    known = {"its own": codes, "some of them": codes[:5], "another's": nodes[4].landmarks.codes, "none": None}
    index.remove(nodes[3].id, known[named])
    assert len(index.landmarks) == before - len(codes)
    left = np.concatenate([block.ids >> SLOT_BITS for block in index.landmarks.blocks()])
    assert len(set(left.tolist())) == len(index)


def test_nothing_is_found_in_nothing(building: Building):
    world, nodes, tour = building
    view, _ = take_view(world, tour[0], np.random.default_rng(6))
    empty = View(np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8), CAMERA)
    assert PlaceIndex().query(view) == [] and filled(nodes[:1]).query(empty) == []
    bare = Node(NodeId("a", 1, 99), 0, nodes[0].map_from_robot, CAMERA, Landmarks.empty())
    index = filled([bare])
    assert index.query(view) == [] and index.overlaps(bare, {}.get) == {} and len(index) == 1
    index.remove(bare.id)
    assert len(index) == 0


def everywhere() -> PlaceIndexSettings:
    """Cells, of which all are searched: then nothing may be missing."""
    landmarks = LandmarkIndexSettings(exact=300, probes=10_000)
    return PlaceIndexSettings(landmarks=landmarks)


def test_cells_of_which_all_are_searched_answer_like_no_cells(building: Building):
    world, nodes, tour = building
    plain, cells = filled(nodes), filled(nodes, everywhere())
    for index in (plain, cells):
        index.remove(nodes[4].id)
        index.add(nodes[7])
    assert cells.landmarks.cells(len(cells.landmarks)) > 0 and len(cells.landmarks) == len(plain.landmarks)
    for stop in tour[::5]:
        view, _ = take_view(world, stop, np.random.default_rng(7))
        one, two = plain.query(view, 6), cells.query(view, 6)
        assert [score for _, score in one] == pytest.approx([score for _, score in two], rel=1e-3)
        assert {node for node, _ in one[:3]} == {node for node, _ in two[:3]}


def test_many_at_once_equal_one_by_one(building: Building):
    world, nodes, tour = building
    one, many = filled(nodes), PlaceIndex()
    many.extend([*nodes, nodes[2]])
    view, _ = take_view(world, tour[3], np.random.default_rng(8))
    assert one.query(view, 9) == many.query(view, 9) and len(many.landmarks) == len(one.landmarks)


def small_cells(**how: int) -> PlaceIndexSettings:
    """Cells of all sizes for a few thousand landmarks: 256 up to 500, then 1024, and so on."""
    return PlaceIndexSettings(landmarks=LandmarkIndexSettings(exact=300, fill=2, **how))


def altered(nodes: list[Node], count: int) -> list[Node]:
    """Nodes of a fourth robot, which sees the same things a little differently."""
    rng, made = np.random.default_rng(13), []
    for number in range(count):
        marks = nodes[number % len(nodes)].landmarks
        codes = quantise(decode(marks.codes) + rng.normal(0, 0.05, marks.codes.shape))
        marks = replace(marks, codes=codes)
        made.append(replace(nodes[number % len(nodes)], id=NodeId("liar", 1, number + 1), landmarks=marks))
    return made


@pytest.mark.parametrize(
    "settings",
    [PlaceIndexSettings(landmarks=LandmarkIndexSettings(exact=3000)), small_cells()],
    ids=["all are compared, but for what is hidden", "smaller cells are searched, but for what is hidden"],
)
def test_what_is_hidden_does_not_decide_which_cells_are_searched(
    building: Building, settings: PlaceIndexSettings
):
    world, nodes, tour = building
    index = filled(nodes, settings)
    own = len(index.landmarks)
    liar = altered(nodes, 4 * len(nodes))
    views = [take_view(world, stop, np.random.default_rng(12))[0] for stop in tour[::3]]
    before = [index.query(view, 16) for view in views]
    index.extend(liar)
    assert index.landmarks.cells(own) != index.landmarks.cells(len(index.landmarks))
    hidden = [node.id for node in liar]
    assert [index.query(view, 16, hidden) for view in views] == before
    # Questions that hide nothing meanwhile, and more that comes, make no difference.
    index.query(views[0], 16)
    index.add(nodes[0])
    assert [index.query(view, 16, hidden) for view in views] == before


def test_the_order_of_growth_and_questions_make_no_difference(building: Building):
    world, nodes, tour = building
    at_once, grown = PlaceIndex(small_cells()), PlaceIndex(small_cells())
    at_once.extend(nodes)
    view = take_view(world, tour[0], np.random.default_rng(12))[0]
    sizes = []
    for node in reversed([*nodes, *altered(nodes, 20)]):
        grown.add(node)
        grown.query(view, 3)
        sizes.append(grown.landmarks.cells(len(grown.landmarks)))
    assert len(set(sizes)) > 2
    for node in altered(nodes, 20):
        grown.remove(node.id, node.landmarks.codes)
        assert node.id not in dict(grown.query(view, 99))
    for stop in tour[::4]:
        view = take_view(world, stop, np.random.default_rng(14))[0]
        assert dict(grown.query(view, 6)) == pytest.approx(dict(at_once.query(view, 6)), rel=1e-3)


def test_all_landmarks_are_in_cells_of_another_size(building: Building):
    """What comes and goes is in cells of all sizes that are kept; unused ones are dropped."""
    world, nodes, tour = building
    index = filled(nodes, small_cells(probes=20_000))
    liar = altered(nodes, 4 * len(nodes))
    hidden = [node.id for node in liar]
    index.extend(liar)
    view = take_view(world, tour[5], np.random.default_rng(15))[0]
    index.query(view, 3, hidden)
    index.remove(nodes[5].id, nodes[5].landmarks.codes)
    assert nodes[5].id not in dict(index.query(view, 99, hidden))
    index.add(nodes[5])
    plain = filled(nodes)
    assert dict(index.query(view, 5, hidden)) == pytest.approx(dict(plain.query(view, 5)), rel=1e-3)
    assert len(index.landmarks._kept) == 2
    index.extend(altered(nodes, 8 * len(nodes))[4 * len(nodes) :])
    assert len(index.landmarks._kept) == 1


def test_a_question_waits_while_cells_are_filled_for_another_one_and_finds_the_same(building: Building):
    world, nodes, tour = building
    index = filled(nodes, small_cells())
    liar = altered(nodes, 4 * len(nodes))
    hidden = [node.id for node in liar]
    view = take_view(world, tour[5], np.random.default_rng(15))[0]
    before = index.query(view, 9)
    index.extend(liar)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: index.query(view, 9, hidden), range(8)))
    assert found == [before] * 8


def test_fewer_cells_are_searched_when_the_smallest_are_full():
    index = PlaceIndex().landmarks
    smallest = InvertedFile(coarse_quantizers()[-1])
    assert [index.cells(n) for n in (30_000, 30_001, 102_401, 10**6, 10**7)] == [0, 256, 1024, 4096, 16384]
    assert [index._probes(n, smallest) for n in (10**6, 6_553_600, 13_107_200, 10**8)] == [10, 10, 5, 2]


def test_who_announces_a_node_does_not_wait_for_a_search(building: Building):
    _, nodes, _ = building
    index = filled(nodes[:5])
    with index.landmarks.lock.reading():
        announcing = threading.Thread(target=lambda: [index.announce(node) for node in nodes[5:]])
        announcing.start()
        announcing.join(10.0)
        assert not announcing.is_alive()
    assert nodes[-1].id in index and len(index) == len(nodes)
    assert index.overlaps(nodes[0], {}.get) == filled(nodes).overlaps(nodes[0], {}.get)


def test_a_search_waits_for_no_other(building: Building):
    world, nodes, tour = building
    index, (view, _) = filled(nodes[:5]), take_view(world, tour[0], np.random.default_rng(4))
    index.announce(nodes[5])
    with index.landmarks.lock.reading(), ThreadPoolExecutor(1) as pool:
        assert pool.submit(index.query, view, 1).result(10.0)[0][0] == nodes[0].id
        assert not pool.submit(lambda: nodes[5].id in index).result(10.0), "taken in when no search runs"
    assert nodes[5].id in index


def test_a_node_that_cannot_be_taken_in_spoils_no_search(building: Building, caplog):
    _, nodes, _ = building
    index = filled(nodes[:5])
    bad = replace(nodes[5], landmarks=None)  # type: ignore[arg-type]
    index.announce(bad)
    index.announce(nodes[6])
    assert index.overlaps(nodes[0], {}.get) == filled([*nodes[:5], nodes[6]]).overlaps(nodes[0], {}.get)
    assert f"{bad.id}" in caplog.text
