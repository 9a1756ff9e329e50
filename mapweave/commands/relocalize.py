"""`mapweave relocalize`: ask a running server where an image was taken."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

from mapweave.commands.network import add_network, connect, network_of, settings_of


def add_to(commands: Any) -> None:
    """Declare the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "relocalize",
        help="ask a running server where an image was taken",
        description="Extract an image's features and ask the map server where it was taken. "
        "Exit status 0: found; 2: unknown or ambiguous; 1: could not ask.",
    )
    parser.add_argument("image", type=Path, help="png, jpg, pgm or bmp")
    parser.add_argument(
        "--camera", type=Path, metavar="FILE",
        help="camera.toml with the intrinsics (default: beside the image or one folder up)",
    )  # fmt: skip
    parser.add_argument("--timeout", type=float, default=5.0, metavar="S", help="longest wait for an answer")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    add_network(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Ask and print."""
    import cv2
    import numpy as np

    from agent.drivers.replay import read_camera
    from agent.observation import RobotDescription
    from agent.vision.lens import Lens
    from agent.vision.sift import Sift
    from hybridmap.errors import DeviceError, NotConnected
    from hybridmap.query import Certainty
    from wire.messages import decode_relocalize_answer, encode_view

    places = [arguments.image.parent / "camera.toml", arguments.image.parent.parent / "camera.toml"]
    camera_file = arguments.camera or next((p for p in places if p.exists()), None)
    if camera_file is None:
        raise DeviceError("no camera.toml beside the image: give the intrinsics with --camera FILE")
    camera, distortion = read_camera(camera_file)
    image = cv2.imread(str(arguments.image), cv2.IMREAD_GRAYSCALE) if arguments.image.exists() else None
    if image is None:
        raise DeviceError(f"{arguments.image}: not an image that can be read")
    if image.shape != (camera.height, camera.width):
        raise DeviceError(
            f"{arguments.image} is {image.shape[1]}x{image.shape[0]} px, "
            f"but {camera_file} says {camera.width}x{camera.height}"
        )
    features = Sift(Lens(RobotDescription(camera, distortion))).extract(np.asarray(image, np.uint8))
    network = network_of(arguments, settings_of(arguments))
    bus, keys = connect(network)
    try:
        where = ", ".join(network.endpoints)
        if not bus.wait_connected(arguments.timeout):
            raise NotConnected(f"no router at {where}: start `mapweave server` or give --connect")
        replies = bus.ask(keys.any_relocalize(), encode_view(features.view(camera)), arguments.timeout)
    finally:
        bus.close()
    if not replies:
        raise NotConnected(f"a router is up at {where}, but no map server of fleet {network.fleet} answered")
    good = [r for r in replies if not r.error]
    if not good:
        raise NotConnected(f"the map server refused: {replies[0].error}")
    answer = decode_relocalize_answer(good[0].payload)
    candidates: list[dict[str, Any]] = []
    for place in answer.candidates:
        merged = place.merged_from_robot
        sigma = np.sqrt(np.diag(place.node_from_robot.covariance))
        candidates.append({
            "node": str(place.node),
            "node_from_robot": place.node_from_robot.mean.vector.tolist(),
            "sigma": sigma.tolist(),
            "merged_from_robot": None if merged is None else merged.mean.vector.tolist(),
            "component": place.component,
            "inliers": place.inliers,
            "probability": place.probability,
        })  # fmt: skip
    if arguments.json:
        report = {"certainty": str(answer.certainty), "reason": answer.reason, "candidates": candidates}
        print(json.dumps(report))
    else:
        print(f"{answer.certainty}: {answer.reason}")
        for row in candidates:
            x, y, heading = row["node_from_robot"]
            sx, sy, sh = row["sigma"]
            print(
                f"  node {row['node']}: {x:+.3f} m ahead, {y:+.3f} m left, {math.degrees(heading):+.1f} deg "
                f"(sigma {sx:.3f} m, {sy:.3f} m, {math.degrees(sh):.1f} deg), "
                f"{row['inliers']} landmarks agree, probability {row['probability']:.3f}"
            )
    return 0 if answer.certainty is Certainty.FOUND else 2
