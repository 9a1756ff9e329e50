"""`mapweave calibrate camera`: intrinsics and lens, from views of a printed target."""

from __future__ import annotations

import argparse
import json
import sys
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapweave.commands import values
from mapweave.commands.calibrate_target import add_target, size_of, target_of
from mapweave.exit_status import DONE, NO

if TYPE_CHECKING:
    from rich.console import Console

    from mapweave.vision.calibration.camera_calibration import CameraCalibration
    from mapweave.vision.calibration.collection import ViewCollection


def add_to(actions: Any) -> None:
    """Declare the action."""
    parser: argparse.ArgumentParser = actions.add_parser(
        "camera",
        help="focal length and lens, from views of a printed target",
        description="Calibrate a camera from views of the target of `mapweave calibrate target`: live, with "
        "guidance, until the views suffice; or from a folder of images or a video. The result goes to "
        "[robot.camera] of the robot's settings file.",
        epilog="Exit status 4: the calibration is not good enough; nothing is written, the output says why.",
    )  # fmt: skip
    parser.add_argument(
        "images", type=Path, nargs="?", help="folder of images or video (default: live from the camera)"
    )
    parser.add_argument(
        "--settings", type=Path, metavar="FILE",
        help="the robot's settings file, for example r0.toml: its [robot.camera] says which camera it is, "
        "and gets the result; made if it is not there",
    )  # fmt: skip
    parser.add_argument(
        "--source", help="video device, file or URL of the camera (default: the settings file's, else 0)"
    )
    parser.add_argument(
        "--size", metavar="WxH", help="of a video device's images (default: the file's, else 640x480)"
    )
    parser.add_argument(
        "--lens", choices=["radial-tangential", "equidistant"],
        help="model of the lens (default: the one that explains held out views better)",
    )  # fmt: skip
    parser.add_argument(
        "--height", type=float, metavar="M", help="of the lens above the floor, to be written as well"
    )
    parser.add_argument("--forward", type=float, metavar="M", help="of the lens ahead of the axle, likewise")
    parser.add_argument(
        "--http", type=values.port, nargs="?", const=8090, metavar="PORT",
        help="show camera and guidance on a page of this machine, port 8090 by default",
    )  # fmt: skip
    add_target(parser)
    parser.add_argument("--json", action="store_true", help="last line of output: one JSON object")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Collect views, calibrate, print, write."""
    from mapweave.agent.drive_geometry import check_mount
    from mapweave.agent.drivers.settings_writer import camera_table, write_camera
    from mapweave.commands.usage import UsageError, arguments_read
    from mapweave.hybridmap.errors import MapweaveError, Refused
    from mapweave.terminal import plain_or_terminal
    from mapweave.vision.calibration.camera_calibration import calibrate_camera
    from mapweave.vision.calibration.collection import ViewCollection
    from mapweave.vision.calibration.views import BoardDetector
    from mapweave.vision.lens import LensModel

    a = arguments
    with arguments_read():
        check_mount(a.height or 0.0, a.forward or 0.0)
    known = {} if a.settings is None else camera_table(a.settings)
    if a.settings is not None and a.height is None and "height_m" not in known:
        raise UsageError(
            f"{a.settings}: [robot.camera] has no height_m; give --height, the lens above the floor in m"
        )
    model = None if a.lens is None else LensModel(a.lens)
    collection = ViewCollection(BoardDetector(target_of(a)), model)
    console = plain_or_terminal(stderr=a.json)
    source = str(a.source or known.get("source", "0"))
    if a.images is None:
        _live(collection, source, _size(a.size, known), a.http, console)
    else:
        _recorded(collection, a.images, console)
    if not collection.views:
        raise Refused(
            f"{a.images or f'camera {source}'}: no view shows the target ({collection.detector.target}); "
            "is it this one, whole and sharp?"
        )
    found = collection.done or calibrate_camera(collection.views, model)
    _print(found, console)
    written = a.settings is not None and not found.problems
    if written:
        values = _values(found)
        values |= {} if a.images is not None else {"source": source}
        values |= {} if a.height is None else {"height_m": a.height}
        values |= {} if a.forward is None else {"forward_m": a.forward}
        try:
            write_camera(a.settings, values)
        except (MapweaveError, OSError):
            # Showing the target took a person ten minutes.
            _print_values(found, console, f"{a.settings} cannot be written")
            raise
        console.print(f"[robot.camera] written to {a.settings}", markup=False)
    elif not found.problems:
        _print_values(found, console, "no --settings FILE: nothing is written")
    if a.json:
        print(json.dumps(_report(found, written)))
    for problem in found.problems:
        print(f"mapweave: calibration refused: {problem}", file=sys.stderr)
    return NO if found.problems else DONE


def _size(text: str | None, known: dict[str, object]) -> tuple[int, int]:
    if text is not None:
        return size_of(text, "--size")
    width, height = known.get("width", 640), known.get("height", 480)
    return (width, height) if isinstance(width, int) and isinstance(height, int) else (640, 480)


def _live(
    collection: ViewCollection, source: str, size: tuple[int, int], port: int | None, console: Console
) -> None:
    """Guide a person until the views suffice, the stream ends or Ctrl-C."""
    from contextlib import ExitStack

    from mapweave.agent.drivers.camera import Capture
    from mapweave.agent.drivers.settings import CameraSettings
    from mapweave.drawing.guidance_picture import guidance_picture
    from mapweave.processes.calibration_guidance import guide

    width, height = size
    # Only source and size count here.
    settings = CameraSettings(width, height, width, width, width / 2, height / 2, 0.0, source=source)
    with ExitStack() as stack:
        page = None
        if port is not None:
            from mapweave.extras import need
            from mapweave.scenarios.live import LiveFilm as Page

            need("server")
            page = stack.enter_context(Page(port, "Camera calibration"))
            console.print(f"guidance on {page.url}")
        camera = Capture(settings)
        stack.callback(camera.close)
        console.print(f"{collection.detector.target}. Ctrl-C ends it with the views so far.", highlight=False)
        try:
            for image, guidance in guide(camera, collection, console):
                if page is not None:
                    page.show(guidance_picture(image, guidance, collection.views))
        except KeyboardInterrupt:
            console.print("stopped; the views so far are used")


def _recorded(collection: ViewCollection, path: Path, console: Console) -> None:
    """Views of a folder's images, or of a video."""
    from mapweave.agent.recordings.image_folder import images_in
    from mapweave.agent.recordings.video import video_images
    from mapweave.storage.image_file import read_grey
    from mapweave.terminal import tracked

    if not path.exists():
        from mapweave.hybridmap.errors import DeviceError

        raise DeviceError(f"{path}: no such folder or video")
    if path.is_dir():
        paths = images_in(path / "images" if (path / "images").is_dir() else path)
        for image in tracked(paths, "images"):
            view = collection.detector.find(read_grey(image), image.name)
            if view is not None:
                collection.views.append(view)
        if collection.views:
            console.print(f"{len(collection.views)} of {len(paths)} images show the target", highlight=False)
        return
    images = video_images(path)
    if images.damage:
        console.print(images.damage, highlight=False)
    for k in tracked(range(len(images.stamps_ns)), "frames"):
        collection.see(images.read(k), f"frame {k}")
    if collection.views:
        console.print(f"{len(collection.views)} views in {len(images.stamps_ns)} frames", highlight=False)


