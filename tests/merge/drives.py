"""Drives: one robot through the same hall every day, as maps and links without images.

The input is what verification would return, so that a year of drives takes minutes. On each drive, a
new epoch, the robot wanders. Its nodes are linked with nodes of its own drive and with earlier active nodes.
Some links are false: places that look alike (see `merge_fleets`).
"""

import math
from collections import Counter
from collections.abc import Iterator, Set
from dataclasses import dataclass, field
from itertools import count

import numpy as np

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.merge.pose_graph.links import Link
from synthetic.fleet import FleetSettings, link_between, map_of, walk_of

ROBOT = "r0"


@dataclass(frozen=True)
class DriveSettings:
    """What is drawn.

    Attributes:
        floor: size of the hall; nodes of a drive; when two nodes show the same place.
        most: links of a new node with any one drive.
        false_share: of the links of a drive, from 0 to below 1.
    """

    floor: FleetSettings = field(default_factory=lambda: FleetSettings(nodes=48, side=8.0))
    most: int = 2
    false_share: float = 0.0


@dataclass(frozen=True, eq=False)
class Drive:
    """One more drive.

    Attributes:
        map_id: of its map.
        map: the map.
        links: of its nodes, with each other and with earlier ones.
        true: pairs of those that are true.
        truth: `world_from_robot` of its nodes.
        past: earlier nodes that are superseded once it is over.
    """

    map_id: MapId
    map: HybridMap
    links: tuple[Link, ...]
    true: frozenset[tuple[NodeId, NodeId]]
    truth: dict[NodeId, Pose2]
    past: frozenset[NodeId]


def drives(rng: np.random.Generator, settings: DriveSettings | None = None) -> Iterator[Drive]:
    """Drive after drive, without end.

    Args:
        rng: source of all that is random.
        settings: sizes.
    """
    s = settings or DriveSettings()
    active: dict[NodeId, Pose2] = {}
    past: set[NodeId] = set()
    for epoch in count(1):
        walk = walk_of(s.floor, rng)
        truth = {NodeId(ROBOT, epoch, k): pose_vector for k, pose_vector in enumerate(walk)}
        where, pairs = active | truth, _same_places(truth, active, s)
        links = [link_between(a, b, where[a].inverse() @ where[b], rng) for a, b in pairs]
        true = frozenset(pairs)
        wanted = round(len(links) * s.false_share / (1.0 - s.false_share))
        links += _false_links(truth, active, true, wanted, s, rng)
        shuffled = tuple(links[k] for k in rng.permutation(len(links)))
        covered = {a for a, b in pairs if a in active}
        past |= covered
        map_id = MapId(ROBOT, epoch)
        yield Drive(map_id, map_of(map_id, walk, rng), shuffled, true, truth, frozenset(past))
        active = {node: pose for node, pose in where.items() if node not in covered}


def _same_places(
    truth: dict[NodeId, Pose2], active: dict[NodeId, Pose2], s: DriveSettings
) -> list[tuple[NodeId, NodeId]]:
    """Pairs of nodes that show the same place: of a node the nearest few of each drive."""
    candidates = active | truth
    positions, names = np.array([pose.vector for pose in candidates.values()]), list(candidates)
    pairs: set[tuple[NodeId, NodeId]] = set()
    for node, pose in truth.items():
        distance = np.hypot(positions[:, 0] - pose.x, positions[:, 1] - pose.y)
        turn = np.abs((positions[:, 2] - pose.heading + math.pi) % math.tau - math.pi)
        drawn: Counter[MapId] = Counter()
        close = np.flatnonzero((distance < s.floor.same) & (turn < math.radians(30.0)))
        for k in close[np.argsort(distance[close])].tolist():
            candidate = names[k]
            loop = candidate.map == node.map
            if drawn[candidate.map] < s.most and not (
                loop and abs(candidate.number - node.number) < s.floor.apart
            ):
                drawn[candidate.map] += 1
                pairs.add((min(node, candidate), max(node, candidate)))
    return sorted(pairs)


def _false_links(
    truth: dict[NodeId, Pose2],
    active: dict[NodeId, Pose2],
    taken: Set[tuple[NodeId, NodeId]],
    wanted: int,
    s: DriveSettings,
    rng: np.random.Generator,
) -> list[Link]:
    """Perceptual aliasing: nodes of this drive seem to be near some of earlier drives."""
    linked, names, links = set(taken), sorted(active), list[Link]()
    while len(links) < wanted and names:
        a, b = names[int(rng.integers(len(names)))], sorted(truth)[int(rng.integers(len(truth)))]
        if active[a].distance(truth[b]) < 2.0 * s.floor.same:
            continue
        seeming = Pose2.from_vector(rng.uniform([-0.7, -0.7, -0.5], [0.7, 0.7, 0.5]))
        moved = active[a] @ seeming @ truth[b].inverse()
        for k in range(int(rng.integers(1, s.floor.most_alike + 1))):
            first, second = (NodeId(node.agent, node.epoch, node.number + k) for node in (a, b))
            if first in active and second in truth and (first, second) not in linked and len(links) < wanted:
                linked.add((first, second))
                links.append(
                    link_between(first, second, active[first].inverse() @ moved @ truth[second], rng)
                )
    return links
