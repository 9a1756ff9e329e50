"""`mapweave map link`: two nodes see one place; or no longer by hand."""

from __future__ import annotations

import argparse
from typing import Any

from mapweave.commands.map_constraint import add_constraint_options, constrain
from mapweave.commands.usage import UsageError, arguments_read


def add_to(actions: Any) -> None:
    """Declare the action."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "link",
        help="link two nodes by hand: they see one place",
        description="Link two nodes (r0.1.17 r1.1.5) that see one place, of two maps or of one. Their images "
        "say how they lie to each other. Where these do not agree, that is refused with the evidence, unless "
        "you give the pose yourself (--pose) and say why (--because). What contradicts the merged map, or "
        "puts two robots in one place at one time, is refused with the figures and with what to undo first. "
        "The link stays, whatever robots map later; what contradicts it then is in `mapweave map history`.",
    )
    parser.add_argument("nodes", nargs=2, metavar="NODE|PLACE", help="the two nodes")
    parser.add_argument(
        "--pose", metavar="X,Y,DEGREES",
        help="the second node seen from the first: m ahead, m left, heading; if negative, --pose=-1,0,90",
    )  # fmt: skip
    add_constraint_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Set the constraint, and print its effect."""
    from mapweave.commands.map_ends import names_of, node_of
    from mapweave.hybridmap.constraint_subject import Linked, read_pose
    from mapweave.hybridmap.named_nodes import own_ids_of

    pose = None
    if arguments.pose is not None:
        try:
            numbers = [float(word) for word in arguments.pose.split(",")]
        except ValueError:
            raise UsageError(f"--pose {arguments.pose!r}: give X,Y,DEGREES, for example 1.5,0,90") from None
        with arguments_read():
            pose = read_pose(numbers)
    a, b = map(node_of, own_ids_of(arguments.nodes, *names_of(arguments)))
    with arguments_read():
        about = Linked(a, b, pose)
    constrain(arguments, about)
    return 0
