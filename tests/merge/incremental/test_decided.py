"""What was decided of a large island outlives the process: another one begins from it."""

from __future__ import annotations

import pytest

from merge.graph.merged import MergedMap
from merge.incremental.decided import Decided
from merge.incremental.islands import Islands
from merge.incremental.pools import Pools
from merge.incremental.settings import StepSettings
from tests.merge.lives import DENSE, Life

LARGE = StepSettings(anew_up_to=0, whole_up_to=0)


def lived(seed: int, false_share: float) -> tuple[Life, Islands, MergedMap]:
    life, islands = Life(seed, false_share, DENSE), Islands(steps=LARGE)
    for _ in range(55):
        life.step(quiet=True)
        merged = islands.merge(life.maps, life.verdicts, life.touched, life.rulings)
        life.touched = set()
    return life, islands, merged


@pytest.mark.parametrize(("seed", "false_share"), [(0, 0.0), (1, 0.3), (2, 0.5)])
def test_who_resumes_believes_the_same(
    seed: int, false_share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    life, islands, before = lived(seed, false_share)
    again = Islands(steps=LARGE)
    again.resume(islands.decisions())
    joins: list[int] = []
    real = Pools.next

    def counted(self: Pools, *args: object) -> object:
        chosen, found = real(self, *args)  # type: ignore[arg-type]
        joins.append(len(chosen))
        return chosen, found

    monkeypatch.setattr(Pools, "next", counted)
    after = again.merge(life.maps, life.verdicts.copy(), set(life.maps), life.rulings)
    assert not sum(joins), "what is one map is not joined again"
    assert set(after.components) == set(before.components)
    one, two = ({link.pair for link in merged.links} for merged in (before, after))
    assert len(two) > 60 and one <= two, "what was believed stands"
    # Links that were refused are heard once more by all that came after them.
    assert len(two - one) <= 0.03 * len(one)
    for node in before.postures:
        assert after.pose(node).distance(before.pose(node)) < (1e-4 if one == two else 0.05)


def test_what_has_changed_since_is_merged_too() -> None:
    life, islands, _ = lived(3, 0.0)
    decided = islands.decisions()
    for _ in range(12):
        life.step(quiet=True)
    # Some of it is not true any more.
    some = sorted(decided.believed)
    for pair in some[:5]:
        life.tell(pair, None)
    again = Islands(steps=LARGE)
    again.resume(Decided(decided.believed, decided.places))
    merged = again.merge(life.maps, life.verdicts, set(life.maps), life.rulings)
    assert not {link.pair for link in merged.links} & set(some[:5])
    anew = life.anew()
    assert set(merged.components) == set(anew.components)
    for node in anew.postures:
        assert merged.pose(node).distance(anew.pose(node)) < 0.05
