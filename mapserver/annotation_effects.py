"""What an annotation does to a map, and a retirement to annotations, for a person who has not said it yet."""

from collections.abc import Iterator

import numpy as np

from mapweave.hybridmap.annotation import Annotation, Annotations, Closure, Floor, Place, Preference
from mapweave.hybridmap.area import Area
from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.portal import Portal
from mapweave.mapserver.places import PlaceResolver
from mapweave.mapserver.route_rules import RouteRules
from mapweave.merge.floors import parted_by
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.retired_nodes import retired_nodes

MOST_LOST = 8
"""Of what loses its effect, so many are named."""


def effects_of(annotation: Annotation, places: PlaceResolver) -> Iterator[str]:
    """Counts of the nodes, ways or links that it is about, and the entry that it replaces.

    Args:
        annotation: not in the record yet; its nodes are in the merged map.
        places: of the newest merged map, with the record.
    """
    if annotation.removed:
        return
    match annotation.body:
        case Place(area=Area() as area):
            yield f"{counted(_nodes_in(area, places.merged), 'node')} in it"
        case Place(node=NodeId() as node) if node in places.merged.superseded:
            # The name stays where the node is; robots park at nodes that are in use.
            try:
                yield PlaceResolver(places.router, Annotations((annotation,))).resolve(annotation.name).note
            except InvalidValue as error:
                yield str(error)
        case Closure() | Preference() as body:
            # A closure of tomorrow has no effect now: at its beginning it has the one that is meant.
            when = (body.begin_ns or 0) if isinstance(body, Closure) else annotation.stamp_ns
            rules = RouteRules(places.router.roads, Annotations((annotation,)), when)
            verb = "closes" if isinstance(body, Closure) else "holds for"
            yield f"it {verb} {counted(len(rules.closed or rules.factors), 'way')} of robots"
        case Floor(node, label):
            if words := parted_by(places.merged, places.annotations.floors, node, label).words:
                yield words
    before = places.annotations.last(annotation.kind, annotation.name)
    if before is not None:
        yield f"it takes the place of: {before.words}"


def without_effect(constraint: ManualConstraint, merged: MergedMap, annotations: Annotations) -> str:
    """What of closures, preferences and portals a retirement leaves without effect, in words; or nothing.

    Args:
        constraint: not merged yet.
        merged: without it.
        annotations: the record.
    """
    if not constraint.holds:
        return ""
    alone = ManualConstraints([constraint])
    gone = retired_nodes(merged.maps, alone, merged.graphs)
    of = merged.component_of
    kinds = annotations.in_force(Closure), annotations.in_force(Preference), annotations.in_force(Portal)
    lost = [
        f"{entry.kind} {entry.name}"
        for entry, nodes in ((entry, nodes_of(body)) for kind in kinds for entry, body in kind)
        if any(node in gone or alone.retires(node) for node in nodes)
        and all(of(node) is not None for node in nodes)
    ]
    more = f" and {len(lost) - MOST_LOST} more" if len(lost) > MOST_LOST else ""
    return f"without effect as long as it holds: {', '.join(lost[:MOST_LOST])}{more}" if lost else ""


def nodes_of(body: Closure | Preference | Portal) -> tuple[NodeId, ...]:
    """The nodes by which something is known to be where: without one of them it has no effect."""
    if isinstance(body, Portal):
        return body.a, body.b
    return body.edge if body.edge is not None else (body.anchor,)


def _nodes_in(area: Area, merged: MergedMap) -> int:
    number = merged.component_of(area.anchor)
    assert number is not None, "the annotation is checked"
    graph = merged.graphs[number]
    points = merged.pose(area.anchor).inverse().apply(np.asarray(graph.means)[:, :2])
    return int(area.contains(points).sum())
