"""`mapweave map show`: what is in a map."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapweave.commands import values
from mapweave.commands.answer import print_answer
from mapweave.commands.map_input import SOURCES, map_source, merged_with_progress, opened
from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.errors import InvalidFile

if TYPE_CHECKING:
    from mapweave.hybridmap.ids import NodeId
    from mapweave.hybridmap.pose import Pose2
    from mapweave.storage.map_file import MapFile


def add_to(actions: Any) -> None:
    """Declare the action."""
    show: argparse.ArgumentParser = actions.add_parser(
        "show",
        help="summary and picture of a map",
        description="Check a map, print a summary and draw a picture of it next to it. The content hash is "
        "the same for the same map, whatever file it is in. A robot's own map is drawn with its loop "
        "closures applied; a store, and a journal of several maps, is merged first.",
    )
    show.add_argument("file", type=map_source, help=SOURCES)
    show.add_argument(
        "-o", "--out", type=values.png, metavar="PNG", help="picture (default: next to the file, as .png)"
    )
    show.add_argument(
        "--component", type=int, default=0, metavar="N",
        help="which part that is one is drawn (default: 0, the largest)",
    )  # fmt: skip
    show.add_argument("--no-picture", action="store_true", help="summary only")
    show.add_argument("--json", action="store_true", help="print the summary as one JSON object")
    show.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print the summary, draw the picture."""
    import numpy as np

    from mapweave.drawing.map_picture import MapPicture, draw_map
    from mapweave.extras import MissingExtra, need
    from mapweave.hybridmap.hybrid_map import HybridMap
    from mapweave.hybridmap.manual_constraint import ManualConstraints
    from mapweave.hybridmap.node import EdgeKind
    from mapweave.mapserver.content_hash import content_hash
    from mapweave.refusals import check_component

    if arguments.out is not None and not arguments.no_picture:
        need("viz")
    source = opened(arguments.file)
    if not arguments.no_picture:
        try:
            need("viz")
        except MissingExtra as missing:
            # The summary is what most want to know: it needs nothing.
            print(f"mapweave: the picture {missing}", file=sys.stderr)
            arguments.no_picture = True
    content, placed = source.content, source.content.poses
    hybrid = HybridMap(content.changes)
    if content.kind == "agent":
        try:
            need("server")
        except MissingExtra as missing:
            print(
                f"mapweave: poses are as the robot drove: to apply loop closures {missing}", file=sys.stderr
            )
            parts = enumerate(hybrid.components())
            placed = {n: (k, hybrid.nodes[n].map_from_robot) for k, part in parts for n in part}
        else:
            merged = merged_with_progress(source)
            content, placed = source.file(merged), merged.poses
            hybrid = HybridMap(content.changes)
    # Components have frames of their own; only one can be drawn without pretending.
    sizes = Counter(component for component, _ in placed.values())
    poses = {n: p.mean for n, (c, p) in placed.items() if c == arguments.component}
    if sizes:
        check_component(arguments.component, len(sizes))
    landmarks = [len(n.landmarks) for n in hybrid.nodes.values()]
    kinds: dict[str, int] = {}
    for edge in hybrid.edges.values():
        kinds[str(edge.kind)] = kinds.get(str(edge.kind), 0) + 1
    summary = {
        "file": str(source.path),
        "source": str(source.source),
        "kind": content.kind,
        "title": content.title,
        "content_hash": content_hash(content),
        "bytes": source.path.stat().st_size if isinstance(source.path, Path) else None,
        "maps": sorted({str(n.map) for n in hybrid.nodes}),
        "nodes": len(hybrid.nodes),
        "superseded": len(content.superseded),
        "edges": kinds,
        "links": sum(e.kind is EdgeKind.MERGED for e in hybrid.edges.values()),
        "refused": sum(pair.edge is not None for pair in content.refused),
        "constraints": len(ManualConstraints(content.constraints).in_force),
        "components": len(sizes),
        "landmarks_per_node_median": float(np.median(landmarks)) if landmarks else 0.0,
    }
    if not arguments.no_picture and poses:
        beside = source.path if isinstance(source.path, Path) else Path(source.name.rpartition("/")[2])
        out = arguments.out or beside.with_suffix(".png")
        components = [
            poses[n.id].apply(n.points_in_robot[n.landmarks.has_depth, :2])
            for n in hybrid.nodes.values()
            if n.id in poses
        ]
        points = np.concatenate(components) if components else np.zeros((0, 2))
        title = content.title
        if len(poses) < len(hybrid.nodes):
            which = f"component {arguments.component}" if len(sizes) > 1 else "what is in use"
            title += f"\ndrawn: {which}, {len(poses)} of {len(hybrid.nodes)} nodes"
            summary["drawn"] = f"{which}, {counted(len(poses), 'node')}"
        edges, places = list(hybrid.edges.values()), _places(content, poses)
        try:
            draw_map(MapPicture(title, poses, edges, landmarks=points, places=places), out)
            summary["picture"] = str(out)
        except InvalidFile as error:
            if arguments.out is not None:
                raise
            # A map may lie where nothing can be written; its summary is what most want to know.
            summary.pop("drawn", None)
            print(f"mapweave: {error}; give -o PNG, or --no-picture", file=sys.stderr)
    # A database has no size of a file.
    known = {key: value for key, value in summary.items() if value is not None}
    lines = (f"{key.replace('_', ' '):26} {_text(value)}" for key, value in known.items())
    print_answer(arguments, summary, lines)
    return 0


def _places(content: MapFile, poses: Mapping[NodeId, Pose2]) -> dict[str, tuple[float, float]]:
    """Named places that are in the picture: a node, or the middle of an area."""
    from mapweave.hybridmap.annotation import Annotations, Place

    places = {}
    for entry, place in Annotations(content.annotations).in_force(Place):
        at = poses.get(place.anchor)
        if at is not None:
            x, y = at.vector[:2] if place.area is None else place.area.polygon(at).mean(axis=0)
            places[entry.name] = float(x), float(y)
    return places


def _text(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{count} {kind}" for kind, count in value.items()) or "none"
    return ", ".join(value) if isinstance(value, list) else str(value)
