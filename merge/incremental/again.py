"""A large island decided again as a whole, beside the steps that go on meanwhile."""

from __future__ import annotations

from collections.abc import Mapping

from hybridmap.hybrid_map import HybridMap
from hybridmap.node import MapId
from hybridmap.ruling import Rulings
from merge.belief.memory import Memory
from merge.incremental.settings import StepSettings
from merge.incremental.sheets import MapPair
from merge.incremental.steps import Steps
from merge.incremental.verdicts import Verdicts
from merge.merging import MergeSettings


class Again:
    """Takes minutes where there are many nodes, so it can be run by a thread of its own."""

    def __init__(
        self,
        settings: MergeSettings,
        how: StepSettings,
        maps: Mapping[MapId, HybridMap],
        verdicts: Verdicts,
        rulings: Rulings,
    ) -> None:
        """Take what there is now; whatever comes later is no part of it.

        Args:
            settings: of the merge.
            how: it is made in steps.
            maps: of the island. They are never changed, only replaced.
            verdicts: a copy.
            rulings: of people.
        """
        self._maps, self._verdicts, self._rulings = maps, verdicts, rulings
        self._steps = Steps(settings, how, Memory())
        self._news: set[MapPair] = set()
        self._done = False

    @property
    def done(self) -> bool:
        """Whether it has been decided."""
        return self._done

    def run(self) -> None:
        """Decide; from any thread, once."""
        self._steps.step(self._maps, self._verdicts, self._verdicts.at(self._maps.keys()), self._rulings)
        self._done = True

    def missed(self, news: set[MapPair]) -> None:
        """Between these maps something has changed since it began."""
        self._news |= news

    def outcome(self) -> tuple[Steps, set[MapPair]]:
        """The island as it was decided, and between which maps it has to catch up; once it is done."""
        assert self._done
        return self._steps, self._news
