"""The event `lie`: its table, what each lie sends, and the figures of it. The run itself is a scenario."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from mapweave import Edge, EdgeKind, MapId, Pose2, PoseGaussian
from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.errors import SettingsError
from mapweave.mapserver.log.entry import ReceivedChange
from mapweave.scenarios.actions import TryLies, parse_action
from mapweave.scenarios.figures import kinds
from mapweave.scenarios.liar.lies import EVERY, UNDECIDABLE, WAYS, LieInputs, bodies, honest
from mapweave.scenarios.liar.served import accusing
from mapweave.scenarios.liar.trial import ContainmentOutcome, row
from mapweave.scenarios.lying import Lies
from synthetic.world import room, take_map

LIAR = MapId("r2", 1)
REFUSED = {
    "node at 1e9 m", "edges of 1e5 m", "covariance of zero", "covariance of 1e12", "greatest covariance",
    "edges to nowhere",
}  # fmt: skip
"""Ways of which some changes are refused one by one."""


@pytest.fixture(scope="module")
def setting() -> LieInputs:
    """Maps of three robots; the one that lies has closed a loop, too."""
    rng = np.random.default_rng(1)
    world = room(0.0, 0.0, 6.0, 5.0, 400, rng)
    tour = [Pose2(1.0 + 0.3 * k, 2.0, 0.1 * k) for k in range(10)]
    maps = {map_id: take_map(world, map_id, tour, rng) for map_id in (MapId("r0", 1), MapId("r1", 1), LIAR)}
    nodes, edges = maps.pop(LIAR)
    nodes = [replace(node, stamp_ns=node.stamp_ns + 10**12) for node in nodes]
    shared = np.array([[0, 0], [1, 1]])
    ends = nodes[0], nodes[-1]
    loop = Edge(
        edges[0].id._replace(number=1000), ends[0].id, ends[1].id,
        PoseGaussian.from_sigmas(tour[0].inverse() @ tour[-1], 0.1, 0.1), EdgeKind.LOOP, shared,
    )  # fmt: skip
    return LieInputs(LIAR, (nodes, [loop, *edges]), maps, rng)


def test_a_map_is_sent_in_the_order_of_its_drive(setting: LieInputs):
    sent = bodies(setting.own)
    known = set()
    for body in sent:
        if isinstance(body, NodePut):
            known.add(body.node.id)
        else:
            assert isinstance(body, EdgePut) and {body.edge.a, body.edge.b} <= known
    assert len(sent) == len(setting.own[0]) + len(setting.own[1])
    numbers = [body.node.id.number for body in sent if isinstance(body, NodePut)]
    assert all(a < b for a, b in pairwise(numbers))


@pytest.mark.parametrize("name", ["honest", *EVERY])
def test_each_way_is_of_legal_messages_and_differs_from_the_truth(name: str, setting: LieInputs):
    way = {**EVERY, "honest": honest}[name]
    sent = way(setting)
    read = [
        ReceivedChange.read(map_id, k, message)
        for map_id, log in sent.logs.items()
        for k, message in enumerate(log, start=1)
    ]
    refused = [one.change for one in read if isinstance(one.change, str)]
    assert bool(refused) is (name in REFUSED), refused[:3]
    assert all(map_id.agent == LIAR.agent for map_id in sent.logs)
    truth = honest(setting).logs[LIAR]
    assert (sent.logs == {LIAR: truth}) is (name == "honest")


def test_an_event_names_its_ways():
    action = parse_action("lie", {"robot": "r3", "ways": ["copied places"], "queries": 3}, "event 1")
    assert action == TryLies("r3", ("copied places",), 3)
    for table, reason in (
        ({"robot": "r3", "ways": ["politely"]}, "no way 'politely'; known are node at 1e9 m"),
        ({"robot": "r3", "queries": 0}, "queries must be a whole number, 1 to 1000; it is 0"),
    ):
        with pytest.raises(SettingsError, match=reason):
            parse_action("lie", table, "event 1")


def test_the_figures_count_the_ways_that_can_be_found_out():
    good = ContainmentOutcome(True, "map r3.1 is implausible", True, 0.01, 0, 0, True, 1.0)
    bad = ContainmentOutcome(False, "map r3.1 is implausible", False, 0.2, 3, 1, True, 1.0)
    hidden = ContainmentOutcome(False, "", False, 9.0, 12, 0, True, 1.0)
    first, second, *_ = WAYS
    lies = Lies("r3", {first: good, second: bad, next(iter(UNDECIDABLE)): hidden})
    figures = lies.figures()
    assert figures == {
        "lies": 2, "lies_not_contained": 1, "lies_not_named": 1, "lies_moved_m": 0.2,
        "lies_answers_changed": 3,
    }  # fmt: skip
    assert figures.keys() <= kinds().keys()
    assert "not in the status" in row(second, bad) and "in time" not in row(second, bad)
    assert "not all merged in time" in row(second, replace(bad, alive=False))


def test_an_accusation_counts_also_as_the_reason_of_a_split():
    """A map that was joined until its geometry was found wrong is accused in no event of its own."""
    reason = "map r3.1 contradicts r0.1 and r1.1, which agree: its geometry is wrong"
    split = f"r0.1+r1.1 and r3.1 are no longer one map: 40 links refused ({reason})"
    assert accusing(["r0.1 and r3.1 are one map now, by 2 links", split], "r3").startswith(reason)
    assert accusing([reason], "r3") == reason
    assert not accusing([split, reason], "r0")
