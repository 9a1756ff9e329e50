"""Planar pose graphs as g2o files.

    VERTEX_SE2 i x y heading
    EDGE_SE2 i j x y heading I11 I12 I13 I22 I23 I33
    FIX i

The edge's numbers are the pose of j in i and the information of its error, perturbed on the right, which
is our convention too. Vertices without a line are placed along edges. Lines that begin with `#` are comments.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.pose import Array, Pose2, wrap_angle
from mapweave.storage.atomic_file import read_whole, write_whole
from mapweave.storage.os_errors import unreadable

UPPER = np.triu_indices(3)
FIELDS = {"VERTEX_SE2": 5, "EDGE_SE2": 12, "FIX": 2}
"""Words on a line, by its first."""


@dataclass(frozen=True, eq=False)
class G2oEdge:
    """A measured relative pose.

    Attributes:
        i: number of a vertex.
        j: number of another one.
        i_from_j: pose.
        information: (3, 3), inverse covariance of the error.
    """

    i: int
    j: int
    i_from_j: Pose2
    information: Array

    @staticmethod
    def measured(i: int, j: int, i_from_j: Pose2, covariance: Array) -> G2oEdge:
        """An edge by the covariance of its error."""
        information: Array = np.linalg.inv(covariance).astype(np.float64)
        return G2oEdge(i, j, i_from_j, 0.5 * (information + information.T))

    @property
    def covariance(self) -> Array:
        """(3, 3), of the error."""
        out: Array = np.linalg.inv(self.information).astype(np.float64)
        return 0.5 * (out + out.T)


@dataclass(frozen=True, eq=False)
class G2oGraph:
    """What is in a file.

    Attributes:
        poses: of the vertices, by their numbers.
        edges: in the order of the file.
        fixed: vertices that are held.
    """

    poses: Mapping[int, Pose2]
    edges: Sequence[G2oEdge]
    fixed: tuple[int, ...] = ()

    def chi2(self, poses: Mapping[int, Pose2] | None = None) -> float:
        """Sum of the squared normalised errors along the exponential map, which GTSAM makes least.

        g2o itself takes an error's x, y and heading as they are: the same to first order in the heading, but
        on the Manhattan data, with edges known to a tenth of a millimetre, 3549 and 3901 at one place.

        Args:
            poses: of the vertices; those of the file if none are given.
        """
        at = self.poses if poses is None else poses
        total = 0.0
        for edge in self.edges:
            error = _logarithm(edge.i_from_j.inverse() @ at[edge.i].inverse() @ at[edge.j])
            total += float(error @ edge.information @ error)
        return total


def write_g2o(path: Path, graph: G2oGraph, names: Mapping[int, str] | None = None) -> None:
    """Write a graph; numbers are written so that they read back exactly.

    Args:
        path: where.
        graph: what.
        names: of vertices, as comments.
    """
    lines = [f"VERTEX_SE2 {k} {_numbers(pose.vector)}" for k, pose in graph.poses.items()]
    lines += [
        f"EDGE_SE2 {e.i} {e.j} {_numbers(e.i_from_j.vector)} {_numbers(e.information[UPPER])}"
        for e in graph.edges
    ]
    # Last: GTSAM's reader takes no edge behind a line that it does not know.
    lines += [f"FIX {k}" for k in graph.fixed]
    lines += [f"# {number} {name}" for number, name in (names or {}).items()]
    write_whole(path, "\n".join([*lines, ""]).encode("ascii"))


def read_g2o(path: Path) -> G2oGraph:
    """Read a planar graph.

    Raises:
        InvalidFile: it cannot be read, is not planar, or a line is wrong; the words name the line.
    """
    try:
        lines = read_whole(path).decode("utf-8").splitlines()
    except UnicodeDecodeError:
        raise InvalidFile(f"{path}: is no g2o file") from None
    except OSError as error:
        raise unreadable(path, error) from None
    poses: dict[int, Pose2] = {}
    edges: list[G2oEdge] = []
    fixed: list[int] = []
    for number, line in enumerate(lines, 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        where = f"{path}: line {number}"
        if words[0] not in FIELDS:
            raise InvalidFile(
                f"{where}: {words[0][:40]!r} is none of {', '.join(FIELDS)}: only planar graphs are read"
            )
        if len(words) != FIELDS[words[0]]:
            raise InvalidFile(
                f"{where}: {words[0]} needs {FIELDS[words[0]] - 1} numbers, not {len(words) - 1}"
            )
        ends = 2 if words[0] == "EDGE_SE2" else 1
        try:
            ids, values = [int(w) for w in words[1 : 1 + ends]], [float(w) for w in words[1 + ends :]]
        except ValueError:
            raise InvalidFile(f"{where}: a word is no number") from None
        if not all(math.isfinite(value) for value in values):
            raise InvalidFile(f"{where}: a number is not finite")
        if words[0] == "FIX":
            fixed.append(ids[0])
        elif words[0] == "VERTEX_SE2":
            poses[ids[0]] = Pose2(*values)
        else:
            edges.append(G2oEdge(ids[0], ids[1], Pose2(*values[:3]), _information(values[3:], where)))
    if not poses and not edges:
        raise InvalidFile(f"{path}: holds neither vertex nor edge")
    _fill(poses, edges)
    absent = sorted(({end for edge in edges for end in (edge.i, edge.j)} | set(fixed)) - poses.keys())
    if absent:
        raise InvalidFile(f"{path}: neither a vertex nor a chain of edges gives the pose of {absent[0]}")
    return G2oGraph(poses, edges, tuple(fixed))


def _fill(poses: dict[int, Pose2], edges: Sequence[G2oEdge]) -> None:
    """Place vertices that have no line of their own along edges, from those that have, or from the first."""
    if not poses:
        poses[edges[0].i] = Pose2()
    steps: dict[int, list[tuple[int, Pose2]]] = {}
    for edge in edges:
        steps.setdefault(edge.i, []).append((edge.j, edge.i_from_j))
        steps.setdefault(edge.j, []).append((edge.i, edge.i_from_j.inverse()))
    queue = deque(poses)
    while queue:
        vertex = queue.popleft()
        for neighbour, step in steps.get(vertex, ()):
            if neighbour not in poses:
                poses[neighbour] = poses[vertex] @ step
                queue.append(neighbour)


def _logarithm(pose: Pose2) -> Array:
    """(3,) tangent vector whose exponential is the pose."""
    half = 0.5 * wrap_angle(pose.heading)
    a = half / math.tan(half) if abs(half) > 1e-9 else 1.0
    return np.array([a * pose.x + half * pose.y, a * pose.y - half * pose.x, 2.0 * half])


def _information(values: Sequence[float], where: str) -> Array:
    upper = np.zeros((3, 3))
    upper[UPPER] = values
    full = upper + np.triu(upper, 1).T
    if np.linalg.eigvalsh(full)[0] <= 0.0:
        raise InvalidFile(f"{where}: the information must be positive definite")
    return full


def _numbers(values: Array) -> str:
    return " ".join(repr(float(value)) for value in values)
