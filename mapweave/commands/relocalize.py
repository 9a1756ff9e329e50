"""`mapweave relocalize`: where an image was taken, by a running server or by a map."""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapweave.commands import values
from mapweave.commands.annotating import add_plan_option, record_of
from mapweave.commands.answer import add_json
from mapweave.commands.map_input import SOURCES, map_source
from mapweave.commands.network import add_network
from mapweave.commands.plan import plan_of, plan_place
from mapweave.commands.usage import UsageError
from mapweave.exit_status import DONE, NO
from mapweave.hybridmap.errors import DeviceError

if TYPE_CHECKING:
    from mapweave.hybridmap.floor_plan import PlacedPlan
    from mapweave.hybridmap.query import RelocalizeAnswer


def add_to(commands: Any) -> None:
    """Declare the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "relocalize",
        help="where an image was taken",
        description="Extract an image's features and ask the map server where it was taken; or, with --map, "
        "answer from a map: `mapweave relocalize --map office.mapweave photo.png`. "
        "Exit status 0: found; 4: unknown, ambiguous, or the place without a pose; 1: could not ask.",
    )
    parser.add_argument("image", type=Path, help="png, jpg, pgm or bmp")
    parser.add_argument(
        "--camera", type=Path, metavar="FILE",
        help="camera.toml with the intrinsics (default: next to the image or one folder up)",
    )  # fmt: skip
    parser.add_argument(
        "--map", type=map_source, metavar="FILE", help=f"answer from {SOURCES}; no server is asked"
    )
    parser.add_argument(
        "--draw", type=values.png, metavar="PNG",
        help="draw the best candidate's landmarks next to the image, joined where they match",
    )  # fmt: skip
    add_plan_option(parser)
    add_json(parser)
    add_network(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Ask and print."""
    from mapweave.agent.recordings.camera_file import read_camera
    from mapweave.drawing.match_picture import draw_matches
    from mapweave.hybridmap.query import Certainty
    from mapweave.storage.image_file import read_grey
    from mapweave.terminal import working
    from mapweave.vision.lens import Lens
    from mapweave.vision.sift import Sift

    if not arguments.image.exists():
        raise DeviceError(f"{arguments.image}: no such file")
    places = [arguments.image.parent / "camera.toml", arguments.image.parent.parent / "camera.toml"]
    camera_file = arguments.camera or next((p for p in places if p.exists()), None)
    if camera_file is None:
        raise UsageError("no camera.toml next to the image: give the intrinsics with --camera FILE")
    camera, distortion = read_camera(camera_file)
    grey = read_grey(arguments.image, camera, str(camera_file))

    lens = Lens(camera, distortion)
    with record_of(arguments) as record:
        record.annotations()  # where no server answers, that is said before the work
        plan = plan_of(arguments, record)
        with working("looking for the place"):
            view = Sift(lens).extract(grey).view(camera)
            answer = record.locate(view)
            drawn = arguments.draw is not None and answer.candidates
            node = record.node(answer.candidates[0].node) if drawn else None
    if arguments.json:
        print(json.dumps(_json(answer, plan)))
    else:
        _print(answer, plan)
    if arguments.draw is not None and node is not None:
        best = answer.candidates[0].node_from_robot.mean
        draw_matches(arguments.draw, grey, lens, node, view, best)
    elif arguments.draw is not None:
        print(f"{arguments.draw} is not drawn: no place was recognised", file=sys.stderr)
    return DONE if answer.certainty is Certainty.FOUND else NO


def _json(answer: RelocalizeAnswer, plan: PlacedPlan | None) -> dict[str, Any]:
    from mapweave.mapserver.http.json_values import json_values
    from mapweave.mapserver.plan_answers import answer_on_plan

    return json_values(answer if plan is None else answer_on_plan(answer, plan))


def _print(answer: RelocalizeAnswer, plan: PlacedPlan | None) -> None:
    import numpy as np

    from mapweave.mapserver.plan_answers import pose_on_plan

    print(f"{answer.certainty}: {answer.reason}")
    for place in answer.candidates:
        x, y, heading = place.node_from_robot.mean.vector
        sx, sy, sh = np.sqrt(np.diag(place.node_from_robot.covariance))
        named = f", {place.place}" if place.place else ""
        named += f", floor {place.floor}" if place.floor else ""
        if not place.distance_known:
            print(
                f"  node {place.node}{named}: somewhere near it, {math.degrees(heading):+.1f} deg "
                f"(sigma {math.degrees(sh):.1f} deg), {place.inliers} landmarks agree, "
                f"probability {place.probability:.3f}"
            )
            continue
        print(
            f"  node {place.node}{named}: {x:+.3f} m ahead, {y:+.3f} m left, "
            f"{math.degrees(heading):+.1f} deg (sigma {sx:.3f} m, {sy:.3f} m, {math.degrees(sh):.1f} deg), "
            f"{place.inliers} landmarks agree, probability {place.probability:.3f}"
        )
        if plan is not None:
            print(f"    {plan_place(plan, pose_on_plan(place, plan))}")
    for near in answer.similar:
        side = "left" if (near.turn or 0.0) > 0.0 else "right"
        turn = "" if near.turn is None else f"; turn {abs(math.degrees(near.turn)):.0f} deg {side}"
        print(f"  looks like {near.node}: {near.lacks}{turn}")
