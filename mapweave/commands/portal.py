"""`mapweave portal done`: a robot that waits at a portal has been taken through."""

import argparse
from typing import Any

from mapweave.commands import values
from mapweave.commands.answer import add_json, print_said
from mapweave.commands.missions import fleet_of
from mapweave.commands.network import add_author, add_network


def add_to(commands: Any) -> None:
    """Declare the command and its action."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "portal",
        help="tell a robot that it has been taken through a portal",
        description="A robot whose way leads through a lift, a ramp or a door parks before it and asks to be "
        "taken through. `mapweave map portal` says where there are portals.",
    )
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)
    done: argparse.ArgumentParser = actions.add_parser(
        "done",
        help="the robot has been taken through the portal at which it waits",
        description="Tell a robot that it stands at the other side of the portal. It looks where it is, and "
        "goes on. The message goes to the robot directly, and works without a map server.",
    )
    done.add_argument("robot", type=values.name, help="the robot's name, for example r0")
    add_author(done)
    add_json(done)
    add_network(done)
    done.set_defaults(run=run_done)


def run_done(arguments: argparse.Namespace) -> int:
    """Tell the robot."""
    with fleet_of(arguments) as fleet:
        print_said(arguments, fleet.portal_done(arguments.robot), robot=arguments.robot)
    return 0
