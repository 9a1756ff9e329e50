"""`mapweave find-cameras`: which cameras open, with a frame of each."""

import argparse
import json
from pathlib import Path
from typing import Any

from mapweave.commands import values
from mapweave.commands.answer import add_json, print_note


def add_to(commands: Any) -> None:
    """Declare the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "find-cameras",
        help="find the cameras, and save a frame of each",
        description="Open each video device, and each SOURCE that is given, print its size and rate, and "
        "save a frame of it. Exit status 4 if no camera gives an image.",
    )
    parser.add_argument(
        "source", nargs="*", help="further video files or streams, as [robot.camera] source takes them"
    )
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        default=Path("out/cameras"),
        help="folder for the frames (default: out/cameras)",
    )
    parser.add_argument("--width", type=values.count, default=640, help="asked of devices, px (default: 640)")
    parser.add_argument(
        "--height", type=values.count, default=480, help="asked of devices, px (default: 480)"
    )
    add_json(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Try one after the other."""
    import cv2

    from mapweave.agent.drivers.camera import Capture
    from mapweave.agent.drivers.settings import CameraSettings
    from mapweave.agent.drivers.stream_refusal import without_password
    from mapweave.agent.vision.image_quality import ImageQuality
    from mapweave.doctor.camera import SECONDS, watch
    from mapweave.hybridmap.errors import DeviceError, Refused
    from mapweave.storage.atomic_file import write_whole
    from mapweave.terminal import working

    devices = sorted(Path("/dev").glob("video*"), key=lambda path: (len(path.name), path.name))
    sources = [*map(str, devices), *arguments.source]
    width, height = arguments.width, arguments.height
    found: list[dict[str, object]] = []
    failed: list[str] = []
    for number, source in enumerate(sources):
        settings = CameraSettings(width, height, width, width, width / 2, height / 2, 0.3, source=source)
        source = without_password(source)
        try:
            camera = Capture(settings)
        except DeviceError as error:
            failed.append(str(error))
            continue
        try:
            with working(f"looking through {source}"):
                watched = watch(camera, SECONDS)
        finally:
            camera.close()
        if not watched.images:
            failed.append(f"camera {source}: opens and gives no image")
            continue
        image = watched.images[-1]
        path = arguments.out / f"camera{number}.png"
        arguments.out.mkdir(parents=True, exist_ok=True)
        write_whole(path, cv2.imencode(".png", image)[1].tobytes())
        size = f"{image.shape[1]}x{image.shape[0]} px"
        fault = ImageQuality.of(image).fault
        words = (
            f"{source}: {size}, {watched.rate:.0f} images/s, frame in {path}{'; ' if fault else ''}{fault}"
        )
        print_note(arguments, words)
        found.append({
            "source": source, "width": image.shape[1], "height": image.shape[0], "fault": fault or None,
            "images_per_second": round(watched.rate, 1), "frame": str(path),
        })  # fmt: skip
    if found:
        # A Raspberry Pi has a dozen video devices that are no cameras.
        for words in failed if arguments.source else ():
            print_note(arguments, words)
        if arguments.json:
            print(json.dumps({"cameras": found}))
        return 0
    reasons = "".join(f"{words}; " for words in failed)
    raise Refused(f"{reasons}no camera gives an image; for a Raspberry Pi's own camera see docs/robot.md")
