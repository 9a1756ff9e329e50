"""`mapweave info`: what is in a recording, and what is missing."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapweave.commands.answer import add_json
from mapweave.commands.replay import add_recording, options_of

if TYPE_CHECKING:
    from mapweave.agent.recordings.recording import Recording

ODOMETRY = (
    "odometry: give --odometry FILE (stamped poses). Without it `mapweave replay` maps it by its images "
    "alone; such a map has no scale, so nothing in it is metric, and lost robots get the place but not the "
    "distance"
)
TIMES = (
    "times of the images: write times.txt (seconds, a line for each image), or give a bag or a video that "
    "has them. Speeds and everything that depends on time are as wrong as the assumed rate"
)
UNKNOWN = dict.fromkeys(
    ("images_per_second", "longest_gap_s", "width", "height", "focal_px", "camera_height_m",
     "camera_forward_m", "driven_m", "turned_rad")
)  # fmt: skip


def add_to(commands: Any) -> None:
    """Declare the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "info",
        help="say what is in a recording, and what is missing",
        description="Open a recording as `mapweave replay` does, and say what is in it. What is missing is "
        "listed with the option that gives it.",
    )
    add_recording(parser)
    parser.add_argument(
        "--settings", type=Path, metavar="FILE", help="TOML with [recording], the topics of a bag"
    )
    add_json(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Open and describe."""
    from mapweave.agent.recordings.incomplete import Incomplete
    from mapweave.agent.recordings.opening import open_recording
    from mapweave.terminal import working

    lacks: tuple[str, ...] = ()
    odometry = True
    try:
        with working("reading the recording"):
            whole = open_recording(arguments.recording, options_of(arguments))
        recording: Recording | None = whole
        bag = whole.bag
    except Incomplete as error:
        recording, lacks, odometry, bag = error.recording, error.lacks, error.odometry, error.bag
    facts = {
        "recording": str(arguments.recording),
        "format": "bag" if recording is None else recording.kind,
        "images": 0,
        "seconds": 0.0 if bag is None else round(bag.seconds, 3),
        **UNKNOWN,
        "notes": [],
        "damage": [],
        **({} if recording is None else _described(recording, bool(lacks), odometry)),
        "topics": [] if bag is None else [
            {"name": topic.name, "type": topic.kind, "count": topic.count} for topic in bag.topics
        ],
        "missing": [
            *(words.removeprefix("no ").removeprefix("does not say ") for words in lacks),
            *([] if odometry else [ODOMETRY]),
            *([] if recording is None or recording.timed else [TIMES]),
        ],
    }  # fmt: skip
    if arguments.json:
        print(json.dumps(facts))
    else:
        _print(facts)
    return 0


def _described(recording: Recording, camera_lacks: bool, odometry: bool) -> dict[str, Any]:
    """What images, camera and odometry say.

    Raises:
        DeviceError: no image can be read.
    """
    import numpy as np

    from mapweave.agent.recordings.incomplete import first_image
    from mapweave.doctor.camera_model import recorded_faults

    camera, stamps = recording.camera, recording.stamps_ns
    _, unreadable = first_image(len(recording), recording.read)
    gaps = np.diff(stamps) * 1e-9
    way, turn = np.abs(recording.increments).sum(axis=0)
    out: dict[str, Any] = {
        "images": len(recording),
        "seconds": None,
        "width": camera.width,
        "height": camera.height,
    }
    if recording.timed:
        out |= {
            "seconds": round(float(stamps[-1] - stamps[0]) * 1e-9, 3),
            "images_per_second": round(1.0 / float(np.median(gaps)), 2),
            "longest_gap_s": round(float(gaps.max()), 3),
        }
    notes = list(recording.notes)
    if not camera_lacks:
        notes += recorded_faults(recording)
        out |= {
            "focal_px": round(camera.fx, 1),
            "camera_height_m": round(camera.mount_height, 3),
            "camera_forward_m": round(camera.mount_forward, 3),
        }
    if odometry:
        out |= {"driven_m": round(float(way), 2), "turned_rad": round(float(turn), 2)}
    damage = [*recording.damage, *([unreadable] if unreadable else [])]
    return {**out, "notes": notes, "damage": damage}


def _print(facts: dict[str, Any]) -> None:
    """The same for people."""
    from mapweave.hybridmap.counted import counted

    print(f"{facts['recording']}: {facts['format']}")
    if facts["images"]:
        if facts["seconds"] is None:
            print(f"  {counted(facts['images'], 'image')}, at unknown times")
        else:
            print(f"  {counted(facts['images'], 'image')} in {facts['seconds']:.1f} s, ", end="")
            print(f"{facts['images_per_second']:g} a second, longest gap {facts['longest_gap_s']:g} s")
        print(f"  camera {facts['width']}x{facts['height']} px", end="")
        if facts["focal_px"] is not None:
            print(f", focal length {facts['focal_px']:.0f} px, {facts['camera_height_m']:.2f} m high", end="")
            print(f", {facts['camera_forward_m']:.2f} m ahead of the axle", end="")
        print()
    else:
        print(f"  no images in {facts['seconds']:.1f} s")
    if facts["driven_m"] is not None:
        print(f"  odometry {facts['driven_m']:.1f} m, {facts['turned_rad']:.1f} rad of turns")
    for topic in facts["topics"]:
        print(f"  {topic['name']} ({topic['type']}), {counted(topic['count'], 'message')}")
    for words in facts["missing"]:
        print(f"  missing: {words}")
    for note in (*facts["notes"], *facts["damage"]):
        print(f"  {note}")
