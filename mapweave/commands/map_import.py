"""`mapweave map import`: a pose graph of others, optimised as the merge optimises."""

import argparse
import math
from pathlib import Path
from typing import Any

from mapweave.commands.answer import add_json, print_answer
from mapweave.commands.usage import UsageError
from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.errors import InvalidFile


def add_to(actions: Any) -> None:
    """Declare the action."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "import",
        help="optimise others' pose graph (g2o)",
        description="Read a planar pose graph (g2o), optimise it with the back end of the merge, write it "
        "again with the optimised poses. It has no landmarks, so it is no map that a robot could use; it "
        "shows how good the back end is.",
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="a .g2o file")
    parser.add_argument(
        "-o", "--out", type=Path, required=True, metavar="OUT", help="the optimised .g2o file"
    )
    add_json(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Read, optimise, write, print the improvement."""
    from dataclasses import replace

    import gtsam  # noqa: F401, where it is missing this says so before a file is read
    import numpy as np

    from mapweave.formats.g2o import read_g2o, write_g2o
    from mapweave.formats.g2o_optimum import optimum_of
    from mapweave.terminal import working

    if arguments.out.suffix == ".mapweave":
        raise UsageError(f"{arguments.out}: what is written is a pose graph, no map; end its name with .g2o")
    with working(f"reading {arguments.file.name}"):
        graph = read_g2o(arguments.file)
    with np.errstate(all="ignore"):
        before = graph.chi2()
    if not math.isfinite(before):
        raise InvalidFile(
            f"{arguments.file}: its numbers are too large to be added up: give metres and radians"
        )
    with working(f"optimising {counted(len(graph.edges), 'edge')}"):
        poses = optimum_of(graph)
    write_g2o(arguments.out, replace(graph, poses=poses))
    outcome = {
        "out": str(arguments.out),
        "vertices": len(poses),
        "edges": len(graph.edges),
        "chi2_before": before,
        "chi2": graph.chi2(poses),
    }
    words = (
        f"{arguments.out}: {len(poses)} vertices, {counted(len(graph.edges), 'edge')}, "
        f"chi-square {outcome['chi2_before']:.6g} before, {outcome['chi2']:.6g} now"
    )
    print_answer(arguments, outcome, [words])
    return 0
