"""Nodes for words: named places and positions in a merged map, and the names of where something is."""

from __future__ import annotations

import difflib
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from mapweave.hybridmap.annotation import Annotation, Annotations, Place
from mapweave.hybridmap.area import inside
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.portal import MAX_FLOOR_WORDS
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import (
    REACH,
    RelocalizeAnswer,
    ResolveAnswer,
    Resolved,
    ResolveRequest,
)
from mapweave.merge.floors import labels_of

if TYPE_CHECKING:
    # Programs that only give names of places need none of the server's libraries.
    from mapweave.mapserver.routes import Router
    from mapweave.merge.pose_graph.merged_map import MergedMap

FAR = 1e6
"""m; of a longer distance the digits say nothing."""
NEARBY = 1.5
"""A place that is a node reaches so far, m: a robot there sees the same as from the node."""
MOST_NAMES = 20
"""That a refusal gives."""
FORMS = "give a node (r0.1.17), the name of a place, or a position in the merged map (3.1,-2.0)"


class PlaceResolver:
    """Resolves named places and node ids on one merged map. Cheap to make; works out only what is asked."""

    def __init__(self, router: Router, annotations: Annotations) -> None:
        self.router = router
        self.annotations = annotations

    @property
    def merged(self) -> MergedMap:
        """The merged map."""
        return self.router.merged

    def answer(self, request: ResolveRequest) -> ResolveAnswer:
        """Nodes for words.

        Raises:
            InvalidValue: a word is none, with the reason.
        """
        component = 0
        if request.near:
            component = self.resolve(request.near).component
        return ResolveAnswer(
            tuple(self.resolve(word.strip(), component, request.reach) for word in request.words)
        )

    def resolve(self, word: str, component: int = 0, reach: float = REACH) -> Resolved:
        """A node for a word.

        Args:
            word: a node, the name of a place, or a position.
            component: in whose frame a position is.
            reach: a position is refused if no node is nearer than this, m.

        Raises:
            InvalidValue: it is none, or nothing is there.
        """
        if (entry := self.annotations.last("place", word)) is not None:
            assert isinstance(entry.body, Place), "of this kind"
            return replace(self._placed(entry, entry.body), place=word)
        if (position := position_of(word)) is not None:
            return self._nearest(position, component, reach)
        try:
            node = NodeId.parse(word)
        except InvalidValue:
            raise InvalidValue(f"{word!r} is no place of this map{self.alike(word)}: {FORMS}") from None
        stands = self.merged.pruned.successor(node, self.merged.poses)
        if stands is not None and stands[0] != node:
            found = self.resolve(str(stands[0]))
            return replace(found, note=self.merged.pruned.words(node, self.merged.poses))
        self.merged.check(node)
        number = self.merged.component_of(node)
        if number is None:
            raise InvalidValue(f"node {node} is not in the merged map{why_left_out(self.merged, node)}")
        return Resolved(node, self.merged.pose(node), number)

    def name_at(self, component: int, pose: Pose2) -> str:
        """The name of the place at a pose in the merged map; empty if it has none.

        Of several the narrowest counts: an area by its size, a node by the circle around it to the pose.
        """
        point = np.array([[pose.x, pose.y]])
        best = math.inf, ""
        for entry, place in self.annotations.in_force(Place):
            if self.merged.component_of(place.anchor) != component:
                continue
            at = self.merged.pose(place.anchor)
            if place.area is not None:
                if inside(place.area.polygon(at), point)[0]:
                    best = min(best, (place.area.size, entry.name))
            elif (distance := at.distance(pose)) <= NEARBY:
                best = min(best, (math.pi * distance**2, entry.name))
        return best[1]

    def floor_of(self, component: int) -> str:
        """The floor of a component; empty if none is known. Of several, joined by hand, all that fit."""
        return " and ".join(labels_of(self.merged, self.annotations.floors, component))[:MAX_FLOOR_WORDS]

    def named(self, answer: RelocalizeAnswer) -> RelocalizeAnswer:
        """An answer to a lost robot, with the names of the places."""
        if not self.annotations.made:
            return answer
        candidates = []
        for candidate in answer.candidates:
            pose = candidate.merged_from_robot
            if pose is not None:
                number = candidate.component
                name, floor = self.name_at(number, pose.mean), self.floor_of(number)
                candidate = replace(candidate, place=name, floor=floor)
            candidates.append(candidate)
        return replace(answer, candidates=tuple(candidates))

    def _placed(self, entry: Annotation, place: Place) -> Resolved:
        """An active node for a place."""
        anchor = place.anchor
        component = self.merged.component_of(anchor)
        if component is None:
            return self._beside(entry, anchor)
        pose = self.merged.pose(anchor)
        if place.area is None:
            if anchor not in self.merged.superseded:
                return Resolved(anchor, pose, component)
            found = self._nearest((pose.x, pose.y), component, REACH, f"place {entry.name}")
            return replace(
                found,
                note=f"{anchor} is superseded by {self.merged.superseded[anchor].by}; "
                f"the nearest active node is {found.node}",
            )
        polygon = place.area.polygon(pose)
        nodes = self._active(component)
        at = np.array([(self.router.roads.poses[node].x, self.router.roads.poses[node].y) for node in nodes])
        within = inside(polygon, at) if nodes else np.zeros(0, bool)
        if not within.any():
            raise InvalidValue(f"place {entry.name} is {place.words}, in which no node is active")
        x, y = polygon.mean(axis=0)
        away = np.where(within, np.hypot(at[:, 0] - x, at[:, 1] - y), np.inf)
        node = nodes[int(away.argmin())]
        return Resolved(node, self.merged.pose(node), component)

    def _beside(self, entry: Annotation, anchor: NodeId) -> Resolved:
        """The nearest active node of the same robot's map to a node that takes no part in the merged map."""
        own, why = self.merged.maps.get(anchor.map), why_left_out(self.merged, anchor)
        gone = None if own is None else own.nodes.get(anchor)
        if own is not None and gone is not None:
            pose = gone.map_from_robot.mean
            active = self.router.roads.active_poses
            left = [node for node in own.nodes.values() if node.id in active]
            distance, node = min(
                ((pose.distance(node.map_from_robot.mean), node.id) for node in left),
                default=(math.inf, anchor),
            )
            if distance <= REACH:
                number = self.merged.component_of(node)
                assert number is not None, "an active node has a pose"
                note = f"{anchor} takes no part{why}; the nearest active node is {node}"
                return Resolved(node, self.merged.pose(node), number, note=note)
        raise InvalidValue(
            f"place {entry.name} is at {anchor}, which is not in the merged map{why}; "
            f"no active node of its map is within {REACH:g} m"
        )

    def _active(self, component: int) -> list[NodeId]:
        if not self.merged.components:
            return []
        active = self.router.roads.active_poses
        return sorted(node for node in self.merged.components[component] if node in active)

    def _nearest(
        self, position: tuple[float, float], component: int, reach: float, what: str = ""
    ) -> Resolved:
        """The active node that is nearest to a position."""
        poses, members = self.router.roads.active_poses, self._active(component)
        if not members:
            raise InvalidValue("the merged map has no nodes yet")
        x, y = position
        distance, node = min((math.hypot(poses[n].x - x, poses[n].y - y), n) for n in members)
        if distance > reach:
            away = f"{distance:.1f}" if distance < FAR else f"{distance:.0e}"
            raise InvalidValue(
                f"nothing is mapped within {reach:g} m of {what or f'{x:g},{y:g}'}: the nearest node is "
                f"{node}, {away} m away at {poses[node].x:.1f},{poses[node].y:.1f}"
            )
        return Resolved(node, poses[node], component)

    def alike(self, word: str) -> str:
        """Names that a mistyped one may be."""
        return _alike(word, [entry.name for entry, _ in self.annotations.in_force(Place)])


def others_of(word: str, names: Sequence[str]) -> str:
    """Names that may be meant by one that is none of these: else the first ones; empty if there is none."""
    if close := _alike(word, names):
        return close
    more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
    return f"; there are: {', '.join(names[:MOST_NAMES])}{more}" if names else ""


def _alike(word: str, names: Sequence[str]) -> str:
    close = difflib.get_close_matches(word, names, 3, 0.6)
    return f" (is it {' or '.join(close)}?)" if close else ""


def position_of(word: str) -> tuple[float, float] | None:
    """`3.1,-2.0`, m; None if it is no position.

    Raises:
        InvalidValue: a number is not finite.
    """
    try:
        x, y = map(float, word.split(","))
    except ValueError:
        return None
    if not (math.isfinite(x) and math.isfinite(y)):
        raise InvalidValue(f"{word!r}: {FORMS}")
    return x, y


def why_left_out(merged: MergedMap, node: NodeId) -> str:
    """See `MergedMap.why_left_out`; in parentheses behind a blank."""
    why = merged.why_left_out(node)
    return f" ({why})" if why else ""