def _values(found: CameraCalibration) -> dict[str, Any]:
    """Keys of `[robot.camera]`."""
    width, height = found.image_size
    values = [float(f"{value:.6g}") for value in found.fit.intrinsics]
    return {
        "width": width, "height": height, **dict(zip(("fx", "fy", "cx", "cy"), values, strict=False)),
        "lens": str(found.fit.model), "distortion": tuple(values[4:]),
    }  # fmt: skip


def _print_values(found: CameraCalibration, console: Console, why: str) -> None:
    """The result for a person who writes it somewhere."""
    console.print(f"{why}. For [robot.camera], or a recording's camera.toml:", markup=False, highlight=False)
    for key, value in _values(found).items():
        console.print(f"{key} = {json.dumps(value)}", markup=False, highlight=False)


def _print(found: CameraCalibration, console: Console) -> None:
    from rich.table import Table

    from mapweave.processes.calibration_guidance import bars

    fit = found.fit
    names = ["fx", "fy", "cx", "cy"]
    names += ["k1", "k2", "p1", "p2", "k3"] if len(fit.intrinsics) == 9 else ["k1", "k2", "k3", "k4"]
    table = Table(
        "", "value", "sigma", title=f"{fit.model} lens, {found.image_size[0]}x{found.image_size[1]} px"
    )
    for name, value, variance in zip(names, fit.intrinsics, fit.covariance.diagonal(), strict=True):
        table.add_row(name, f"{value:.5g}", f"{variance**0.5:.2g}")
    console.print(table)
    console.print(bars(found.coverage))
    for model, error in found.compared.items():
        if isfinite(error):
            console.print(f"views held out, {model}: corners {error:.2f} px off")
    console.print(
        f"{found.coverage.views} views, {found.outliers} corners left out, noise of a corner "
        f"{fit.sigma_px:.2f} px; "
        f"projections are certain to {found.worst_px:.2f} px where they are worst",
    )


def _report(found: CameraCalibration, written: bool) -> dict[str, Any]:
    return {
        **_values(found),
        "sigma": [float(v) for v in found.fit.covariance.diagonal() ** 0.5],
        "views": found.coverage.views,
        "outliers": found.outliers,
        "corner_sigma_px": found.fit.sigma_px,
        "uncertainty_px": _or_null(found.worst_px),
        "held_out_px": {str(model): _or_null(error) for model, error in found.compared.items()},
        "problems": list(found.problems),
        "written": written,
    }


def _or_null(value: float) -> float | None:
    """The value; None if it is infinite, which JSON has no number for."""
    return value if isfinite(value) else None
