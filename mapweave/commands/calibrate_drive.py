"""`mapweave calibrate drive`: where the camera stands, and how wheels and clock are scaled, from a drive."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mapweave.commands.replay import add_recording, options_of


def add_to(actions: Any) -> None:
    """Declare the action."""
    drive: argparse.ArgumentParser = actions.add_parser(
        "drive",
        help="mount, wheels and delay, from half a minute of driving",
        description="Estimate the wheels' scales, the camera's mount and the delay between camera and wheels "
        "from a recorded drive, each with its standard deviation and whether the drive shows it. Floor and "
        "wheels show the height only as a multiple of the way: the declared height is kept and the wheels' "
        "scale follows, unless --keep-wheels is given. Drive for half a minute, with turns to both sides.",
    )
    add_recording(drive)
    drive.add_argument("--robot", metavar="NAME", help="one of the robots in the recording's splits.toml")
    drive.add_argument(
        "--keep-wheels", action="store_true", help="the wheels' scale is right; estimate the height"
    )
    drive.add_argument(
        "--write", action="store_true", help="write what the drive shows to the camera.toml of the recording"
    )
    drive.add_argument("--json", action="store_true", help="last line of output: one JSON object")
    drive.set_defaults(run=run)


def advance(steps: Iterator[int]) -> None:
    """Show one step of progress more."""
    next(steps, None)


def run(arguments: argparse.Namespace) -> int:
    """Calibrate, print, write."""
    import os

    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    import sys

    import cv2
    from rich.console import Console
    from rich.progress import track
    from rich.table import Table

    from mapweave.agent.calibration.drive_geometry import Parameter
    from mapweave.agent.calibration.recorded_drive import calibrate
    from mapweave.agent.calibration.report import NAMES, causes, readable, readable_sigmas
    from mapweave.agent.drivers.replay import Replay
    from mapweave.agent.recordings.geometry_file import write_geometry
    from mapweave.hybridmap.errors import DeviceError, InvalidValue

    cv2.setNumThreads(1)
    options = options_of(arguments)
    settings: Path = options.camera or arguments.recording / "camera.toml"
    if arguments.write and not settings.is_file():
        raise DeviceError(f"{settings}: no such file to write to; give --camera FILE")
    robot = Replay(arguments.recording, arguments.robot, options=options)
    console = Console(stderr=arguments.json)
    steps = iter(track(range(len(robot)), "images", console=console, transient=True))
    try:
        drive = calibrate(robot, lambda: advance(steps), arguments.keep_wheels)
    except InvalidValue as error:
        print(f"mapweave: {arguments.recording}: {error}", file=sys.stderr)
        return 1
    estimate = drive.estimate
    declared, value = readable(estimate.declared), readable(estimate.vector)
    sigma, shown = readable_sigmas(estimate), estimate.shown
    table = Table("parameter", "declared", "estimated", "sigma", "shown by this drive")
    for p in Parameter:
        table.add_row(
            NAMES[p], f"{declared[p]:.3f}", f"{value[p]:.3f}", f"{sigma[p]:.3f}", "yes" if shown[p] else "no"
        )
    console.print(table)
    console.print(
        f"{estimate.pairs} image pairs, {estimate.floor_tracks} points on the floor; points in pairs held "
        f"out are {drive.declared_px:.2f} px off as declared, {drive.estimated_px:.2f} px as estimated"
    )
    for cause in causes(estimate):
        console.print(str(cause).removesuffix("; run `mapweave calibrate drive`"), soft_wrap=True)
    worse = drive.estimated_px > drive.declared_px
    if worse:
        console.print("pairs held out do not bear the estimate out: nothing is written")
    elif arguments.write:
        write_geometry(settings, estimate.usable)
        console.print(f"written to {settings}")
    if arguments.json:
        parameters = {
            p.name.lower(): {
                "declared": float(declared[p]), "estimated": float(value[p]), "sigma": float(sigma[p]),
                "shown": bool(shown[p]),
            }
            for p in Parameter
        }  # fmt: skip
        print(
            json.dumps(
                {
                    "parameters": parameters,
                    "declared_px": drive.declared_px,
                    "estimated_px": drive.estimated_px,
                    "written": arguments.write and not worse,
                }
            )
        )
    return 0
