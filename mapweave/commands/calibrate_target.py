"""`mapweave calibrate target`: print the target for `mapweave calibrate camera`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapweave.commands.answer import add_json, print_said
from mapweave.commands.usage import UsageError, arguments_read

if TYPE_CHECKING:
    from mapweave.vision.calibration.target import CalibrationTarget


def add_to(actions: Any) -> None:
    """Declare the action."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "target",
        help="print the target for the camera's calibration",
        description="Write the calibration target as a PDF in its true size, with two rulers. Print it at "
        "100 %, check the rulers, and glue it to something flat.",
    )
    add_target(parser)
    parser.add_argument(
        "--paper",
        choices=["a4", "a3", "letter", "legal"],
        default="a4",
        help="size of the sheet (default: a4)",
    )
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        default=Path("board.pdf"),
        metavar="FILE",
        help="the PDF (default: board.pdf)",
    )
    add_json(parser)
    parser.set_defaults(run=run)


def add_target(parser: argparse.ArgumentParser) -> None:
    """Declare the target; the defaults fit on A4 and on letter paper."""
    which = parser.add_argument_group("target")
    which.add_argument(
        "--pattern",
        choices=["charuco", "chessboard"],
        default="charuco",
        help="kind of target (default: charuco)",
    )
    which.add_argument(
        "--squares", metavar="WxH", default="7x10", help="squares across and down (default: %(default)s)"
    )
    which.add_argument(
        "--square-mm", type=float, metavar="MM", default=24.0, help="side of a square (default: 24)"
    )
    which.add_argument(
        "--marker-mm",
        type=float,
        metavar="MM",
        help="side of a marker of ChArUco (default: three quarters of a square)",
    )
    which.add_argument("--dictionary", default="4X4_50", help="of the markers of ChArUco (default: 4X4_50)")


def target_of(arguments: argparse.Namespace) -> CalibrationTarget:
    """The target that is declared.

    Raises:
        UsageError: it is none.
    """
    from mapweave.vision.calibration.target import CalibrationTarget, Pattern

    a = arguments
    columns, rows = size_of(a.squares, "--squares")
    marker = 0.75 * a.square_mm if a.marker_mm is None else a.marker_mm
    with arguments_read():
        return CalibrationTarget(
            Pattern(a.pattern), columns, rows, 1e-3 * a.square_mm, 1e-3 * marker, a.dictionary.upper()
        )


def size_of(text: str, option: str) -> tuple[int, int]:
    """Two numbers, as in 7x10.

    Raises:
        UsageError: it is something else.
    """
    first, x, second = text.lower().partition("x")
    if not (x and first.isdecimal() and second.isdecimal()):
        raise UsageError(f"{option} {text}: give two numbers, for example 7x10")
    return int(first), int(second)


def run(arguments: argparse.Namespace) -> int:
    """Write the PDF."""
    from mapweave.storage.atomic_file import write_whole
    from mapweave.vision.calibration.target_pdf import target_pdf

    target = target_of(arguments)
    with arguments_read():
        page = target_pdf(target, arguments.paper)
    write_whole(arguments.out, page)
    print_said(
        arguments,
        f"{arguments.out}: {target}, on {arguments.paper}",
        "Print it at 100 % (not fitted to the page), hold a ruler to both scales, glue it to a flat board.",
        file=str(arguments.out),
    )
    return 0
