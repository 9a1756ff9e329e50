"""`mapweave info`: what is in a recording, and what is missing."""

from __future__ import annotations

import argparse
import json
from typing import Any

from mapweave.commands.replay import add_recording, options_of


def add_to(commands: Any) -> None:
    """Declare the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "info",
        help="say what is in a recording, and what is missing",
        description="Open a recording as `mapweave replay` does, and say what is in it.",
    )
    add_recording(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Open and describe."""
    import numpy as np

    from mapweave.agent.recordings.opening import open_recording
    from mapweave.agent.recordings.recording import NoOdometry

    missing = []
    try:
        recording = open_recording(arguments.recording, options_of(arguments))
    except NoOdometry as error:
        recording = error.recording
        missing.append(
            "odometry: `mapweave replay` maps it by its images alone; such a map has no scale, so nothing in "
            "it is metric, and lost robots get the place but not the distance"
        )
    camera, stamps = recording.camera, recording.stamps_ns
    recording.read(0)
    seconds = float(stamps[-1] - stamps[0]) * 1e-9
    gaps = np.diff(stamps) * 1e-9
    way, turn = np.abs(recording.increments).sum(axis=0)
    facts = {
        "recording": str(recording.path),
        "format": recording.kind,
        "images": len(recording),
        "seconds": round(seconds, 3),
        "images_per_second": round(1.0 / float(np.median(gaps)), 2),
        "longest_gap_s": round(float(gaps.max()), 3),
        "width": camera.width,
        "height": camera.height,
        "focal_px": round(camera.fx, 1),
        "camera_height_m": round(camera.mount_height, 3),
        "camera_forward_m": round(camera.mount_forward, 3),
        "driven_m": None if missing else round(float(way), 2),
        "turned_rad": None if missing else round(float(turn), 2),
        "missing": missing,
        "notes": list(recording.notes),
        "damage": list(recording.damage),
    }
    if arguments.json:
        print(json.dumps(facts))
        return 0
    print(f"{recording.path}: {recording.kind}")
    print(f"  {len(recording)} images in {seconds:.1f} s, {facts['images_per_second']:g} a second", end="")
    print(f", longest gap {facts['longest_gap_s']:g} s")
    print(f"  camera {camera.width}x{camera.height} px, focal length {camera.fx:.0f} px, ", end="")
    print(f"{camera.mount_height:.2f} m high, {camera.mount_forward:.2f} m ahead of the axle")
    if not missing:
        print(f"  odometry {way:.1f} m, {turn:.1f} rad of turns")
    for words in missing:
        print(f"  missing: {words}")
    for note in (*recording.notes, *recording.damage):
        print(f"  {note}")
    return 0
