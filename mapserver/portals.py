"""Portals of one merged map: ways between its parts through which people take robots."""

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

import networkx as nx
import numpy as np

from mapweave.hybridmap.annotation import Annotation, Annotations
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import EdgeId, NodeId
from mapweave.hybridmap.portal import MAX_FLOOR_WORDS, Portal, PortalMeans, PortalStop
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import REACH
from mapweave.merge.floors import floor_of
from mapweave.merge.link_checks import what_joins
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.settings import ConsistencySettings

PORTAL = "portal"
"""Takes the agent's place in the ids of portals in routes."""
MOST_DOOR = 4 * REACH
"""Between the nodes at the sides of a door, m. What is mapped has a node within `REACH`, so the two nodes
nearest to a door are twice that apart; as much again is for deep doorways, and for nodes farther off."""


class Portals:
    """The portals of which both sides are in the merged map.

    Attributes:
        merged: the map.
        edges: the two nodes of each portal, by its id in routes.
    """

    def __init__(self, merged: MergedMap, annotations: Annotations) -> None:
        self.merged = merged
        self._floors = annotations.floors
        self._portals = {
            EdgeId(PORTAL, 0, number): (entry, portal)
            for number, (entry, portal) in enumerate(annotations.in_force(Portal))
            if portal.a in merged.poses and portal.b in merged.poses
        }
        self._without_effect = [
            (entry, portal.a if portal.a not in merged.poses else portal.b)
            for entry, portal in annotations.in_force(Portal)
            if portal.a not in merged.poses or portal.b not in merged.poses
        ]
        self.edges: Mapping[EdgeId, tuple[NodeId, NodeId]] = {
            edge_id: (portal.a, portal.b) for edge_id, (_, portal) in self._portals.items()
        }

    def lead(self, start: NodeId, goal: NodeId) -> bool:
        """Whether portals join the components of two nodes, directly or over others."""
        ties: nx.Graph = nx.Graph()
        of = self.merged.component_of
        ties.add_nodes_from((of(start), of(goal)))
        ties.add_edges_from((of(a), of(b)) for a, b in self.edges.values())
        return bool(nx.has_path(ties, of(start), of(goal)))

    def floor(self, node: NodeId) -> str:
        """The label of the floor on which a node is; empty if it has none."""
        return floor_of(self.merged, self._floors, node)[:MAX_FLOOR_WORDS]

    def apart(self, start: NodeId, goal: NodeId) -> str:
        """That no way leads between two nodes whose components no portals join, in words."""
        first, second = self.floor(start), self.floor(goal)
        lost = ""
        if self._without_effect:
            entry, node = self._without_effect[0]
            why = self.merged.why_left_out(node)
            more = len(self._without_effect) - 1
            lost = f"; portal {entry.name} has no effect, as {node} is not in the merged map"
            lost += f"{f' ({why})' if why else ''}{f', and {more} more' if more else ''}"
        if first and second and first != second:
            return (
                f"{start} is on floor {first} and {goal} on floor {second}, and no portal leads there: "
                f"add the lift, ramp or door between them{lost}"
            )
        return f"{start} and {goal} are in parts of the map that nothing joins yet{lost}"

    def stops(self, nodes: Sequence[NodeId], edges: Sequence[EdgeId]) -> Iterator[tuple[int, PortalStop]]:
        """The portals on a way: the number of the edge, and the portal in the direction of the way."""
        for number, (pair, edge_id) in enumerate(zip(pairwise(nodes), edges, strict=True)):
            if edge_id in self._portals:
                entry, portal = self._portals[edge_id]
                floor = self.floor(pair[1])
                yield number, PortalStop(entry.name, portal.means, *pair, floor, portal.note)

    def between(self, a: NodeId, b: NodeId) -> tuple[Annotation, Portal] | None:
        """The portal between two nodes; None if there is none."""
        found = (one for one in self._portals.values() if {one[1].a, one[1].b} == {a, b})
        return next(found, None)


def check_portal(merged: MergedMap, annotations: Annotations, name: str, portal: Portal) -> None:
    """Refuse a portal that is a mistake.

    Raises:
        InvalidValue: a side is not in the merged map, the floors are not as they have to be, or it is there
            already.
    """
    floors = annotations.floors
    labels = []
    for node in (portal.a, portal.b):
        merged.check(node)
        if merged.component_of(node) is None:
            raise InvalidValue(f"node {node} is not in the merged map")
        labels.append(floor_of(merged, floors, node))
    for entry, other in annotations.in_force(Portal):
        if {other.a, other.b} == {portal.a, portal.b} and entry.name != name:
            raise InvalidValue(f"{portal.a} and {portal.b} are the two sides of {other.means} {entry.name}")
    first, second = labels
    if portal.means is PortalMeans.DOOR:
        if first and second and first != second:
            raise InvalidValue(
                f"a door has one floor at both sides, but {portal.a} is on floor {first} and {portal.b} on "
                f"floor {second}: is it a lift, or a ramp?"
            )
        _check_door(merged, portal)
        return
    for node, label in zip((portal.a, portal.b), labels, strict=True):
        if not label:
            raise InvalidValue(
                f"the floor of {node} has no label, and a {portal.means} leads to another floor: "
                "first say on which floor it is"
            )
    if first == second:
        raise InvalidValue(
            f"a {portal.means} leads to another floor, but {portal.a} and {portal.b} are on floor {first}"
        )


def _check_door(merged: MergedMap, door: Portal) -> None:
    """Refuse a door whose sides the map has too far apart: robots would be sent through a wall.

    Lifts and ramps lead to another floor, so the map does not say how far that is.

    Raises:
        InvalidValue: the evidence, and what would have to be undone first.
    """
    between = merged.relative(door.a, door.b)
    if between is None:
        return
    position, heading = between.mean.vector[:2], Pose2(0.0, 0.0, between.mean.heading).rotation
    distance = float(np.hypot(*position))
    if distance <= MOST_DOOR:
        return
    along = heading.T @ (position / distance)
    sigma = math.sqrt(float(along @ between.covariance[:2, :2] @ along))
    off, most = (distance - MOST_DOOR) / sigma, math.sqrt(ConsistencySettings().gate)
    if off > most:
        raise InvalidValue(
            f"no door is between {door.a} and {door.b}: the merged map has them {distance:.2f} m apart "
            f"(sigma {sigma:.2f} m), and the sides of a door are at most {MOST_DOOR:g} m apart: "
            f"{off:.1f} standard deviations more, at most {most:.1f} pass. "
            f"{what_joins(merged, door.a, door.b)}"
        )
