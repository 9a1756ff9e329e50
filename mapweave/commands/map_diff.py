"""`mapweave map diff`: what is different between two maps."""

import argparse
from typing import Any

from mapweave.commands.answer import add_json, print_answer
from mapweave.commands.map_input import SOURCES, map_source, merged_with_progress, opened
from mapweave.exit_status import DONE, NO


def add_to(actions: Any) -> None:
    """Declare the action."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "diff",
        help="what is different between two maps",
        description="Say what changed from one map to another, as by a merge: nodes added, removed and "
        "superseded, how far the others moved, links, which maps became one or came apart, "
        "and what people decided and said: "
        "`mapweave map diff monday.mapweave tuesday.mapweave`. "
        "Exit status 0: they are the same; 4: they differ; 1: one cannot be read.",
    )
    parser.add_argument("before", type=map_source, metavar="A", help=SOURCES)
    parser.add_argument("after", type=map_source, metavar="B", help="another one")
    add_json(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Compare and print."""
    from mapweave.map_difference import decided, difference, in_content
    from mapweave.mapserver.content_hash import content_hash

    files, maps = [], []
    for path in (arguments.before, arguments.after):
        one = opened(path)
        maps.append(merged_with_progress(one))
        files.append(one.file(maps[-1]))
    same = content_hash(files[0]) == content_hash(files[1])
    found = difference(*maps)
    said = decided(*files)
    lines = ["the maps are the same"] if same else [*found.words(), *said]
    if not lines:
        which = in_content(*files) or "refusals"
        lines = [f"landmarks or edges differ, and nothing that follows: {which}"]
    print_answer(arguments, {"same": same, **found.values(), "decided": said}, lines)
    return DONE if same else NO
