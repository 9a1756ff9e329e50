"""What an annotation would do to a map, in words, for a person who has not said it yet."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mapweave.hybridmap.annotation import Annotation, Annotations, Closure, Floor, Place, Preference
from mapweave.hybridmap.area import Area
from mapweave.hybridmap.counted import counted
from mapweave.mapserver.places import Places
from mapweave.mapserver.route_rules import RouteRules
from mapweave.merge.pose_graph.merged_map import MergedMap


def effects_of(annotation: Annotation, places: Places) -> Iterator[str]:
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
        case Closure() | Preference() as body:
            # A closure of tomorrow has no effect now: at its beginning it has the one that is meant.
            when = (body.begin_ns or 0) if isinstance(body, Closure) else annotation.stamp_ns
            rules = RouteRules(places.router.roads, Annotations((annotation,)), when)
            verb = "closes" if isinstance(body, Closure) else "holds for"
            yield f"it {verb} {counted(len(rules.closed or rules.factors), 'way')} of robots"
        case Floor(node, label):
            floors = {**places.annotations.floors, node.map: label}
            apart = sum(
                node.map in link.maps and floors.get(link.a.map, label) != floors.get(link.b.map, label)
                for link in places.merged.links
            )
            if apart:
                yield f"{counted(apart, 'link')} between this map and maps on other floors"
    before = places.annotations.last(annotation.kind, annotation.name)
    if before is not None:
        yield f"it takes the place of: {before.words}"


def _nodes_in(area: Area, merged: MergedMap) -> int:
    number = merged.component_of(area.anchor)
    assert number is not None, "the annotation is checked"
    graph = merged.graphs[number]
    points = merged.pose(area.anchor).inverse().apply(np.asarray(graph.means)[:, :2])
    return int(area.contains(points).sum())
