"""`mapweave robots`: the drivers that there are."""

from __future__ import annotations

import argparse
from typing import Any


def add_to(commands: Any) -> None:
    """Declare the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "robots",
        help="list the drivers of robots",
        description="List the drivers: name, what it drives, and what is missing to use it. The name goes "
        'into the settings file of the robot, [robot] driver = "koala". Your own driver is FILE.py:CLASS.',
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print a line for each."""
    from mapweave.agent.drivers.registry import listing
    from mapweave.extras import extra_of

    robots = listing()
    width = max(len(robot.name) for robot in robots)
    for robot in robots:
        line = robot.line
        if robot.missing:
            extra = extra_of(robot.missing)
            line = f"needs the library {robot.missing}"
            if extra is not None:
                line = f"needs the extra {extra!r}: pip install 'mapweave[{extra}]'"
        elif robot.error:
            line = f"cannot be loaded: {robot.error}"
        print(f"{robot.name:<{width}}  {line}")
    return 0
