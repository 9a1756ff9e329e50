"""Merged maps as map files, and back: a file holds the parts, so that it can be explained or merged again."""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from mapweave.hybridmap.annotation import Annotations
from mapweave.hybridmap.change import EdgePut
from mapweave.hybridmap.errors import InvalidFile, InvalidValue
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraints
from mapweave.hybridmap.map_event import MapEvent
from mapweave.hybridmap.node import Edge
from mapweave.mapserver.own_maps import PROBABILITY, is_link, maps_of
from mapweave.merge.manual_constraints import apply_constraints
from mapweave.merge.outlier_rejection.link_probability import link_probabilities
from mapweave.merge.outlier_rejection.segmentation import fragments_of
from mapweave.merge.pose_graph.component_solver import ComponentSolver
from mapweave.merge.pose_graph.links import Link, RefusedLink, link_of
from mapweave.merge.pose_graph.map_scales import corrected_again
from mapweave.merge.pose_graph.merged_map import MergedMap, NodePoses
from mapweave.merge.pose_graph.pinned_frames import PinnedFrames
from mapweave.merge.settings import MergeSettings
from mapweave.storage.map_file import MapFile, RefusedPair


def map_file_of(
    merged: MergedMap,
    history: Iterable[MapEvent] = (),
    annotations: Annotations | None = None,
    images: Mapping[str, bytes] | None = None,
) -> MapFile:
    """A whole merged map: nodes, edges, links with their probabilities, refusals, manual constraints, poses.

    Args:
        merged: the map.
        history: events of its maps.
        annotations: what people say about it.
        images: PNG files of floor plans, by their names.
    """
    whole = merged.union()
    probabilities = link_probabilities(merged)
    for link in merged.links:
        edge = link.edge()
        evidence = {**edge.evidence, PROBABILITY: probabilities[link.pair]}
        whole.edges[edge.id] = replace(edge, evidence=evidence)
    return MapFile(
        "merged",
        merged.summary(),
        tuple(whole.contents()),
        merged.poses.all() if isinstance(merged.poses, NodePoses) else dict(merged.poses),
        tuple(RefusedPair(r.a, r.b, r.reason, _edge(merged, r)) for r in merged.refused),
        merged.constraints.made,
        merged.superseded,
        merged.faded,
        tuple(history),
        (annotations or Annotations()).made,
        _numbered(merged.constraints),
        dict(images or {}),
        dict(merged.refused_changes),
    )


def merged_of(content: MapFile, settings: MergeSettings | None = None) -> MergedMap:
    """The merged map that a file holds: links and refusals as they are, poses and covariances solved again.

    Nothing is judged again, so a file is explained by what was decided when it was made.

    Args:
        content: of the file.
        settings: with which it was merged.

    Raises:
        InvalidFile: its measurements determine no poses.
    """
    s = settings or MergeSettings()
    nodes = {node: content.constraints[number] for node, number in content.retired.items()}
    maps, constraints = maps_of(content), ManualConstraints(content.constraints, nodes)
    links = tuple(_links(change.edge for change in content.changes if isinstance(change, EdgePut)))
    refused = tuple(_refused(pair) for pair in content.refused)
    try:
        also = (refusal.link for refusal in refused if refusal.link is not None)
        corrected = corrected_again(apply_constraints(maps, (), constraints).maps, links, also)
        solved = ComponentSolver(fragments_of(corrected[0], s.consistency)).solve(corrected[1])
    except (np.linalg.LinAlgError, RuntimeError, InvalidValue) as error:
        # The solver raises RuntimeError if a system is singular.
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InvalidFile(f"the poses of this map cannot be solved ({reason})") from None
    # Covariances are solved for where they are asked for: of a large map, all take minutes.
    poses = NodePoses(solved)
    components = tuple(frozenset(graph.nodes) for graph in solved)
    superseded = {node: fate for node, fate in content.superseded.items() if node in poses}
    faded = {node: mask for node, mask in content.faded.items() if node in poses}
    merged = MergedMap(
        dict(sorted(maps.items())),
        links,
        refused,
        components,
        poses,
        tuple(solved),
        constraints,
        superseded,
        faded,
        refused_changes=content.refused_changes,
    )
    return PinnedFrames().moved(merged, Annotations(content.annotations).pins)


def _numbered(constraints: ManualConstraints) -> dict[NodeId, int]:
    """Retired nodes with the numbers of their constraints."""
    number = {constraint: k for k, constraint in enumerate(constraints.made)}
    return {node: number[constraint] for node, constraint in constraints.nodes.items()}


def _links(edges: Iterable[Edge]) -> list[Link]:
    links = []
    for edge in edges:
        if is_link(edge):
            evidence = {name: value for name, value in edge.evidence.items() if name != PROBABILITY}
            links.append(link_of(replace(edge, evidence=evidence)))
    return sorted(links, key=lambda link: link.pair)


def _edge(merged: MergedMap, refused: RefusedLink) -> Edge | None:
    if refused.edge is not None:
        return merged.maps[refused.edge.map].edges[refused.edge]
    return None if refused.link is None else refused.link.edge()


def _refused(pair: RefusedPair) -> RefusedLink:
    if pair.edge is None:
        return RefusedLink(pair.a, pair.b, pair.reason)
    return RefusedLink(
        pair.a, pair.b, pair.reason, link_of(pair.edge), None if is_link(pair.edge) else pair.edge.id
    )
