"""Registration: in which of the candidates the view is recognised, and from where. The second step."""

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.query import View
from mapweave.mapserver.relocalization.aliased_landmarks import EXPLAINED_PX, between, unexplained
from mapweave.mapserver.relocalization.candidates import RetrievedNodes
from mapweave.mapserver.relocalization.place_hypotheses import ALONE, SLIGHT, NodeMatch, is_one_thing
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.registration.matching import match
from mapweave.registration.pose_refinement import refine_pose
from mapweave.registration.recognition import (
    Recognition,
    RecognitionFailure,
    RecognitionSettings,
    examine_matches,
)


@dataclass(frozen=True, eq=False)
class Registration:
    """What comparing a view with its candidates gives.

    Attributes:
        candidates: that were compared.
        matches: nodes that were recognised, most landmarks first. The pose in the first is refined.
        refusals: why others were not.
    """

    candidates: RetrievedNodes
    matches: Sequence[NodeMatch] = ()
    refusals: Sequence[tuple[NodeId, RecognitionFailure]] = ()


class ViewRegistration:
    """Registers views with nodes. It belongs to one merged map."""

    def __init__(
        self,
        node_of: Callable[[NodeId], Node | None],
        merged: MergedMap,
        recognition: RecognitionSettings,
        faint: float,
    ) -> None:
        """Take what is known.

        Args:
            node_of: gives a node by its id.
            merged: where nodes are.
            recognition: when a view counts as recognised.
            faint: once a node suffices, candidates with less than this share of its similarity are left out.
        """
        self._node_of, self._merged = node_of, merged
        self._settings, self._faint = recognition, faint

    def register(self, candidates: RetrievedNodes) -> Registration:
        """Register a view with its candidates, as long as the answer can change."""
        view = candidates.view
        matches: list[NodeMatch] = []
        refusals: list[tuple[NodeId, RecognitionFailure]] = []
        best_score = 0.0
        for node_id, score in candidates.ranked:
            sure = any(recognised.recognition.inliers >= ALONE for recognised in matches)
            node = self._node_of(node_id)
            if node is None or (sure and score < self._faint * best_score):
                continue
            pairs = match(node.landmarks.codes, view.codes, self._settings.matching)
            if sure and not self._may_differ(node, pairs, view, matches):
                continue
            seed = zlib.crc32(view.codes.tobytes(), zlib.crc32(str(node_id).encode()))
            result = examine_matches(node, view, pairs, self._settings, np.random.default_rng(seed))
            if isinstance(result, Recognition):
                matches.append(NodeMatch(node_id, result, one_thing=is_one_thing(node, view, result)))
                best_score = max(best_score, score)
            else:
                refusals.append((node_id, result))
        return Registration(candidates, self.refined(view, matches), refusals)

    def refined(self, view: View, matches: Sequence[NodeMatch]) -> list[NodeMatch]:
        """Matches with most landmarks first; the first gets the pose that the pixels give at their noise."""
        ordered = sorted(matches, key=lambda one: (-one.recognition.inliers, one.node))
        for first in ordered[:1]:
            if (node := self._node_of(first.node)) is not None:
                pose = refine_pose(node, view, first.recognition, self._settings.pose)
                ordered[0] = replace(first, recognition=replace(first.recognition, node_from_robot=pose))
        return ordered

    def _may_differ(
        self, node: Node, pairs: NDArray[np.int64], view: View, matches: Sequence[NodeMatch]
    ) -> bool:
        """Whether a node may be a rival of those that were recognised.

        It is none if too few features match that the pose found does not explain already.
        """
        best = max(matches, key=lambda one: one.recognition.inliers)
        least = max(self._settings.least_inliers, SLIGHT * best.recognition.inliers)
        if len(pairs) < least:
            return False
        mapped = between(self._merged, node.id, best.node)
        if mapped is None:
            return True
        from_robot = mapped @ best.recognition.node_from_robot.mean
        return unexplained(node, pairs, view.pixels, view.camera, from_robot, EXPLAINED_PX) >= least
