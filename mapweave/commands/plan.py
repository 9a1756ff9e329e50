"""`mapweave plan`: floor plans under the merged map."""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapweave.commands import values
from mapweave.commands.annotating import (
    add_near,
    add_record_options,
    add_remove,
    record_of,
    two_numbers,
)
from mapweave.commands.answer import print_answer, print_said
from mapweave.commands.network import settings_of
from mapweave.commands.usage import UsageError
from mapweave.hybridmap.errors import InvalidFile

if TYPE_CHECKING:
    from mapweave.fleet import Fleet
    from mapweave.hybridmap.floor_plan import PlacedPlan
    from mapweave.hybridmap.pose import Pose2
    from mapweave.merge.pose_graph.merged_map import MergedMap
    from mapweave.offline_record import OfflineRecord

FORMATS = ("rmf", "nav2", "tf", "json")
PAIR = "r0.1.17=412,230, kitchen=412,230 or 3.1,-2.0=412,230"
EXAMPLE = "`mapweave plan add office.yaml --pair r0.1.1=102,340 --pair r0.1.17=412,230 --pair kitchen=77,52`"


def add_to(commands: Any) -> None:
    """Declare the command and its actions."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "plan",
        help="put a floor plan, or a map of Nav2, under the merged map",
        description="Lay a floor plan under the merged map by three or more pairs of places and pixels, and "
        f"export the transform. Example: {EXAMPLE}, then `mapweave plan show office`.",
    )
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)
    add: argparse.ArgumentParser = actions.add_parser(
        "add",
        help="add a plan, or replace one",
        description="Add a floor plan: an image, or the map.yaml of a Nav2 map, with three or more pairs. A "
        "pair is a place and its pixel: NODE, PLACE or x,y (m, in the merged map) = U,V (px from the upper "
        "left corner, right and down). The scale of an image is that of the pairs unless it is given. "
        f"Example: {EXAMPLE}.",
    )
    add.add_argument("file", type=Path, metavar="MAP.yaml|IMAGE", help="a map.yaml, or png, jpg, pgm, bmp")
    add.add_argument(
        "--pair", action="append", required=True, metavar="NODE|PLACE|X,Y=U,V", dest="pairs",
        help=f"a place and its pixel: {PAIR}",
    )  # fmt: skip
    add.add_argument(
        "--name", type=values.title, metavar="NAME",
        help="of the plan (default: the file's, without its ending)",
    )  # fmt: skip
    add.add_argument("--metres-per-pixel", type=float, metavar="M", help="scale of the image, m")
    add_near(add)
    add_record_options(add, changes=True)
    add.set_defaults(run=run_add)

    show: argparse.ArgumentParser = actions.add_parser(
        "show",
        help="residuals, scale and a picture",
        description="Print how each plan lies under the map: scale, residual of each pair, also from the "
        "transform of the others alone, and what is doubtful. With -o the plan is drawn with the merged map "
        "over it: `mapweave plan show office -o office.png`.",
    )
    show.add_argument("name", nargs="?", metavar="NAME", help="of the plan (default: all)")
    # Not `out`, which says where a changed record is written.
    show.add_argument("-o", "--out", dest="picture", type=values.png, metavar="PNG", help="draw plan and map")
    _add_component(show)
    add_record_options(show, changes=False)
    show.set_defaults(run=run_show)

    export: argparse.ArgumentParser = actions.add_parser(
        "export",
        help="the transform for Open-RMF, Nav2, tf",
        description="Print the transform between plan and merged map: reference_coordinates of an RMF fleet "
        "adapter (rmf), lines for a map.yaml (nav2), a static transform publisher (tf), or all numbers "
        "(json). Example: `mapweave plan export office --format rmf`.",
    )
    export.add_argument("name", metavar="NAME", help="of the plan")
    export.add_argument("--format", choices=FORMATS, required=True, help="for which program")
    _add_component(export)
    add_record_options(export, changes=False)
    export.set_defaults(run=run_export)

    add_remove(
        actions, "plan", "remove a plan", "of the plan",
        "Remove a plan: `mapweave plan remove office`. `mapweave map history` still shows it.",
    )  # fmt: skip


def _add_component(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--component", type=int, metavar="N",
        help="the part of the map under which it lies (default: that with most pairs)",
    )  # fmt: skip


def run_add(arguments: argparse.Namespace) -> int:
    """Read the image, keep it, and say how it fits."""
    from mapweave.formats.plan_export import plan_words
    from mapweave.storage.nav2_map import SUFFIXES, read_nav2_map
    from mapweave.storage.plan_image import read_plan_file
    from mapweave.wire.typed import packed

    pairs = [_pair(word) for word in arguments.pairs]
    scale = arguments.metres_per_pixel
    if scale is not None and not 0.0 < scale < math.inf:
        raise UsageError(f"--metres-per-pixel {scale:g}: give metres, for example 0.05")
    path = arguments.file
    fields: dict[str, Any] = {"pairs": pairs}
    if path.suffix.lower() in SUFFIXES:
        if scale is not None:
            raise UsageError("--metres-per-pixel goes with an image: a map.yaml has its resolution")
        described = read_nav2_map(path)
        fields |= {"metres_per_pixel": described.resolution, "origin": packed(described.origin)}
        try:
            kept = read_plan_file(described.image, described.negate)
        except InvalidFile as error:
            raise InvalidFile(f"the image that {path} names, {error}") from None
    else:
        kept = read_plan_file(path)
        if scale is not None:
            fields["metres_per_pixel"] = scale
    fields["image"] = packed(kept.image)
    if arguments.near:
        fields["near"] = arguments.near
    name = arguments.name or path.stem
    with record_of(arguments, changes=True) as record:
        record.put_plan_image(kept.png)
        said = [record.annotate("plan", name, arguments.because, check=arguments.check, **fields)]
        if not arguments.check:
            said += plan_words(record.plans().plan(name))
    print_said(arguments, *said)
    return 0


def run_show(arguments: argparse.Namespace) -> int:
    """Print, and draw."""
    from mapweave.formats.plan_export import plan_words
    from mapweave.hybridmap.floor_plan import PlacedPlans
    from mapweave.mapserver.http.json_values import json_values

    with record_of(arguments) as record:
        plans = record.plans()
        shown = plans.plans if arguments.name is None else (plans.plan(arguments.name),)
        lines = [line for placed in shown for line in plan_words(placed)] or ["there is no plan"]
        print_answer(arguments, json_values(PlacedPlans(shown)), lines)
        if arguments.picture is not None:
            if len(shown) != 1:
                raise UsageError("name the plan to draw: mapweave plan show NAME -o PNG")
            _draw(record, shown[0], arguments)
    return 0


def run_export(arguments: argparse.Namespace) -> int:
    """Print the transform."""
    from mapweave.formats.plan_export import FORMATS as WRITERS

    with record_of(arguments) as record:
        placed = record.plans().plan(arguments.name)
    part = placed.part(arguments.component)
    text: Any = WRITERS[arguments.format](placed, part)
    if arguments.json:
        text = json.loads(text) if arguments.format == "json" else text
        print(json.dumps({"plan": placed.name, "component": part.component, arguments.format: text}))
    else:
        print(text, end="")
    for doubt in part.doubts:
        print(f"mapweave: {doubt}", file=sys.stderr)
    return 0


def plan_of(arguments: argparse.Namespace, record: Fleet | OfflineRecord) -> PlacedPlan | None:
    """The plan that `--plan` names; None if it is not given.

    Raises:
        MapweaveError: there is none of this name, no server answers, or the map cannot be read.
    """
    return None if arguments.plan is None else record.plans().plan(arguments.plan)


def plan_place(placed: PlacedPlan, pose: Pose2 | None) -> str:
    """A pose on a plan, in words."""
    if pose is None:
        return f"not on plan {placed.name}"
    return f"on plan {placed.name}: {pose.x:z.2f},{pose.y:z.2f} m, {math.degrees(pose.heading):z.0f} deg"


def _pair(word: str) -> dict[str, Any]:
    """`r0.1.17=412,230` as fields of an annotation.

    Raises:
        UsageError: it is none.
    """
    place, equals, pixel = word.rpartition("=")
    position = two_numbers(pixel) if equals and place.strip() else None
    if position is None:
        raise UsageError(f"--pair {word}: write {PAIR}")
    try:
        values.node(place)
    except UsageError as error:
        raise UsageError(f"--pair {word}: {error}") from None
    return {"at": place.strip(), "u": position[0], "v": position[1]}


def _draw(record: Fleet | OfflineRecord, placed: PlacedPlan, arguments: argparse.Namespace) -> None:
    from mapweave.drawing.plan_picture import draw_plan
    from mapweave.extras import need
    from mapweave.storage.atomic_file import check_place
    from mapweave.storage.plan_image import plan_pixels

    need("viz")
    check_place(arguments.picture)
    part = placed.part(arguments.component)
    pixels = plan_pixels(record.plan_image(placed.plan.image.sha256))
    draw_plan(placed, part, pixels, _merged(record, arguments), arguments.picture)
    print(arguments.picture, file=sys.stderr if arguments.json else sys.stdout)


def _merged(record: Fleet | OfflineRecord, arguments: argparse.Namespace) -> MergedMap:
    from mapweave.fleet import Fleet
    from mapweave.mapserver.map_files import merged_of
    from mapweave.terminal import working

    if isinstance(record, Fleet):
        with working("fetching the map"):
            return merged_of(record.map(), settings_of(arguments).merge)
    return record.merged
