"""A year of drives, shortened: the stage is what it says, and both ways of merging find the same."""

import numpy as np
from rich.console import Console

from benchmarks.life_year.benchmark import run
from mapweave.hybridmap.node import NodeId
from mapweave.hybridmap.pose import Pose2
from synthetic.drives import DriveSettings, drives
from synthetic.fleet import FleetSettings


def test_links_lead_to_active_nodes() -> None:
    settings = DriveSettings(FleetSettings(nodes=30, side=6.0), false_share=0.3)
    days, before = drives(np.random.default_rng(1), settings), frozenset[NodeId]()
    seen: dict[NodeId, Pose2] = {}
    for _, today in zip(range(6), days, strict=False):
        seen |= today.truth
        assert before <= today.past <= seen.keys()
        for link in today.links:
            a, b = link.pair
            assert not before & {a, b} and a < b and b.map == today.map_id
            off = (seen[a].inverse() @ seen[b]).inverse() @ link.a_from_b.mean
            assert (off.distance(Pose2()) < 0.3) == (link.pair in today.true)
        before = today.past
    assert len(before) > 60


def test_both_ways_of_merging_find_the_same() -> None:
    figures = run(7, 2, 0.0, 30, alone=False, console=Console(quiet=True))
    assert figures["components"] == figures["fresh_components"] == 1
    assert figures["links_apart"] == figures["links_false"] == figures["links_missed"] == 0
    assert figures["active_error_m"] < 0.2
