"""Scoring a merged map against simulation truth. Nothing here is known to robots or server."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridmap.node import Edge, NodeId
from hybridmap.pose import Array, Pose2, wrap_angle

FALSE_LINK = 0.5
"""m; a link between maps that is off by more is false."""
FALSE_LINK_TURN = math.radians(15.0)
"""rad; likewise."""


def align(estimated: Array, true: Array) -> Pose2:
    """The rigid motion that brings positions closest to others (least squares, no scale).

    Args:
        estimated: (N, 2) m.
        true: (N, 2) m.

    Returns:
        `true_from_estimated`; for fewer than two points only a shift.
    """
    if not len(estimated):
        return Pose2()
    middle, true_middle = estimated.mean(axis=0), true.mean(axis=0)
    spread = (estimated - middle).T @ (true - true_middle)
    turn = math.atan2(spread[0, 1] - spread[1, 0], spread[0, 0] + spread[1, 1])
    heading = turn if len(estimated) > 1 else 0.0
    shift = true_middle - Pose2(0.0, 0.0, heading).apply(middle)
    return Pose2(float(shift[0]), float(shift[1]), heading)


@dataclass(frozen=True)
class MapScore:
    """How good a merged map is.

    Attributes:
        components: connected components that hold nodes.
        ate: root mean square position error of the nodes after one rigid alignment a component, m.
        links: links between maps.
        false_links: links that are off by more than 0.5 m or 15 degrees.
        world_from_merged: the alignment of the largest component.
    """

    components: int
    ate: float
    links: int
    false_links: int
    world_from_merged: Pose2


def score_map(
    postures: Mapping[NodeId, tuple[int, Pose2]], links: Sequence[Edge], truth: Mapping[NodeId, Pose2]
) -> MapScore:
    """Score optimised postures and links.

    Args:
        postures: component and merged posture of each node.
        links: edges between nodes of different maps.
        truth: `world_from_robot` when each node's image was taken.
    """
    members: dict[int, list[NodeId]] = {}
    for node, (component, _) in postures.items():
        if node in truth:
            members.setdefault(component, []).append(node)
    squares, alignment, largest = [], Pose2(), 0
    for nodes in members.values():
        estimated = np.array([[postures[n][1].x, postures[n][1].y] for n in nodes])
        true = np.array([[truth[n].x, truth[n].y] for n in nodes])
        world_from_merged = align(estimated, true)
        squares.append(((world_from_merged.apply(estimated) - true) ** 2).sum(axis=1))
        if len(nodes) > largest:
            largest, alignment = len(nodes), world_from_merged
    ate = float(np.sqrt(np.concatenate(squares).mean())) if squares else math.nan
    between = [e for e in links if e.a in truth and e.b in truth and e.a.map != e.b.map]
    false = sum(is_false(e, truth) for e in between)
    return MapScore(len(members), ate, len(between), false, alignment)


def is_false(link: Edge, truth: Mapping[NodeId, Pose2]) -> bool:
    """Whether a link's posture is off by more than 0.5 m or 15 degrees."""
    distance, turn = posture_error(link.a_from_b.mean, truth[link.a].inverse() @ truth[link.b])
    return distance > FALSE_LINK or turn > FALSE_LINK_TURN


def posture_error(estimated: Pose2, true: Pose2) -> tuple[float, float]:
    """Distance (m) and absolute angle (rad) between two postures."""
    return estimated.distance(true), abs(wrap_angle(estimated.heading - true.heading))


def write_tum(path: Path, stamps_ns: NDArray[np.int64], poses: Array) -> None:
    """Write a planar trajectory as others' tools read it (TUM format: stamp, position, quaternion).

    Args:
        path: where.
        stamps_ns: (N,).
        poses: (N, 3) [x m, y m, heading rad].
    """
    zero = np.zeros(len(poses))
    half = poses[:, 2] / 2
    columns = [stamps_ns / 1e9, poses[:, 0], poses[:, 1], zero, zero, zero, np.sin(half), np.cos(half)]
    np.savetxt(path, np.stack(columns, axis=1), fmt="%.6f")
