"""Which verdicts count in a merge: no link joins a map with wrong geometry with another one."""

from collections.abc import Collection, Iterable, Mapping

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.manual_constraint import ManualConstraints
from mapweave.mapserver.merging.node_comparisons import NodeComparisons
from mapweave.merge.outlier_rejection.wrong_geometry import WrongGeometrySearch
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.links import Link, RefusedLink, refuse
from mapweave.merge.pose_graph.merged_map import WrongGeometry
from mapweave.merge.pose_graph.verdicts import MapPair, Verdict, Verdicts
from mapweave.merge.settings import ConsistencySettings


class CountedVerdicts:
    """Finds the maps with wrong geometry, and keeps the verdicts without their links to others.

    Attributes:
        verdicts: those that count; instead of a link that does not a refusal, with the reason.
        search: for maps with wrong geometry.
        wrong: the maps that have it.
    """

    def __init__(self, comparisons: NodeComparisons, consistency: ConsistencySettings) -> None:
        """There are no verdicts yet.

        Args:
            comparisons: what was found of each pair of nodes, counted or not.
            consistency: settings of the search.
        """
        self._comparisons = comparisons
        self.verdicts = Verdicts()
        self.search = WrongGeometrySearch(consistency)
        self.wrong: dict[MapId, WrongGeometry] = {}
        self._unlinked: dict[MapPair, str] = {}
        self._stale: set[MapPair] = set()

    def put(self, pair: Pair, verdict: Verdict | None) -> None:
        """Take what was found of a pair of nodes; None: nothing any more."""
        self._stale.add((pair[0].map, pair[1].map))
        if verdict is None:
            self.verdicts.drop(pair)
        else:
            self.verdicts.put(pair, self._counted(verdict))

    def changed(self, maps: Iterable[MapId]) -> None:
        """Take note that these maps, or what people say of them, have changed."""
        self._stale |= self.verdicts.at({*maps})

    def find_wrong(
        self, maps: Mapping[MapId, HybridMap], constraints: ManualConstraints, left_out: Collection[MapId]
    ) -> bool:
        """Find the maps that contradict others that agree; returns whether any is no longer one of them.

        Args:
            maps: as they are merged.
            constraints: which links they exclude.
            left_out: maps that are not merged.
        """

        def links(pair: MapPair) -> list[Link]:
            found = (self._comparisons[nodes] for nodes in self.verdicts.between(pair))
            return [v for v in found if isinstance(v, Link) and constraints.against(*v.pair) is None]

        before = self.wrong
        self.wrong = self.search.wrong(maps, links, self._stale, left_out)
        self._stale = set()
        return bool(before.keys() - self.wrong.keys())

    def leave_unlinked(self) -> set[MapId]:
        """Let links count or not by which maps are wrong now; returns the maps for which that is new."""
        wrong = {which: one.reason for which, one in self.wrong.items()}
        before, self._unlinked = self._unlinked, {}
        for maps in self.verdicts.at(wrong.keys()):
            if maps[0] != maps[1] and (reason := wrong.get(maps[0]) or wrong.get(maps[1])):
                self._unlinked[maps] = reason
        touched = set[MapId]()
        for maps, _ in before.items() ^ self._unlinked.items():
            touched |= {*maps}
            for pair in list(self.verdicts.between(maps)):
                self.verdicts.put(pair, self._counted(self._comparisons[pair]))
        return touched

    def _counted(self, verdict: Verdict) -> Verdict:
        """A verdict, or why it does not count."""
        if isinstance(verdict, RefusedLink) or verdict.within:
            return verdict
        reason = self._unlinked.get(verdict.maps)
        return verdict if reason is None else refuse(verdict, reason)
