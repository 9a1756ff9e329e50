"""What is different between two maps, for example before and after a merge."""

import math
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from mapweave.evaluation.map_score import align
from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.manual_constraint import event_words
from mapweave.hybridmap.pose import wrap_angle
from mapweave.mapserver.map_history import between
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.storage.map_file import MapFile
from mapweave.wire.codec import encode_body

Pair = tuple[NodeId, NodeId]
NAMED = 8
"""Nodes or links of one kind that are named; of more the number is given."""


@dataclass(frozen=True)
class Moved:
    """How nodes moved that were in one component and are in one now.

    Frames of components say nothing: what is compared is aligned first (least squares, no scale).

    Attributes:
        nodes: how many.
        median: of their ways, m.
        largest: the longest way, m.
        turn: the largest turn, rad.
        node: which moved furthest.
    """

    nodes: int
    median: float
    largest: float
    turn: float
    node: NodeId


@dataclass(frozen=True)
class MapDifference:
    """What changed from one map to another.

    Attributes:
        added: nodes that are new, in order; so below.
        removed: nodes that are gone, as when they are retired.
        superseded: nodes that are superseded now.
        revived: nodes that no longer are.
        moved: of each component before and after with nodes in common, the largest first.
        linked: pairs of nodes that are linked now.
        unlinked: pairs that no longer are.
        events: which maps became one, or came apart, and why.
    """

    added: tuple[NodeId, ...]
    removed: tuple[NodeId, ...]
    superseded: tuple[NodeId, ...]
    revived: tuple[NodeId, ...]
    moved: tuple[Moved, ...]
    linked: tuple[Pair, ...]
    unlinked: tuple[Pair, ...]
    events: tuple[str, ...]

    def values(self) -> dict[str, Any]:
        """The difference for `json.dumps`."""

        def nodes(some: Iterable[NodeId]) -> list[str]:
            return [str(node) for node in some]

        return {
            **{name: nodes(getattr(self, name)) for name in ("added", "removed", "superseded", "revived")},
            "moved": [
                {
                    "nodes": m.nodes,
                    "median": m.median,
                    "largest": m.largest,
                    "turn": m.turn,
                    "node": str(m.node),
                }
                for m in self.moved
            ],
            "linked": [nodes(pair) for pair in self.linked],
            "unlinked": [nodes(pair) for pair in self.unlinked],
            "events": list(self.events),
        }

    def words(self) -> list[str]:
        """Lines for people; none if nothing is different."""
        named = (
            (self.added, "node", "added"), (self.removed, "node", "removed"),
            (self.superseded, "node", "superseded now"), (self.revived, "node", "in use again"),
            ([f"{a} - {b}" for a, b in self.linked], "link", "added"),
            ([f"{a} - {b}" for a, b in self.unlinked], "link", "removed"),
        )  # fmt: skip
        lines = list(self.events)
        for items, noun, what in named:
            if items:
                more = f" and {len(items) - NAMED} more" if len(items) > NAMED else ""
                listed = ", ".join(str(item) for item in items[:NAMED])
                lines.append(f"{counted(len(items), noun)} {what}: {listed}{more}")
        lines += [
            f"{counted(m.nodes, 'node')} moved by {m.median:.3f} m (median), "
            f"at most {m.largest:.3f} m ({m.node}), turned by at most {math.degrees(m.turn):.1f} degrees"
            for m in self.moved
            if m.largest >= 0.001 or m.turn >= 0.001
        ]
        return lines


def decided(before: MapFile, after: MapFile) -> list[str]:
    """What people decided and said about one map and not about the other, as lines for people."""
    old, new = (
        [(one, event_words(one)) for one in content.constraints]
        + [(one, one.words) for one in content.annotations]
        for content in (before, after)
    )
    lines = [f"new: {words}" for one, words in new if (one, words) not in old]
    lines += [f"not in the record: {words}" for one, words in old if (one, words) not in new]
    return lines


def in_content(before: MapFile, after: MapFile) -> str:
    """Which nodes and edges two maps do not have alike, in words; empty if they have."""
    maps = [HybridMap(one.changes) for one in (before, after)]
    old, new = (
        {f"node {name}": encode_body(NodePut(node)) for name, node in one.nodes.items()}
        | {f"edge {name}": encode_body(EdgePut(edge)) for name, edge in one.edges.items()}
        for one in maps
    )
    different = sorted(name for name in old.keys() | new.keys() if old.get(name) != new.get(name))
    more = f" and {len(different) - NAMED} more" if len(different) > NAMED else ""
    return ", ".join(different[:NAMED]) + more


def difference(before: MergedMap, after: MergedMap) -> MapDifference:
    """Compare two maps."""
    links = [{link.pair for link in merged.links} for merged in (before, after)]
    old, new = before.poses.keys(), after.poses.keys()
    gone, here = before.superseded.keys(), after.superseded.keys()
    return MapDifference(
        tuple(sorted(new - old)),
        tuple(sorted(old - new)),
        tuple(sorted(here - gone)),
        tuple(sorted((gone - here) & new)),
        tuple(_moved(before, after)),
        tuple(sorted(links[1] - links[0])),
        tuple(sorted(links[0] - links[1])),
        tuple(event.words for event in between(before, after, 0)),
    )


def _moved(before: MergedMap, after: MergedMap) -> list[Moved]:
    together: dict[tuple[int, int], list[NodeId]] = defaultdict(list)
    for node in sorted(before.poses.keys() & after.poses.keys()):
        together[before.poses[node].component, after.poses[node].component].append(node)
    moved = []
    for nodes in together.values():
        if len(nodes) < 2:
            continue
        a, b = (
            np.array([merged.poses[node].merged_from_robot.mean.vector for node in nodes])
            for merged in (before, after)
        )
        aligned = align(a[:, :2], b[:, :2])
        ways = np.linalg.norm(aligned.apply(a[:, :2]) - b[:, :2], axis=1)
        turns = [abs(wrap_angle(p + aligned.heading - q)) for p, q in zip(a[:, 2], b[:, 2], strict=True)]
        furthest = int(ways.argmax())
        moved.append(
            Moved(
                len(nodes), float(np.median(ways)), float(ways[furthest]), float(max(turns)), nodes[furthest]
            )
        )
    return sorted(moved, key=lambda one: -one.nodes)
