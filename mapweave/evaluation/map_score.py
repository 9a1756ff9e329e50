"""Scoring a merged map against simulation truth. Nothing here is known to robots or server."""

import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge
from mapweave.hybridmap.pose import Array, Pose2, wrap_angle
from mapweave.sim.floorplan import Rectangle
from mapweave.storage.atomic_file import write_whole

FALSE_LINK = 0.5
"""m; a link between maps that is off by more is false."""
FALSE_LINK_TURN = math.radians(15.0)
"""rad; likewise."""
SAME_PLACE = 1.0
"""m; images that were taken closer to each other show the same place, if their headings agree."""
SAME_PLACE_TURN = math.radians(30.0)
"""rad; likewise: half of what an ordinary camera sees."""


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
        world_from_component: the alignment of each component.
    """

    components: int
    ate: float
    links: int
    false_links: int
    world_from_component: Mapping[int, Pose2]


def score_map(
    poses: Mapping[NodeId, tuple[int, Pose2]], links: Sequence[Edge], truth: Mapping[NodeId, Pose2]
) -> MapScore:
    """Score optimised poses and links.

    Args:
        poses: component and merged pose of each node.
        links: edges between nodes of different maps.
        truth: `world_from_robot` when each node's image was taken.
    """
    members: dict[int, list[NodeId]] = {}
    for node, (component, _) in poses.items():
        if node in truth:
            members.setdefault(component, []).append(node)
    squares, alignments = [], {}
    for component, nodes in members.items():
        estimated = np.array([[poses[n][1].x, poses[n][1].y] for n in nodes])
        true = np.array([[truth[n].x, truth[n].y] for n in nodes])
        alignments[component] = world_from_component = align(estimated, true)
        squares.append(((world_from_component.apply(estimated) - true) ** 2).sum(axis=1))
    ate = float(np.sqrt(np.concatenate(squares).mean())) if squares else math.nan
    between = [e for e in links if e.a in truth and e.b in truth and e.a.map != e.b.map]
    false = sum(is_false(e, truth) for e in between)
    return MapScore(len(members), ate, len(between), false, alignments)


def is_false(link: Edge, truth: Mapping[NodeId, Pose2]) -> bool:
    """Whether a link's pose is off by more than 0.5 m or 15 degrees."""
    distance, turn = pose_error(link.a_from_b.mean, truth[link.a].inverse() @ truth[link.b])
    return distance > FALSE_LINK or turn > FALSE_LINK_TURN


def link_recall(
    links: Iterable[Edge], truth: Mapping[NodeId, Pose2], walls: Sequence[Rectangle]
) -> float | None:
    """The share of the shared places that are linked.

    Two nodes show *the same place* if their images were truly taken within 1 m and 30 degrees of each other
    and no wall is between the two positions. A node has a *chance* for each other map that holds a node
    of the same place. The chance is *taken* if a true link (see `is_false`) joins that other map to the node
    itself or to a node of its own map that shows the same place. Recall is the share of the chances that are
    taken. So a place that two maps share needs one link, not one for each pair of images, and neither a link
    from another room nor a false one helps it. Furniture does not count as a wall.

    Args:
        links: edges between maps; others are ignored.
        truth: `world_from_robot` when each node's image was taken.
        walls: of the floor plan.

    Returns:
        The share, or None where no two maps share a place.
    """
    nodes: dict[MapId, list[NodeId]] = {}
    for node in truth:
        nodes.setdefault(node.map, []).append(node)
    poses = {m: np.array([truth[n].vector for n in members]) for m, members in nodes.items()}
    linked: dict[NodeId, set[MapId]] = {}
    for link in links:
        if link.a.map != link.b.map and link.a in truth and link.b in truth and not is_false(link, truth):
            linked.setdefault(link.a, set()).add(link.b.map)
            linked.setdefault(link.b, set()).add(link.a.map)
    chances = taken = 0
    for map_id, members in nodes.items():
        neighbours = same_place(poses[map_id], poses[map_id], walls)
        for other_id in nodes:
            if other_id == map_id:
                continue
            has_chance = same_place(poses[map_id], poses[other_id], walls).any(axis=1)
            has_link = np.array([other_id in linked.get(n, ()) for n in members])
            chances += int(has_chance.sum())
            taken += int((has_chance & (neighbours & has_link).any(axis=1)).sum())
    return taken / chances if chances else None


def same_place(a: Array, b: Array, walls: Sequence[Rectangle]) -> NDArray[np.bool_]:
    """Which pairs of poses show the same place: within 1 m and 30 degrees, no wall in between.

    Args:
        a: (N, 3) [x m, y m, heading rad], in world.
        b: (M, 3) likewise.
        walls: of the floor plan.

    Returns:
        (N, M).
    """
    distances = np.hypot(*(a[:, None, :2] - b[None, :, :2]).transpose(2, 0, 1))
    turn = np.abs((a[:, None, 2] - b[None, :, 2] + math.pi) % math.tau - math.pi)
    same: NDArray[np.bool_] = (distances <= SAME_PLACE) & (turn <= SAME_PLACE_TURN)
    i, j = np.nonzero(same)
    same[i, j] = ~crossed(a[i, :2], b[j, :2], walls)
    return same


def crossed(starts: Array, ends: Array, solids: Iterable[Rectangle]) -> NDArray[np.bool_]:
    """Which straight lines meet a solid, (N,), by clipping each line against the sides of each rectangle.

    Args:
        starts: (N, 2) m, in world.
        ends: (N, 2) m, likewise.
        solids: rectangles; a line that only touches one meets it.
    """
    met = np.zeros(len(starts), bool)
    for solid in solids:
        solid_from_world = Pose2(solid.x, solid.y, solid.heading).inverse()
        start = solid_from_world.apply(starts)
        along = solid_from_world.apply(ends) - start
        half = np.array([solid.length / 2, solid.width / 2])
        # Along an axis to which it is parallel, a line is between two sides always or never.
        parallel = np.abs(along) < 1e-12
        step = np.where(parallel, 1.0, along)
        first, last = np.sort(np.stack([(-half - start) / step, (half - start) / step]), axis=0)
        between = np.abs(start) <= half
        first = np.where(parallel, np.where(between, -np.inf, np.inf), first).max(axis=1)
        last = np.where(parallel, np.where(between, np.inf, -np.inf), last).min(axis=1)
        met |= np.maximum(first, 0.0) <= np.minimum(last, 1.0)
    return met


def pose_error(estimated: Pose2, true: Pose2) -> tuple[float, float]:
    """Distance (m) and absolute angle (rad) between two poses."""
    return estimated.distance(true), abs(wrap_angle(estimated.heading - true.heading))


def write_tum(path: Path, stamps_ns: NDArray[np.int64], poses: Array) -> None:
    """Write a planar trajectory as others' tools read it (TUM format: stamp s, position m, quaternion xyzw).

    Args:
        path: where.
        stamps_ns: (N,).
        poses: (N, 3) [x m, y m, heading rad].
    """
    zero = np.zeros(len(poses))
    half = poses[:, 2] / 2
    columns = [stamps_ns / 1e9, poses[:, 0], poses[:, 1], zero, zero, zero, np.sin(half), np.cos(half)]
    text = io.BytesIO()
    np.savetxt(text, np.stack(columns, axis=1), fmt="%.6f")
    write_whole(path, text.getvalue())
