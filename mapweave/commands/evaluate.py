"""`mapweave eval`: how well something works on a recording of one's own."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapweave.commands import values
from mapweave.commands.map_input import SOURCES, map_source, merged_with_progress, opened
from mapweave.commands.network import settings_of
from mapweave.commands.replay import add_recording, images_of, options_of

if TYPE_CHECKING:
    from mapweave.evaluation.replaying import ReplayEvaluation
    from mapweave.evaluation.visual_replaying import VisualEvaluation


def add_to(commands: Any) -> None:
    """Declare the command and what it can evaluate."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "eval",
        help="measure on a recording of your own",
        description="Measure how well something works on real recordings.",
        epilog="Each has its own --help.",
    )
    kinds = parser.add_subparsers(title="what", metavar="WHAT", required=True)
    relocalize: argparse.ArgumentParser = kinds.add_parser(
        "relocalize",
        help="map from one pass of a recording, ask from the others",
        description="Map from one pass of a recording, ask where each image of the others was taken, and "
        "print recall and error. A drive with odometry.csv and splits.toml: the first robot maps as if "
        "carried along, the others ask; truth.csv has the true poses. Photographs with lap_truth.csv: the "
        "images that are no query are the map, by appearance alone. Recall is of single images, and of a "
        "robot that asks again within 2 m of driving.",
    )
    relocalize.add_argument("folder", type=Path, help="recording: images/ and its other files")
    relocalize.add_argument(
        "--camera", type=Path, metavar="FILE", help="camera.toml for photographs (default: the folder's)"
    )
    relocalize.add_argument(
        "--focal", type=float, metavar="PX", help="focal length for photographs without a camera.toml"
    )
    relocalize.add_argument(
        "--map", type=map_source, metavar="FILE",
        help=f"ask this map instead of mapping a pass: {SOURCES}; truth.csv, if it is of the same clock, "
        "tells where its nodes are",
    )  # fmt: skip
    relocalize.add_argument(
        "--robot", metavar="NAME", help="with --map: one of the robots in the recording's splits.toml asks"
    )
    _add_output(relocalize, "write each answer to a table there")
    relocalize.set_defaults(run=run)
    merge: argparse.ArgumentParser = kinds.add_parser(
        "merge",
        help="cut a recording into robots, map, and merge",
        description="Cut a recording into robots, let each map its piece as if carried along, merge the maps "
        "as the server does, and print links, components and error. Without --robots it is cut as its "
        "splits.toml defines. truth.csv has the true poses; without it nothing is scored.",
    )
    merge.add_argument(
        "folder", type=Path, help="recording: images/, camera.toml, odometry.csv; times.txt, truth.csv"
    )
    merge.add_argument(
        "--robots", type=values.count, metavar="N",
        help="cut it into N consecutive pieces instead, which overlap by 30 %% (even images, odd images)",
    )  # fmt: skip
    _add_output(merge, "map, links and picture (default: out/eval-merge/FOLDER)", " and the merge")
    merge.set_defaults(run=run_merge)
    replay: argparse.ArgumentParser = kinds.add_parser(
        "replay",
        help="map a recording; error of every frame beside the wheels alone",
        description="Map a recording as `mapweave replay` does. Print the absolute and relative error of its "
        "frames beside the wheels alone, nodes, bytes, the share of frames used, and why others were not. "
        "The trajectories go to files that evo reads. Without truth nothing is scored. A recording without "
        "odometry is mapped by its images alone, and its error is that after an alignment with scale.",
    )
    add_recording(replay)
    replay.add_argument(
        "--truth",
        type=Path,
        metavar="FILE",
        help="truth.csv, or true poses as TUM, EuRoC or KITTI have them (default: those beside it)",
    )
    replay.add_argument("--robot", metavar="NAME", help="one of the robots in the recording's splits.toml")
    _add_output(replay, "default: out/eval-replay/RECORDING")
    replay.set_defaults(run=run_replay)


def _add_output(parser: argparse.ArgumentParser, out: str, also: str = "") -> None:
    """Declare what is written and printed, and the settings."""
    parser.add_argument("-o", "--out", type=Path, metavar="DIR", help=out)
    parser.add_argument("--json", action="store_true", help="print one JSON object at the end")
    parser.add_argument(
        "--settings", type=Path, metavar="FILE", help=f"TOML with settings of the pipeline{also}"
    )


