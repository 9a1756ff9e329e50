"""Maps for others' tools: g2o, TUM, GraphML, and the route graphs of Nav2."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np

from mapweave.evaluation.map_score import write_tum
from mapweave.formats.g2o import G2oEdge, G2oGraph, write_g2o
from mapweave.formats.graph import graph_of
from mapweave.formats.map_part import MapPart
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.reachability_cache import ReachabilityCache
from mapweave.hybridmap.route import RouteSettings, edge_cost
from mapweave.mapserver.roadmap import IMPLIED, Roadmap
from mapweave.mapserver.routes import NEAR
from mapweave.storage.atomic_file import write_whole

FRAME = "map"
"""What Nav2 calls the frame in which it plans."""


def export_g2o(part: MapPart, out: Path) -> list[Path]:
    """The pose graph whose optimum is the map. Comments give the node of each vertex."""
    numbers = part.numbers
    edges = [
        G2oEdge.measured(numbers[m.a], numbers[m.b], m.a_from_b.mean, m.covariance) for m in part.measurements
    ]
    poses = {numbers[node]: part.pose(node) for node in part.nodes}
    names = {numbers[node]: str(node) for node in part.nodes}
    write_g2o(out, G2oGraph(poses, edges, (0,)), names)
    return [out]


def export_tum(part: MapPart, out: Path) -> list[Path]:
    """Each robot's nodes as a trajectory, by time. Several maps have files of their own, in a folder."""
    by_map: dict[MapId, list[NodeId]] = {}
    for node in part.nodes:
        by_map.setdefault(node.map, []).append(node)
    if len(by_map) > 1:
        out.mkdir(parents=True, exist_ok=True)
    written = []
    for map_id, nodes in by_map.items():
        path = out / f"{map_id}.tum" if len(by_map) > 1 else out
        nodes.sort(key=lambda node: (part.node(node).stamp_ns, node))
        stamps = np.array([part.node(node).stamp_ns for node in nodes], np.int64)
        write_tum(path, stamps, np.stack([part.pose(node).vector for node in nodes]))
        written.append(path)
    return written


def export_graphml(part: MapPart, out: Path) -> list[Path]:
    """Places and edges with their numbers, for networkx, Gephi, yEd and the like."""
    placed = {node: (part.component, part.pose(node)) for node in part.nodes}
    graph = graph_of(part.graph.nodes, placed, part.graph.edges.values(), partial(_link_numbers, part))
    text = io.BytesIO()
    nx.write_graphml(graph, text)
    write_whole(out, text.getvalue())
    return [out]


def export_geojson(part: MapPart, out: Path) -> list[Path]:
    """A route graph as Nav2's route server loads it: points, and a line for each direction of an edge.

    Ids are unique over nodes and edges, as Nav2 wants them. The edges are those of our own routes, at
    the same cost: edges that only constrain poses are left out, and nodes at one place are joined.
    """
    roads = Roadmap(part.merged, NEAR, ReachabilityCache())
    places = {node: part.pose(node) for node in part.nodes}
    features: list[dict[str, Any]] = []
    for node, number in part.numbers.items():
        metadata = {"node": str(node), "heading": places[node].heading}
        features.append({
            "type": "Feature",
            "properties": {"id": number, "frame": FRAME, "metadata": metadata},
            "geometry": {"type": "Point", "coordinates": _point(places[node])},
        })  # fmt: skip
    number = len(part.numbers)
    for edge in roads.union.edges.values():
        if edge.a not in places or edge.b not in places or edge.id in roads.closed:
            continue
        cost = edge_cost(edge, places, True, RouteSettings())
        kind = edge.id.agent if edge.id.agent in IMPLIED else str(edge.kind)
        metadata = {"edge": str(edge.id), "kind": kind, **_link_numbers(part, edge)}
        for start, end in ((edge.a, edge.b), (edge.b, edge.a)):
            properties = {
                "id": number, "startid": part.numbers[start], "endid": part.numbers[end], "cost": cost,
                "overridable": True, "metadata": metadata,
            }  # fmt: skip
            line = [[_point(places[start]), _point(places[end])]]
            features.append({
                "type": "Feature",
                "properties": properties,
                "geometry": {"type": "MultiLineString", "coordinates": line},
            })  # fmt: skip
            number += 1
    text = json.dumps({"type": "FeatureCollection", "name": "graph", "features": features}, indent=1)
    write_whole(out, f"{text}\n".encode())
    return [out]


FORMATS: dict[str, Callable[[MapPart, Path], list[Path]]] = {
    "g2o": export_g2o,
    "tum": export_tum,
    "graphml": export_graphml,
    "geojson": export_geojson,
}
"""What each is called on the command line. They return what was written."""


def _link_numbers(part: MapPart, edge: Edge) -> dict[str, float]:
    numbers = {name: float(edge.evidence[name]) for name in ("inliers",) if name in edge.evidence}
    if edge.id in part.links:
        numbers["probability"] = part.probabilities[min(edge.a, edge.b), max(edge.a, edge.b)]
    return numbers


def _point(pose: Pose2) -> list[float]:
    return [float(pose.x), float(pose.y)]
