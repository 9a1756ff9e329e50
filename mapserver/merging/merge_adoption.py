"""How a server that follows another takes over its merges, without comparing or merging anything itself.

Changes are held back until a merge that has them is handed over: then the maps are just those that were
merged, which digests prove. The nodes among them can be found all the while.
"""

import logging
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from mapweave.hybridmap.change import Change, NodePut
from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.merging.merge_encoding import EncodedMerge
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.merging.pruning_record import PruningRecord
from mapweave.mapserver.merging.stored_merges import StoredMerges, adopted
from mapweave.mapserver.merging.verification_cache import VerificationCache, fingerprint_of
from mapweave.mapserver.merging.verification_cache_keeper import made_by
from mapweave.merge.pose_graph.merged_map import MergedMap

log = logging.getLogger(__name__)

PATIENCE = 10.0
"""s without a merge that can be used, after which a server merges itself ..."""
FIRST = 60.0
"""... and so many while there is none at all: the server that leads may have to compare everything first."""
NONE = "no merge is handed over"
"""Why there is none to be used."""
NOT_YET = "{} has not merged what this server knows, or the other way round"
"""Why a merge is not used yet. It is waited for as long."""
OTHER_MAPS = "its maps are not those that {} has merged"
"""Why a merge is not used."""
RETRY = 1.0
"""s between two attempts to read a merge that cannot be read: it may just be written."""
AGAIN = 60.0
"""s after which a server that merges itself for that reason, or after a failure, tries to follow again."""
LATE = 2.0
"""s that something waits for the leader's merge before it is looked whether that one has a trouble ..."""
SILENT = 60.0
"""... and so many with no merge before this server says so: a merge of a large map takes half a minute."""


@dataclass(frozen=True, eq=False)
class _Read:
    """A merge that was handed over, with what comparisons had found."""

    merge: EncodedMerge
    findings: VerificationCache


