"""A large island is decided again as a whole beside its steps, and catches up with what came meanwhile."""

from __future__ import annotations

import threading

import pytest

from merge.incremental.islands import Islands
from merge.incremental.settings import StepSettings
from tests.merge.lives import DENSE, Life, polished

NEVER_WHOLE = StepSettings(anew_up_to=0, whole_up_to=0)


@pytest.mark.parametrize(("seed", "false_share"), [(0, 0.0), (1, 0.3), (2, 0.3), (3, 0.5)])
def test_what_is_decided_again_is_the_merge_made_anew(seed: int, false_share: float) -> None:
    life, islands = Life(seed, false_share), Islands(steps=NEVER_WHOLE)
    for _ in range(50):
        life.step()
        islands.merge(life.maps, life.verdicts, life.touched, life.rulings)
        life.touched = set()
    again = islands.again(life.maps, life.verdicts)
    rounds = 0
    while again is not None:
        # One island after the other.
        again.run()
        merged = islands.merge(life.maps, life.verdicts, set(), life.rulings)
        again, rounds = islands.again(life.maps, life.verdicts), rounds + 1
    assert rounds
    anew = life.anew()
    assert [link.pair for link in merged.links] == [link.pair for link in anew.links]
    assert set(merged.components) == set(anew.components)
    assert {(r.pair, r.edge) for r in merged.refused} == {(r.pair, r.edge) for r in anew.refused}
    for node, pose in polished(merged, anew).items():
        assert merged.pose(node).distance(pose) < 1e-6


def test_steps_go_on_meanwhile_and_what_came_is_caught_up_with() -> None:
    life, islands = Life(10, 0.0, DENSE), Islands(steps=NEVER_WHOLE)
    for _ in range(45):
        life.step(quiet=True)
        islands.merge(life.maps, life.verdicts, life.touched, life.rulings)
        life.touched = set()
    again = islands.again(life.maps, life.verdicts)
    assert again is not None and islands.again(life.maps, life.verdicts) is None, "one at a time"
    thread = threading.Thread(target=again.run)
    thread.start()
    for _ in range(10):
        life.step(quiet=True)
        merged = islands.merge(life.maps, life.verdicts, life.touched, life.rulings)
        assert set(merged.postures) == {node for one in life.maps.values() for node in one.nodes}
        life.touched = set()
    thread.join()
    islands.merge(life.maps, life.verdicts, set(), life.rulings)
    assert not islands.decided
    merged, anew = islands.merge(life.maps, life.verdicts, set(), life.rulings), life.anew()
    assert set(merged.components) == set(anew.components)
    one, two = ({link.pair for link in links} for links in (merged.links, anew.links))
    assert len(two) > 150 and len(one ^ two) <= 0.03 * len(two)
    for node in anew.postures:
        assert merged.pose(node).distance(anew.pose(node)) < 0.05
