"""`mapweave relocalize`: where an image was taken, by a running server or by a map."""

from __future__ import annotations

import argparse
import json
import math
import sys
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapweave.commands import values
from mapweave.commands.annotating import add_plan_option
from mapweave.commands.answer import add_json
from mapweave.commands.map_input import SOURCES, map_source, router_of
from mapweave.commands.network import (
    add_network,
    add_timeout,
    key_holder,
    network_of,
    reach,
    settings_of,
)
from mapweave.commands.plan import plan_of, plan_place
from mapweave.commands.usage import UsageError
from mapweave.exit_status import DONE, NO
from mapweave.hybridmap.errors import DeviceError, NotConnected

if TYPE_CHECKING:
    from collections.abc import Callable

    from mapweave.hybridmap.floor_plan import PlacedPlan
    from mapweave.hybridmap.ids import NodeId
    from mapweave.hybridmap.node import Node
    from mapweave.hybridmap.query import RelocalizeAnswer, View
    from mapweave.mapserver.routes import Router
    from mapweave.settings import NetworkSettings
    from mapweave.wire.keys import Keys
    from mapweave.wire.zenoh_bus import ZenohBus


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
    add_timeout(parser, 5.0)
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
    router = None if arguments.map is None else router_of(arguments)
    plan = plan_of(arguments, router)

    @cache
    def view() -> View:
        return Sift(lens).extract(grey).view(camera)

    with working("looking for the place"):
        answer, node = _by_server(arguments, view) if router is None else _by_map(router, view())
    if arguments.json:
        print(json.dumps(_json(answer, plan)))
    else:
        _print(answer, plan)
    if arguments.draw is not None and node is not None:
        best = answer.candidates[0].node_from_robot.mean
        draw_matches(arguments.draw, grey, lens, node, view(), best)
    elif arguments.draw is not None:
        print(f"{arguments.draw} is not drawn: no place was recognised", file=sys.stderr)
    return DONE if answer.certainty is Certainty.FOUND else NO


def _by_server(
    arguments: argparse.Namespace, view: Callable[[], View]
) -> tuple[RelocalizeAnswer, Node | None]:
    """The answer of a running server, and the best candidate's node if it is to be drawn."""
    from mapweave.commands.map_ends import answers
    from mapweave.connection import no_server, server_statuses, waits_for
    from mapweave.hybridmap.query import RelocalizeAnswer
    from mapweave.wire.messages import decode, encode_view

    network = network_of(arguments, settings_of(arguments))
    bus, keys = reach(network)
    try:
        if all(map(waits_for, server_statuses(bus, keys, arguments.timeout))):
            raise no_server(bus, keys, key_holder(network))  # said before the work
        (reply, *_) = answers(bus, network, keys.any_relocalize(), encode_view(view()), arguments.timeout)
        answer = decode(reply.payload, RelocalizeAnswer)
        if arguments.draw is None or not answer.candidates:
            return answer, None
        return answer, _node(bus, keys, network, answer.candidates[0].node, arguments.timeout)
    finally:
        bus.close()


def _by_map(router: Router, view: View) -> tuple[RelocalizeAnswer, Node | None]:
    """The answer of a map, and the best candidate's node."""
    from mapweave.mapserver.places import PlaceResolver
    from mapweave.offline_relocalization import relocalizer_in

    merged = router.merged
    answer = PlaceResolver(router, router.annotations).named(relocalizer_in(merged).answer(view))
    if not answer.candidates:
        return answer, None
    best = answer.candidates[0].node
    return answer, merged.maps[best.map].nodes[best]


def _node(bus: ZenohBus, keys: Keys, network: NetworkSettings, node_id: NodeId, patience: float) -> Node:
    """A node of the merged map: the beginning of the way from itself to itself."""
    from mapweave.commands.map_ends import answers
    from mapweave.hybridmap.query import RouteAnswer, RouteRequest
    from mapweave.wire.messages import decode, encode

    request = encode(RouteRequest(node_id, node_id))
    way = decode(answers(bus, network, keys.any_route(), request, patience)[0].payload, RouteAnswer)
    if not way.legs or way.legs[0].node.id != node_id:
        raise NotConnected(f"the map server did not give node {node_id}: {way.reason}")
    return way.legs[0].node


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
