"""Pose graphs of several robots in space for `benchmarks.merge`: which links between them agree.

One g2o file a robot in a folder; the robot is the first byte of a vertex's 64-bit key (GTSAM's symbols). Our
maps are planar, so here only the search for the best clique is ours; loops are closed in space by GTSAM.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import gtsam
import numpy as np

from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.pose import Array
from mapweave.merge.outlier_rejection.max_clique import best_clique

GATE = 22.46
"""Chi-square with 6 degrees of freedom of a loop through two links: 99.9 %, as in the plane."""


@dataclass(frozen=True, eq=False)
class Measured:
    """A relative pose in space with the covariance of its perturbation on the right, (6, 6)."""

    a: int
    b: int
    a_from_b: gtsam.Pose3
    covariance: Array

    def then(self, other: Measured) -> Measured:
        """First this one, then another, to first order."""
        ad = other.a_from_b.inverse().AdjointMap()
        carried = ad @ self.covariance @ ad.T + other.covariance
        return Measured(self.a, other.b, self.a_from_b.compose(other.a_from_b), carried)

    def turned(self) -> Measured:
        """Seen from its other end."""
        ad = self.a_from_b.AdjointMap()
        return Measured(self.b, self.a, self.a_from_b.inverse(), ad @ self.covariance @ ad.T)


def kept_links(folder: Path) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Pairs of vertices of all links between robots, and of those that are in the best clique of their pair.

    Raises:
        InvalidFile: nothing there that can be read.
    """
    edges = {(edge.a, edge.b): edge for path in sorted(folder.glob("*.g2o")) for edge in _read(path)}
    if not edges:
        raise InvalidFile(
            f"{folder}: holds no g2o file with EDGE_SE3:QUAT lines; name a folder of one file a robot"
        )
    way = {e.a: e for e in edges.values() if robot_of(e.a) == robot_of(e.b) and e.b == e.a + 1}
    groups: dict[tuple[int, int], list[Measured]] = {}
    for edge in edges.values():
        if robot_of(edge.a) != robot_of(edge.b):
            link = edge if robot_of(edge.a) < robot_of(edge.b) else edge.turned()
            groups.setdefault((robot_of(link.a), robot_of(link.b)), []).append(link)
    links, kept = [], []
    for _, group in sorted(groups.items()):
        agree = np.eye(len(group), dtype=bool)
        for i, j in combinations(range(len(group)), 2):
            agree[i, j] = agree[j, i] = _misclosure(group[i], group[j], way) < GATE
        best = best_clique(agree, np.ones(len(group), np.int64))
        links += [(link.a, link.b) for link in group]
        kept += [(group[k].a, group[k].b) for k in best]
    return links, kept


def robot_of(key: int) -> int:
    """First byte of a key."""
    return key >> 56


def _misclosure(one: Measured, other: Measured, way: dict[int, Measured]) -> float:
    """Squared normalised error of the loop along one link and back along the other."""
    loop = one
    for leg in (_along(one.b, other.b, way), other.turned(), _along(other.a, one.a, way)):
        loop = loop.then(leg) if leg is not None else loop
    off = gtsam.Pose3.Logmap(loop.a_from_b)
    return float(off @ np.linalg.solve(loop.covariance, off))


def _along(start: int, end: int, way: dict[int, Measured]) -> Measured | None:
    """Along a robot's own way; None if it stays where it is."""
    if start == end:
        return None
    if end < start:
        back = _along(end, start, way)
        return None if back is None else back.turned()
    whole = way[start]
    for key in range(start + 1, end):
        whole = whole.then(way[key])
    return whole


def _read(path: Path) -> list[Measured]:
    found = []
    for number, line in enumerate(path.read_text().splitlines(), 1):
        words = line.split()
        if not words or words[0] != "EDGE_SE3:QUAT":
            continue
        try:
            a, b = int(words[1]), int(words[2])
            x, y, z, qx, qy, qz, qw = map(float, words[3:10])
            upper = np.array(words[10:31], dtype=np.float64)
            information = np.zeros((6, 6))
            information[np.triu_indices(6)] = upper
        except ValueError as problem:
            raise InvalidFile(f"{path}, line {number}: {problem}") from None
        information += np.triu(information, 1).T
        # g2o has the place first, GTSAM the turn.
        order = [3, 4, 5, 0, 1, 2]
        covariance: Array = np.linalg.inv(information)[np.ix_(order, order)].astype(np.float64)
        pose = gtsam.Pose3(gtsam.Rot3.Quaternion(qw, qx, qy, qz), np.array([x, y, z]))
        found.append(Measured(a, b, pose, covariance))
    return found
