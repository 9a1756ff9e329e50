"""Hands merges over by way of a store that servers share: the one that leads merges, the others adopt that.

What comparing nodes has found is written in parts. One that is full is not written again, so a merge of a
large map costs what is new, the poses and the decisions. All of it follows from the logs: without it each
server merges for itself.
"""

import hashlib
import zlib
from collections.abc import Mapping

from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.mapserver.log.store import MERGE, MERGE_MARK, MERGE_TROUBLE, Store
from mapweave.mapserver.merging import verification_cache_file
from mapweave.mapserver.merging.merge_encoding import EncodedMerge, MergeHead, map_print, packed
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.merging.restart_record import RestartRecord
from mapweave.mapserver.merging.verification_cache import RecentComparisons, VerificationCache
from mapweave.mapserver.merging.verification_cache_keeper import made_by
from mapweave.merge.pose_graph.merged_map import MergedMap

PART = "compared {}"
"""Among the results of a store, with a number: what comparing nodes has found."""
FULL = 2000
"""Pairs in a part that is not written again: half a megabyte."""
MARK_BYTES = 16
"""Of a digest of a merge, or a part."""
LEVEL = 1
"""Of zlib: half the bytes in a tenth of the time that level 9 takes."""


class StoredMerges:
    """The merges in one store. Only the merging thread may call it.

    Attributes:
        store: that servers share.
    """

    def __init__(self, store: Store, name: str) -> None:
        self.store, self._name = store, name
        self._prints: dict[MapId, tuple[HybridMap, bytes]] = {}
        self.begin()

    def begin(self) -> None:
        """This server leads from now on: what others have written before is not gone on with."""
        self._full = VerificationCache()
        self._marks: list[bytes] = []
        self._written = 0
        self._trouble: str | None = None

    @property
    def mark(self) -> bytes | None:
        """Of the newest merge that was handed over.

        Raises:
            InvalidFile: the store cannot be read.
        """
        return self.store.result(MERGE_MARK)

    @property
    def trouble(self) -> str:
        """Why the server that leads hands over no merge, as it says itself; empty if it does.

        Raises:
            InvalidFile: the store cannot be read.
        """
        return (self.store.result(MERGE_TROUBLE) or b"").decode(errors="replace")

    def write(self, merger: Merger, last: Mapping[MapId, int], pruning: bytes | None) -> int:
        """Hand over the newest merge, with which nothing has changed since. Returns how many bytes it takes.

        Args:
            merger: has merged.
            last: the last change of each log that it has.
            pruning: mark of what was pruned.

        Raises:
            InvalidValue: it cannot be encoded.
        """
        findings, merged = merger.findings(), merger.merged()
        results, words = {}, made_by(merger)
        if self._written > 2 * len(findings) + FULL:
            self.begin()  # Most of what is written is about nodes that have changed since.
        part = findings.besides(self._full)
        data = zlib.compress(verification_cache_file.packed(part, words), LEVEL)
        results[PART.format(len(self._marks))] = data
        marks = [*self._marks, _digest(data)]
        if len(part) >= FULL:
            self._full, self._marks, self._written = findings, marks, self._written + len(part)
        prints = self.prints(merger)
        maps = {which: (last.get(which, 0), print_) for which, print_ in prints.items()}
        head = MergeHead.of(self._name, maps, pruning, marks, merged)
        record = RestartRecord.of(merger.superseding, RecentComparisons(merger.prints()))
        data = zlib.compress(packed(head, record, merged, findings.verdicts.get, words), LEVEL)
        results |= {MERGE: data, MERGE_MARK: _digest(data)}
        self.store.publish(results)
        return sum(map(len, results.values()))

    def tell(self, trouble: str) -> None:
        """Tell the servers that follow why no merge is handed over, if they do not know.

        Args:
            trouble: in words; empty: there is none.
        """
        if trouble != self._trouble:
            self.store.publish({MERGE_TROUBLE: trouble.encode()})
            self._trouble = trouble

    def read(self, mark: bytes, words: str) -> EncodedMerge:
        """The merge of a mark.

        Args:
            mark: see `mark`.
            words: settings and version of this server.

        Raises:
            InvalidFile: it is damaged, or of another version or other settings.
        """
        return EncodedMerge.read(_whole(self.store.result(MERGE), mark), words)

    def findings(self, marks: tuple[bytes, ...], words: str) -> VerificationCache:
        """What comparisons have found.

        Args:
            marks: of its parts.
            words: settings and version of this server.

        Raises:
            InvalidFile: see `read`.
        """
        count = len(self._marks)
        if marks[:count] != tuple(self._marks) or count == len(marks):
            self.begin()
        for number in range(len(self._marks), len(marks)):
            data = _whole(self.store.result(PART.format(number)), marks[number])
            part = self._full.joined(verification_cache_file.load(data, words))
            if number == len(marks) - 1:
                return part
            self._full, self._marks = part, [*self._marks, marks[number]]
        return self._full

    def prints(self, merger: Merger) -> dict[MapId, bytes]:
        """A digest of each map as it was merged."""
        nodes: Mapping[NodeId, bytes] = merger.prints()
        before, self._prints = self._prints, {}
        for which, one in merger.kept.items():
            known = before.get(which)
            same = known is not None and known[0] is one
            self._prints[which] = known if known and same else (one, map_print(one, nodes))
        return {which: print_ for which, (_, print_) in self._prints.items()}


def adopted(merge: EncodedMerge, findings: VerificationCache, merger: Merger) -> MergedMap:
    """A merge that was handed over, of the maps as this server has them.

    Raises:
        InvalidFile: it does not fit them.
    """
    try:
        return merge.merged(merger.kept, findings.verdicts, merger.pruning.pruned)
    except (KeyError, IndexError, StopIteration, ValueError, TypeError) as error:
        raise InvalidFile(
            f"the merge does not fit what was compared ({type(error).__name__}: {error})"
        ) from None


def _digest(data: bytes) -> bytes:
    return hashlib.blake2b(data, digest_size=MARK_BYTES).digest()


def _whole(data: bytes | None, mark: bytes) -> bytes:
    if data is None or _digest(data) != mark:
        raise InvalidFile("is incomplete or damaged")
    try:
        return zlib.decompress(data)
    except zlib.error as error:
        raise InvalidFile(f"is damaged ({error})") from None
