"""`mapweave demo`: everything at once, in simulation."""

import argparse
import json
from pathlib import Path
from typing import Any

from mapweave.commands import values
from mapweave.commands.usage import UsageError
from mapweave.exit_status import DONE, NO


def add_to(commands: Any) -> None:
    """Declare the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "demo",
        help="three robots, one map, one lost robot found",
        description="Start a map server, a simulator and several agents as processes. Each robot explores "
        "and maps its part of an office; the server merges the maps; then one robot is kidnapped, asks where "
        "it is, and drives to a node that another robot mapped. Exit status 0: it arrived; 4: it did not.",
    )
    parser.add_argument("--seed", type=values.seed, default=0, help="other seeds, other worlds (default: 0)")
    parser.add_argument("--robots", type=int, default=3, help="how many (default: 3)")
    parser.add_argument("--rooms", type=int, default=3, help="rooms along the corridor (default: 3)")
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        default=Path("out/demo"),
        help="folder for map.png, report.json ... (default: out/demo)",
    )
    parser.add_argument("--json", action="store_true", help="print the report as one JSON object")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run the demo and print what came of it."""
    from mapweave.extras import TRIAL, need

    need(*TRIAL)
    from mapweave.demo.report import summary_table
    from mapweave.demo.run import run_demo
    from mapweave.scenarios.run import TrialOptions
    from mapweave.terminal import plain_or_terminal

    for option, least, most in (("robots", 2, 16), ("rooms", 3, 12)):
        if not least <= (count := getattr(arguments, option)) <= most:
            raise UsageError(f"--{option} {count}: the demo needs {least} to {most}")
    report = run_demo(TrialOptions(arguments.seed, arguments.out), arguments.robots, arguments.rooms)
    if arguments.json:
        print(json.dumps(report))
    else:
        console = plain_or_terminal(stderr=False)
        console.print(summary_table(report))
        console.print(
            f"in {arguments.out}: map.png, film.webm, report.md, report.json, merged.mapweave, "
            "and a map file of each robot"
        )
    return DONE if report["goal"]["reached"] else NO
