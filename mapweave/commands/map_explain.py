"""`mapweave map explain`: why nodes or maps are linked, or are not."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapweave.commands.map_input import SOURCES, map_source, merged_with_progress, opened
from mapweave.commands.network import add_network

if TYPE_CHECKING:
    from mapweave.hybridmap.explanation import FleetExplanation, PairExplanation
    from mapweave.hybridmap.node import MapId, NodeId
    from mapweave.merge.pose_graph.merged_map import MergedMap
    from mapweave.merge.settings import MergeSettings


def add_to(actions: Any) -> None:
    """Declare the action."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "explain",
        help="why two nodes or two maps are linked, or are not",
        description="Explain why two nodes (r0.1.17 r1.1.5) are linked or not, or why two maps (r0.1 r1.1) "
        "are one or are not, with every number behind it; without ends, of each two maps. A running server "
        "is asked, or a map file. A named place may be given instead of a node.",
    )
    parser.add_argument("ends", nargs="*", metavar="NODE|MAP", help="two nodes or two maps")
    parser.add_argument(
        "--map", type=map_source, metavar="FILE", help=f"explain {SOURCES}; no server is asked"
    )
    parser.add_argument("--draw", type=Path, metavar="PNG", help="draw the landmarks of the two nodes")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--timeout", type=float, default=20.0, metavar="S", help="longest wait for an answer")
    add_network(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Ask, print, draw."""
    from mapweave.commands.map_ends import ends_of, resolved
    from mapweave.explanation_text import maps_words, pair_words
    from mapweave.extras import need
    from mapweave.hybridmap.constraint_subject import EXAMPLE
    from mapweave.hybridmap.errors import InvalidValue
    from mapweave.hybridmap.node import MapId, NodeId
    from mapweave.mapserver.http.json_values import json_values

    if arguments.draw is not None:
        need("viz")
    ends = ends_of(resolved(arguments, arguments.ends)) if arguments.ends else None
    first, second = ends or (None, None)
    if isinstance(first, NodeId) and isinstance(second, NodeId):
        pair = explained_nodes(arguments, first, second)
        values, lines = json_values(pair), pair_words(pair)
        if arguments.draw is not None:
            from mapweave.drawing.link_picture import draw_link

            draw_link(pair, arguments.draw)
            values["picture"] = str(arguments.draw)
            lines.append(f"  picture       {arguments.draw}")
    else:
        if arguments.draw is not None:
            raise InvalidValue(f"--draw needs two nodes: {EXAMPLE}")
        maps = None if ends is None else (MapId(*ends[0][:2]), MapId(*ends[1][:2]))
        explanation = explained_maps(arguments, maps)
        values = json_values(explanation)
        lines = [line for item in explanation.maps for line in maps_words(item)]
        lines = [*lines, *explanation.accusations] or ["there are no two maps"]
    print(json.dumps(values) if arguments.json else "\n".join(lines))
    return 0


def explained_nodes(arguments: argparse.Namespace, a: NodeId, b: NodeId) -> PairExplanation:
    """Two nodes of a map file, or of what a server has."""
    from mapweave.commands.map_ends import ask
    from mapweave.hybridmap.explanation import PairExplanation
    from mapweave.hybridmap.query import ExplainRequest
    from mapweave.wire.keys import Keys
    from mapweave.wire.messages import decode, encode

    if arguments.map is None:
        request = encode(ExplainRequest((a, b)))
        return decode(ask(arguments, Keys.any_explain, request)[0].payload, PairExplanation)
    from mapweave.merge.explanation.node_explanation import explain_nodes

    merged, settings = _merged(arguments)
    return explain_nodes(merged, a, b, None, settings.consistency)


def explained_maps(arguments: argparse.Namespace, ends: tuple[MapId, MapId] | None) -> FleetExplanation:
    """Two maps of a map file, or of what a server has; each two of them without ends."""
    from mapweave.commands.map_ends import ask
    from mapweave.hybridmap.explanation import MAX_MAPS_LISTED, FleetExplanation
    from mapweave.hybridmap.query import ExplainRequest
    from mapweave.wire.keys import Keys
    from mapweave.wire.messages import decode, encode

    if arguments.map is None:
        request = encode(ExplainRequest(ends))
        return decode(ask(arguments, Keys.any_explain, request)[0].payload, FleetExplanation)
    from mapweave.merge.explanation.map_explanation import explain_fleet, explain_maps

    merged, _ = _merged(arguments)
    if ends is None:
        accusations = tuple(merged.accusations().values())[:MAX_MAPS_LISTED]
        return FleetExplanation(explain_fleet(merged, MAX_MAPS_LISTED), accusations)
    return FleetExplanation((explain_maps(merged, *ends),))


def _merged(arguments: argparse.Namespace) -> tuple[MergedMap, MergeSettings]:
    """The merged map of a file, and the settings with which it is explained."""
    from mapweave.commands.network import settings_of

    settings = settings_of(arguments).merge
    return merged_with_progress(opened(arguments.map), settings), settings
