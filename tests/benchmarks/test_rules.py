"""With each rule of the table switched off everything still runs: what takes its place fits."""

from __future__ import annotations

from dataclasses import replace

import pytest

from benchmarks.rules.switches import PLACE_RULES, TRIAL_RULES, Switch, switched_off
from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.query import View
from mapweave.mapserver.answers import Answers
from mapweave.mapserver.merging.merger import Merger
from synthetic.wrong_geometry import SCENES, OdometryFault, draw_fleet


@pytest.mark.parametrize("rule", [*TRIAL_RULES, *PLACE_RULES])
def test_fleets_are_merged_and_answered_without_a_rule(rule: str, caplog: pytest.LogCaptureFixture) -> None:
    fleet = draw_fleet(11, SCENES["room"], OdometryFault.NONE, stops=1, views=4)
    switches: tuple[Switch, ...] = {**TRIAL_RULES, **PLACE_RULES}[rule]
    merger = Merger()
    for map_id, (nodes, edges) in fleet.maps.items():
        # Robots with one clock and a size: each may have been where another one was.
        stamped = [NodePut(replace(node, clock="utc", radius=0.16)) for node in nodes]
        merger.read([(map_id, body) for body in (*stamped, *map(EdgePut, edges))])
    with switched_off(switches):
        merged = merger.merged()
        assert merged.links
        node = next(iter(merged.poses))
        first = merger.node(node)
        assert first is not None
        view = View(first.landmarks.pixels, first.landmarks.codes, first.camera)
        assert Answers.of(merger, merged, merger.node).relocalizer.answer(view)
    assert "the merge fails" not in caplog.text
