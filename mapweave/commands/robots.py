"""`mapweave robots`: list the drivers."""

import argparse
from typing import Any

from mapweave.commands.answer import add_json, print_answer


def add_to(commands: Any) -> None:
    """Declare the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "robots",
        help="list the drivers of robots",
        description="List the drivers with their robots and missing libraries. The settings file of a robot "
        'names its driver: [robot] driver = "koala". Your own driver is FILE.py:CLASS.',
    )
    add_json(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print one line per driver."""
    from mapweave.agent.drivers.registry import listing
    from mapweave.extras import extra_of, how_to_install

    robots = listing()
    listed = [
        {"name": r.name, "robots": r.line, "missing": r.missing or None, "error": r.error or None}
        for r in robots
    ]
    width, lines = max(len(robot.name) for robot in robots), []
    for robot in robots:
        line = robot.line
        if robot.missing:
            extra = extra_of(robot.missing)
            line = f"needs the library {robot.missing}"
            if extra is not None:
                line = f"needs the extra {extra!r}: {how_to_install(extra)}"
        elif robot.error:
            line = f"cannot be loaded: {robot.error}"
        lines.append(f"{robot.name:<{width}}  {line}")
    print_answer(arguments, {"drivers": listed}, lines)
    return 0