class MergeAdoption:
    """Only the merging thread may call it; anyone may read `reason` and `behind`.

    Attributes:
        reason: why no merge can be used now; empty if one can, or if it is not known yet.
    """

    def __init__(
        self,
        stored: StoredMerges,
        pruning: PruningRecord | None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Nothing is adopted yet.

        Args:
            stored: reads what was handed over.
            pruning: what was pruned, of the same store.
            clock: the time, s.
        """
        self._stored, self._pruning, self._clock = stored, pruning, clock
        self._held: list[tuple[int, Change]] = []
        self._mark: bytes | None = None
        self._read_at = -math.inf
        self._newest: _Read | None = None
        self._last: _Read | None = None
        self._adopted: bytes | None = None
        self._since, self._wait, self._again_at = clock(), FIRST, 0.0
        self.reason = ""

    @property
    def behind(self) -> int:
        """Changes that are held back."""
        return len(self._held)

    @property
    def first_held(self) -> int | None:
        """The number of the first change that is held back; None if none is."""
        return self._held[0][0] if self._held else None

    @property
    def overdue(self) -> bool:
        """Whether it is time to merge without a leader."""
        return bool(self.reason) and self._clock() >= self._since + self._wait

    def leaders_trouble(self, waited: float) -> str:
        """Why the server that leads, and is there, hands over nothing new though something waits for it.

        Args:
            waited: for how long something has, s.
        """
        if waited < LATE:
            return ""
        leader = self._stored.store.leader or "another server"
        try:
            if trouble := self._stored.trouble:
                return f"{leader} leads, and says: {trouble}"
        except InvalidFile:  # the store is away, which is said elsewhere
            return ""
        if min(waited, self._clock() - self._read_at) < SILENT:
            return ""
        return f"{leader} leads, and for more than {SILENT:.0f} s has not merged what this server knows"

    def begin(self) -> None:
        """This server follows from now on."""
        self._adopted, self.reason = None, ""

    def give_up(self, reason: str) -> None:
        """The newest merge cannot be used after an unforeseen failure: this server merges itself at once."""
        self._adopted, self._again_at = None, self._clock() + AGAIN
        self._fail(reason, 0.0)

    def hold(self, number: int, change: Change) -> None:
        """Hold a change back; numbers grow."""
        self._held.append((number, change))

    def promising(self, merger: Merger) -> bool:
        """Whether a server that merges itself may follow again: there is a merge that it has not tried."""
        try:
            mark = self._stored.mark
        except InvalidFile:
            return False
        if self._clock() < self._again_at or mark in (None, self._mark):
            return False
        self._read(mark, merger)
        return self._newest is not None

    def adopt(
        self,
        merger: Merger,
        take: Callable[[list[Change]], None],
        has_merged: bool,
        last: Mapping[MapId, int],
    ) -> MergedMap | None:
        """Adopt the newest merge, if it is new and has just these maps.

        Args:
            merger: with the maps.
            take: takes changes into it, without comparing.
            has_merged: see `Merger.adopt`.
            last: the last change of each log that the merger has.

        Returns:
            The merged map; None if there is none that is new and can be used.
        """
        try:
            mark = self._stored.mark
        except InvalidFile:  # it is away: nothing new comes either, and that is no time without a leader
            self._since = self._clock()
            return None
        if mark == self._adopted is not None:
            self.reason = ""
            return None
        if mark != self._mark or (self._newest is None and self._clock() >= self._read_at + RETRY):
            self._read(mark, merger)
        if self._newest is None:
            return None
        merge = self._newest.merge
        try:
            if not self._same_pruning(merge) and self._pruning:
                self._pruning.adopt(merger)
            covered, rest = self._covered(merge)
            take(covered)
            # Not before: what failed is taken in once more, which leads to the same maps.
            self._held = rest
            merger.copy_maps()
            wanted = {which: print_ for which, _, print_ in merge.head.maps}
            if self._stored.prints(merger) != wanted or not self._same_pruning(merge):
                same = all(last.get(which, 0) == sequence for which, sequence, _ in merge.head.maps)
                self._fail(
                    (OTHER_MAPS if same else NOT_YET).format(merge.head.by), PATIENCE if same else FIRST
                )
                return None
            merged = adopted(merge, self._newest.findings, merger)
        except InvalidFile as error:
            self._fail(str(error), PATIENCE)
            return None
        merger.adopt(merged, has_merged)
        self._adopted, self._last, self.reason = mark, self._newest, ""
        return merged

    def in_step(self, merger: Merger) -> bool:
        """Whether the merge that was adopted has all that this server knows."""
        if self._held or self._last is None or self._adopted != self._mark or self.reason:
            return False
        head, constraints = self._last.merge.head, merger.constraints
        return (
            head.made == constraints.made
            and dict(head.floors) == dict(constraints.floors)
            and head.pins == merger.pins
            and self._same_pruning(self._last.merge)
        )

    def hand_over(self, merger: Merger, has_merged: bool) -> None:
        """End to follow: have a merger go on from the newest merge, before it takes what was held back.

        Args:
            merger: with the maps.
            has_merged: see `Merger.adopt`: then it goes on from its own.
        """
        if self.reason.startswith(OTHER_MAPS[:20]):
            self._again_at = self._clock() + AGAIN
        newest = self._newest or self._last
        if newest is not None and not has_merged and (self._last or not merger.recollecting):
            merger.recollect(newest.findings, newest.merge.record)

    def release(self) -> list[Change]:
        """What was held back, which the merger takes in now."""
        held, self._held = self._held, []
        return [change for _, change in held]

    def _same_pruning(self, merge: EncodedMerge) -> bool:
        return self._pruning is None or (self._pruning.mark or b"") == merge.head.mark

    def _fail(self, reason: str, wait: float) -> None:
        """No merge can be used; after so many seconds this server merges itself."""
        if reason != self.reason:
            self._since = self._clock()
        self.reason, self._wait = reason, wait

    def _read(self, mark: bytes | None, merger: Merger) -> None:
        """Read a merge, if that can be."""
        words = made_by(merger)
        self._mark, self._newest, self._read_at = mark, None, self._clock()
        if mark is None:
            self._fail(NONE, FIRST)
            return
        try:
            merge = self._stored.read(mark, words)
            self._newest = _Read(merge, self._stored.findings(merge.head.parts, words))
        except InvalidFile as error:
            self._fail(f"the merge that was handed over {error}", PATIENCE)

    def _covered(self, merge: EncodedMerge) -> tuple[list[Change], list[tuple[int, Change]]]:
        """Of what was held back what is in a merge, in order, and the rest with its numbers."""
        last = {which: sequence for which, sequence, _ in merge.head.maps}
        nodes = merge.record.recent.prints
        covered, rest = list[Change](), list[tuple[int, Change]]()
        for number, change in self._held:
            body = change.body
            if change.sequence > last.get(change.map, 0):
                rest.append((number, change))
            # A merge may have left out a node that was already there once more behind it.
            elif not isinstance(body, NodePut) or nodes.get(body.node.id) == fingerprint_of(body.node):
                covered.append(change)
        return covered, rest
