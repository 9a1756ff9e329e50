"""Which pairs of views of one map are held against its own way.

A robot chooses the ids of its nodes. Which pairs are looked at depends on a key as well that no robot knows:
else ids could be chosen so that the pairs that contradict are never among them.
"""

import hashlib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set

import numpy as np

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import EdgeKind
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.mapserver.merging.node_comparisons import NodeComparisons
from mapweave.mapserver.retrieval.compared_landmarks import bounded
from mapweave.merge.outlier_rejection.own_views import PairOfViews, agree_on_no_pose, contradiction
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.fragments import Fragment
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.verdicts import Verdict
from mapweave.registration.recognition import RecognitionSettings

MOST_NEIGHBOURS, MOST_COMPARED, MOST_NEAR = 40, 40, 60
"""Of a map: pairs of nodes that its own edges connect, that the merge compares, and that are near."""
LEAST_LANDMARKS = RecognitionSettings().least_inliers
"""Of a node: if one of two has fewer, they are never linked, and tell nothing. Counted, they took the places
of those that do."""
MOST_NODES = 150
"""Of a piece of map, among which those that are near each other are searched."""
NEAR_XY, NEAR_HEADING = 3.0, math.radians(60.0)
"""Nodes that differ by less are likely to show the same, m and rad."""


class OwnViewsSearch:
    """Compares what is near each other on a robot's drive, besides the pairs that the merge compares."""

    def __init__(self, comparisons: NodeComparisons, choice_key: bytes = b"") -> None:
        """Begin with no maps.

        Args:
            comparisons: compares nodes and keeps the verdicts.
            choice_key: at most 64 bytes; with the same one the same pairs are chosen.
        """
        self._comparisons, self._key = comparisons, choice_key
        self._lost: dict[MapId, dict[Pair, tuple[Verdict, bool]]] = {}

    def reason(
        self, map_id: MapId, hybrid_map: HybridMap, pieces: Sequence[Fragment], compared: Iterable[Pair]
    ) -> str:
        """What the views of a map say against its own way, in words; empty if little does.

        Args:
            map_id: of the map.
            hybrid_map: the map.
            pieces: it by its own edges.
            compared: pairs of its nodes on which there is a verdict.
        """
        edges = (edge for edge in hybrid_map.edges.values() if edge.kind is not EdgeKind.DRIVEN)
        ends = ((min(edge.a, edge.b), max(edge.a, edge.b)) for edge in edges)
        telling = {name for name, node in hybrid_map.nodes.items() if len(node.landmarks) >= LEAST_LANDMARKS}
        pairs = self._some((pair for pair in ends if telling >= {*pair}), MOST_NEIGHBOURS)
        near = (pair for piece in pieces for pair in self._near(piece, telling))
        pairs += self._some(near, MOST_NEAR)
        self._comparisons.verify(pairs)
        pairs += self._some((pair for pair in compared if telling >= {*pair}), MOST_COMPARED)
        pairs = [pair for pair in dict.fromkeys(pairs) if pair in self._comparisons]
        known, self._lost[map_id] = self._lost.get(map_id, {}), {}
        return contradiction(self._views(map_id, hybrid_map, pieces, pairs, known))

    def _views(
        self,
        map_id: MapId,
        hybrid_map: HybridMap,
        pieces: Sequence[Fragment],
        pairs: Sequence[Pair],
        known: Mapping[Pair, tuple[Verdict, bool]],
    ) -> Iterator[PairOfViews]:
        """The pairs with both nodes in one piece: elsewhere there is no way between them."""
        for piece in pieces:
            rows = piece.graph.rows
            inside = [pair for pair in pairs if pair[0] in rows and pair[1] in rows]
            if not inside:
                continue
            ways = piece.graph.relative([a for a, _ in inside], [b for _, b in inside])
            for pair, mean, covariance in zip(inside, ways.means, ways.covariances, strict=True):
                a, b = (bounded(hybrid_map.nodes[node]) for node in pair)
                way, verdict = PoseGaussian(Pose2.from_vector(mean), covariance), self._comparisons[pair]
                if isinstance(verdict, Link):
                    yield PairOfViews(a, b, way, verdict.canonical().a_from_b)
                    continue
                judged, lost = known.get(pair, (None, False))
                if judged is not verdict:
                    lost = agree_on_no_pose(a, b)
                self._lost[map_id][pair] = verdict, lost
                yield PairOfViews(a, b, way, None, lost)

    def _near(self, piece: Fragment, telling: Set[NodeId]) -> list[Pair]:
        """Pairs of nodes that are likely to show the same by the way."""
        drawn = sorted(telling & {*piece.nodes}, key=lambda node: (self._drawn(f"{node}"), node))
        nodes = sorted(drawn[:MOST_NODES])
        x, y, heading = piece.graph.means[piece.graph.index(nodes)].T
        away = np.hypot(x[:, None] - x, y[:, None] - y)
        turn = np.abs(np.remainder(heading[:, None] - heading + np.pi, math.tau) - np.pi)
        first, second = np.nonzero(np.triu((away < NEAR_XY) & (turn < NEAR_HEADING), 1))
        return [(nodes[a], nodes[b]) for a, b in zip(first.tolist(), second.tolist(), strict=True)]

    def _some(self, pairs: Iterable[Pair], most: int) -> list[Pair]:
        """As many pairs at most: nearly the same ones when others come, and from all of the map."""
        return sorted(set(pairs), key=lambda pair: (self._drawn(f"{pair[0]} {pair[1]}"), pair))[:most]

    def _drawn(self, words: str) -> bytes:
        """What an id, or a pair of them, is ordered by."""
        return hashlib.blake2b(words.encode(), digest_size=8, key=self._key).digest()
