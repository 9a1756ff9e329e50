"""`mapweave map explain`: why nodes or maps are linked, or are not."""

import argparse
from typing import Any

from mapweave.commands import values
from mapweave.commands.annotating import record_of
from mapweave.commands.answer import add_json, print_answer
from mapweave.commands.map_input import SOURCES, map_source
from mapweave.commands.network import add_network
from mapweave.commands.usage import UsageError


def add_to(actions: Any) -> None:
    """Declare the action."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "explain",
        help="why two nodes or two maps are linked, or are not",
        description="Explain why two nodes (r0.1.17 r1.1.5) are linked or not, or why two maps (r0.1 r1.1) "
        "are one or are not, with every number behind it; without ends, of each two maps. A running server "
        "is asked, or a map file. A named place may be given instead of a node.",
    )
    parser.add_argument("ends", nargs="*", metavar="NODE|PLACE|MAP", help="two nodes or two maps")
    parser.add_argument(
        "--map", type=map_source, metavar="FILE", help=f"explain {SOURCES}; no server is asked"
    )
    parser.add_argument("--draw", type=values.png, metavar="PNG", help="draw the landmarks of the two nodes")
    add_json(parser)
    add_network(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Ask, print, draw."""
    from mapweave.commands.map_ends import check_ids, different_ends_of, noted
    from mapweave.explanation_text import maps_words, pair_words
    from mapweave.extras import need
    from mapweave.hybridmap.constraint_subject import EXAMPLE
    from mapweave.hybridmap.explanation import FleetExplanation, PairExplanation
    from mapweave.hybridmap.ids import NodeId
    from mapweave.hybridmap.named_nodes import ids_of
    from mapweave.hybridmap.query import ExplainRequest
    from mapweave.mapserver.http.json_values import json_values

    if arguments.draw is not None:
        need("viz")
    if arguments.ends:
        check_ids(arguments.ends, different_ends_of)
    with record_of(arguments) as record:
        words = ids_of(arguments.ends, noted(record.resolve))
        ends = different_ends_of(words) if words else None
        if arguments.draw is not None and not (ends and all(isinstance(end, NodeId) for end in ends)):
            raise UsageError(f"--draw needs two nodes: {EXAMPLE}")
        explanation = record.explained(ExplainRequest(ends))
    values = json_values(explanation)
    if isinstance(explanation, PairExplanation):
        lines = pair_words(explanation, dict(zip(words, arguments.ends, strict=True)))
        if arguments.draw is not None:
            from mapweave.drawing.link_picture import draw_link

            draw_link(explanation, arguments.draw)
            values["picture"] = str(arguments.draw)
            lines.append(f"  picture       {arguments.draw}")
    else:
        assert isinstance(explanation, FleetExplanation), "no route was asked for"
        lines = [line for item in explanation.maps for line in maps_words(item)]
        lines = [*lines, *explanation.accusations] or ["there are no two maps"]
    print_answer(arguments, values, lines)
    return 0
