"""`mapweave calibrate WHAT`: measure the robot."""

import argparse
from typing import Any

from mapweave.commands import calibrate_camera, calibrate_drive, calibrate_target


def add_to(commands: Any) -> None:
    """Declare the command and its actions."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "calibrate",
        help="measure how camera and wheels of a robot are mounted",
        description="Measure a robot: its camera's lens by a printed target, and how camera and wheels "
        "belong together by a drive.",
    )
    actions = parser.add_subparsers(title="what", metavar="WHAT", required=True)
    for action in (calibrate_camera, calibrate_target, calibrate_drive):
        action.add_to(actions)
