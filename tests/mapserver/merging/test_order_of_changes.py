"""The merged map depends on the record alone, not on the order and the steps in which its changes came."""

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.change import Change, ChangeBody, NodePut, NodeRetired
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.node import Node
from mapweave.mapserver.merging import node_comparisons
from mapweave.mapserver.merging.merger import Merger
from mapweave.merge.outlier_rejection import wrong_geometry
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.verdicts import Verdict
from mapweave.scenarios.liar import lies
from mapweave.scenarios.liar.lies import LieInputs, bodies
from mapweave.wire.codec import decode_change
from synthetic.wrong_geometry import ODD, SCENES, OdometryFault, draw_fleet
from tests.quick import first_quick

SEED = 3
Record = Mapping[MapId, Sequence[ChangeBody]]
_verdicts: dict[tuple[int, int], tuple[Node, Node, Verdict]] = {}


def compare(pairs: Sequence[tuple[Node, Node]]) -> Iterator[Verdict]:
    """As a server does, each pair once for all mergers."""
    for a, b in pairs:
        if (id(a), id(b)) not in _verdicts:
            _verdicts[id(a), id(b)] = a, b, next(iter(node_comparisons.compare([(a, b)])))
        yield _verdicts[id(a), id(b)][2]


@cache
def record(way: str) -> Record:
    """Three robots and one that lies; each puts a node again, and gives one up."""
    fleet = draw_fleet(SEED, SCENES["room"], OdometryFault.NONE, stops=1, views=5)
    sound = {map_id: content for map_id, content in fleet.maps.items() if map_id != ODD}
    rng = np.random.default_rng(SEED)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lies, "EPOCHS", 8)
        lie = lies.EVERY[way](LieInputs(ODD, fleet.maps[ODD], sound, rng))
    logs = {map_id: bodies(content) for map_id, content in sound.items()}
    logs |= {map_id: [decode_change(message).body for message in log] for map_id, log in lie.logs.items()}
    out: dict[MapId, list[ChangeBody]] = {}
    for map_id, log in logs.items():
        nodes = [body.node for body in log if isinstance(body, NodePut)]
        again: list[ChangeBody] = [NodePut(nodes[2]), NodeRetired(nodes[-1].id)] if len(nodes) > 4 else []
        out[map_id] = log + again
    return out


def contents(merged: MergedMap) -> dict[str, Any]:
    """All that is decided."""
    return {
        "links": [link.pair for link in merged.links],
        "refused": [(r.pair, r.reason, r.edge) for r in merged.refused],
        "components": merged.components,
        "frames": [graph.anchor for graph in merged.graphs],
        "accusations": merged.accusations(),
    }


@cache
def fresh_merge(way: str) -> tuple[dict[str, Any], MergedMap]:
    """The merge of a restarted server."""
    merger = Merger(compare=compare)
    merger.read([(map_id, body) for map_id, log in record(way).items() for body in log])
    merged = merger.merged()
    return contents(merged), merged


def in_steps(way: str, order: Sequence[int], steps: Sequence[int]) -> MergedMap:
    """The merge of a server to which changes come.

    Args:
        way: to lie.
        order: of the logs in turns, each number one of those of which changes are left.
        steps: so many changes come between two merges, again and again.
    """
    left = {map_id: list(log) for map_id, log in record(way).items()}
    merger, count, wait = Merger(compare=compare), 0, list(steps)
    while left:
        which = sorted(left)[order[count % len(order)] % len(left)]
        merger.on_change(Change(which, count + 1, 0, left[which].pop(0)))
        if not left[which]:
            del left[which]
        count += 1
        wait[0] -= 1
        if not wait[0]:
            merger.merged()
            wait = [*wait[1:], steps[0]] if len(wait) > 1 else list(steps)
    return merger.merged()


WAYS = ["altered copies that tear", "places seen from aside", "altered copied places", "shuffled maps"]


@pytest.mark.parametrize("way", first_quick(WAYS, 0))
@settings(max_examples=3, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    order=st.lists(st.integers(0, 23), min_size=1, max_size=40),
    steps=st.lists(st.integers(5, 60), min_size=1, max_size=3),
)
# With shuffled maps, the last merge takes nodes in again that were never compared with newer ones.
@example(order=[0, 13, 0, 14, 0, 0, 0, 0, 17, 2, 11, 0, 11, 0], steps=[42])
def test_a_merge_in_steps_is_the_merge_of_the_record(
    way: str, order: list[int], steps: list[int], monkeypatch
):
    # Few links are tested of many, as in a large map.
    monkeypatch.setattr(wrong_geometry, "MOST_LINKS", 12)
    expected, fresh = fresh_merge(way)
    merged = in_steps(way, order, steps)
    found = contents(merged)
    for name, value in expected.items():
        assert found[name] == value, name
    for node in fresh.poses:
        assert merged.pose(node).distance(fresh.pose(node)) < 1e-9
