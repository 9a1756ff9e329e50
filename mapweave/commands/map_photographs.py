"""`mapweave map from-photos`: a map from photographs of a stretch, taken by hand."""

import argparse
import time
from pathlib import Path
from typing import Any

from mapweave.commands import values
from mapweave.commands.answer import add_json, print_answer
from mapweave.commands.map_input import merge_progress
from mapweave.commands.network import add_network, add_timeout, connect, network_of, reach, settings_of
from mapweave.hybridmap.errors import NotConnected


def add_to(actions: Any) -> None:
    """Declare the action."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "from-photos",
        help="make a map of photographs of a stretch",
        description="Make a map of photographs that were taken one after the other along a stretch, by a "
        "calibrated camera held about level. Each becomes a node that robots can be sent to. With --send the "
        "map is handed over to a running server, through a journal next to OUT as a robot does.",
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="images, in the order of their numbers")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="OUT", help="the .mapweave file")
    parser.add_argument(
        "--spacing", type=values.metres, required=True, metavar="M",
        help="how far apart the photographs are, on average, to within a third",
    )  # fmt: skip
    parser.add_argument("--camera", type=Path, metavar="FILE", help="default: FOLDER/camera.toml")
    parser.add_argument(
        "--name", type=values.name, help="of the map in the fleet (default: OUT without its ending)"
    )
    parser.add_argument("--send", action="store_true", help="hand the map over to a running server")
    add_timeout(parser, of="the server")
    add_json(parser)
    add_network(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Reconstruct, write, hand over."""
    from mapweave.agent.recordings.camera_file import read_camera
    from mapweave.agent.recordings.image_folder import images_in
    from mapweave.hybridmap.change import NodePut
    from mapweave.hybridmap.ids import MapId, check_name
    from mapweave.photographs import map_of_photographs, send_map
    from mapweave.storage.atomic_file import check_map_place
    from mapweave.storage.map_file import MapFile, write_map_file

    check_map_place(arguments.out)
    map_id = MapId(check_name(arguments.name or arguments.out.stem), int(time.time()))
    camera, distortion = read_camera(arguments.camera or arguments.folder / "camera.toml")
    images = images_in(arguments.folder)
    network = network_of(arguments, settings_of(arguments))
    if arguments.send:
        # A server that is not there is better said before the work than after it.
        bus, keys = reach(network, "leave out --send")
        bus.close()
    with merge_progress("reading photographs", "finding where they were taken") as report:
        changes = map_of_photographs(images, camera, distortion, arguments.spacing, map_id, report)
    title = f"{map_id}, of {len(images)} photographs"
    write_map_file(arguments.out, MapFile("agent", title, tuple(changes), {}))
    landmarks = [len(change.node.landmarks) for change in changes if isinstance(change, NodePut)]
    if arguments.send:
        bus, keys = connect(network)
        try:
            journal = arguments.out.with_suffix(".sqlite")
            if not send_map(changes, map_id, journal, bus, keys, network.server, arguments.timeout):
                where = ", ".join(network.endpoints)
                raise NotConnected(f"no server {network.server} at {where} took the map: see {journal}")
        finally:
            bus.close()
    outcome = {
        "out": str(arguments.out), "map": str(map_id), "landmarks": landmarks, "sent": arguments.send,
    }  # fmt: skip
    words = (
        f"{arguments.out}: map {map_id}, {len(images)} nodes with {min(landmarks)} to {max(landmarks)} "
        f"landmarks; its scale is known to a third"
    )
    print_answer(arguments, outcome, [words])
    return 0