def run_replay(arguments: argparse.Namespace) -> int:
    """Map, score and print."""
    from mapweave.agent.drivers.replay import Replay
    from mapweave.agent.recordings.incomplete import NoOdometry
    from mapweave.evaluation.replaying import evaluate_replay, rows
    from mapweave.evaluation.truth_files import truth_beside
    from mapweave.output_folder import check_output
    from mapweave.terminal import Bar, plain_or_terminal, tracked

    path: Path = arguments.recording
    out = arguments.out or Path("out/eval-replay") / path.resolve().stem
    check_output(out)
    truth = arguments.truth or truth_beside(path)
    console = plain_or_terminal()
    evaluated: ReplayEvaluation | VisualEvaluation
    try:
        replay = Replay(path, arguments.robot, options=options_of(arguments))
    except NoOdometry as missing:
        # It needs a library that mapping with odometry does not.
        from mapweave.evaluation.visual_replaying import evaluate_images

        recording = missing.recording
        notes = ("no odometry: it is mapped by its images alone, without a scale", *recording.notes)
        for note in notes:
            console.print(note, highlight=False)
        frames = images_of(recording, arguments.robot)
        evaluated = evaluate_images(recording, tracked(frames, "frames", console=console), truth)
        lines = (*recording.damage, *evaluated.damage)
    else:
        for note in replay.recording.notes:
            console.print(note, highlight=False)
        with Bar(console, "frames", len(replay)) as bar:
            settings = settings_of(arguments).agent
            evaluated = evaluate_replay(replay, settings, truth, lambda frame: bar.advance())
        lines = (*evaluated.notes, *replay.damage)
    for line in lines:
        console.print(line, highlight=False)
    if truth is not None and arguments.truth is None:
        console.print(f"truth from {truth}", highlight=False)
    for written in evaluated.write(out):
        console.print(f"{written}", highlight=False)
    report = evaluated.report()
    if truth is not None and not report["truth"]:
        console.print(
            f"no true pose is within 20 ms of a frame that is used: is {truth} of another clock?",
            highlight=False,
        )
    return _print(arguments, report, [("", ""), *rows(report)], str(path))


def run(arguments: argparse.Namespace) -> int:
    """Examine and print."""
    from mapweave.evaluation.relocalization import evaluate_map, evaluate_relocalization
    from mapweave.evaluation.verdict import shown
    from mapweave.output_folder import check_output
    from mapweave.terminal import plain_or_terminal

    if arguments.out is not None:
        check_output(arguments.out)
    pipeline = settings_of(arguments).agent
    console = plain_or_terminal()
    if arguments.map is not None:
        merged = merged_with_progress(opened(arguments.map), settings_of(arguments).merge)
        examination = evaluate_map(arguments.folder, arguments.robot, merged, console)
    else:
        examination = evaluate_relocalization(
            arguments.folder, arguments.camera, arguments.focal, pipeline, console
        )
    report = examination.report()
    if arguments.out is not None:
        for path in examination.write(arguments.out):
            console.print(f"answers in {path}", highlight=False)
    flat = {name: value for name, value in report.items() if not isinstance(value, dict)}
    selections = {name: value for name, value in report.items() if isinstance(value, dict)}
    rows = [("", str(flat.pop("verified")), *selections)]
    for name, value in flat.items():
        rows.append((name, *map(shown, (value, *(one.get(name, "") for one in selections.values())))))
    return _print(arguments, report, rows)


def run_merge(arguments: argparse.Namespace) -> int:
    """Cut, map, merge and print."""
    from mapweave.extras import need

    need("server", "viz")
    from mapweave.evaluation.merging import evaluate_merging
    from mapweave.evaluation.verdict import shown
    from mapweave.output_folder import check_output
    from mapweave.terminal import plain_or_terminal

    settings = settings_of(arguments)
    merge = settings.merge
    console = plain_or_terminal()
    if arguments.out is not None:
        check_output(arguments.out)
    examination = evaluate_merging(arguments.folder, arguments.robots, settings.agent, merge, console)
    report = examination.report()
    out = arguments.out or Path("out/eval-merge") / examination.name
    for path in examination.write(out):
        console.print(f"{path}", highlight=False)
    rows = [("", "")]
    for name, value in report.items():
        inner = value.items() if isinstance(value, dict) else ()
        rows.append((name, ", ".join(f"{key} {shown(number)}" for key, number in inner) or shown(value)))
    return _print(arguments, report, rows)


def _print(
    arguments: argparse.Namespace, report: dict[str, Any], rows: Sequence[tuple[str, ...]], title: str = ""
) -> int:
    """Print a report as JSON, or as a table of rows, the first its header; the exit status."""
    from rich.table import Table

    from mapweave.terminal import plain_or_terminal

    if arguments.json:
        print(json.dumps(report, allow_nan=False))
        return 0
    header, *lines = rows
    table = Table(*header, title=title or str(arguments.folder))
    for line in lines:
        table.add_row(*line)
    plain_or_terminal(stderr=False).print(table)
    return 0
