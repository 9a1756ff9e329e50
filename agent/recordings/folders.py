"""Folders as benchmarks publish them: KITTI odometry, EuRoC, TUM RGB-D, 4Seasons. No ground truth is read."""

import csv
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mapweave.agent.recordings.camera_file import read_camera
from mapweave.agent.recordings.image_folder import images_in, images_of, read_increments, read_times
from mapweave.agent.recordings.incomplete import CameraAndLens, CameraGiven, complete, first_image
from mapweave.agent.recordings.options import RecordingOptions
from mapweave.agent.recordings.pose_files import read_poses
from mapweave.agent.recordings.recording import Images, Recording, Stamps, stamps_of
from mapweave.agent.recordings.table_file import named_columns, read_text
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import DeviceError, InvalidValue
from mapweave.storage.image_file import UsedBits, read_grey
from mapweave.vision.lens import NO_DISTORTION, LensModel, lens_of

Intrinsics = tuple[float, float, float, float]
"""fx, fy, cx, cy, px."""
FOUR_SEASONS_CALIBRATION = "calibration", "Calibration"
"""Folders that its archives unpack to."""
LENS_NAMES = dict.fromkeys(("radtan", "radialtangential", "plumb_bob"), LensModel.RADIAL_TANGENTIAL.value)
"""EuRoC's lens models by the names that Kalibr, OKVIS and ROS have for them: k1, k2, p1, p2."""
KITTI_IMAGES = "image_0", "image_2"
"""Folders of the left cameras, grey and colour."""


def kitti(folder: Path, options: RecordingOptions) -> Recording:
    """A sequence of KITTI's odometry benchmark: image_0 (or image_2), calib.txt, times.txt.

    Of an excerpt times.txt may be that of the whole sequence.

    Raises:
        DeviceError: something is missing or wrong.
    """
    name = next((name for name in KITTI_IMAGES if (folder / name).is_dir()), None)
    if name is None:
        raise DeviceError(
            f"{folder}: as KITTI odometry it needs {' or '.join(KITTI_IMAGES)}, with the images"
        )
    paths, calibration, times = images_in(folder / name), folder / "calib.txt", folder / "times.txt"
    assumed = "" if times.exists() else f"no {times.name}: ten images a second are assumed"
    stamps = stamps_of(times, 0.1 * np.arange(len(paths))) if assumed else _numbered_seconds(times, paths)
    given = None
    if options.camera is None and calibration.exists():
        row = f"P{name[-1]}:"
        lines = [line.split()[1:] for line in _lines(calibration) if line.startswith(row)]
        if not lines or len(lines[0]) != 12:
            raise DeviceError(f"{calibration}: no line {row} with twelve numbers")
        p = _numbers(calibration, lines[0])
        given = _camera(paths, (p[0], p[5], p[2], p[6])), NO_DISTORTION
    return _folder(folder, "KITTI odometry", paths, stamps, given, options, assumed)


def euroc(folder: Path, options: RecordingOptions) -> Recording:
    """An EuRoC MAV sequence: mav0/cam0 with data.csv, data/ and sensor.yaml.

    Raises:
        DeviceError: something is missing or wrong.
    """
    cam = folder / "mav0" / "cam0"
    rows = [line.split(",") for line in _lines(cam / "data.csv") if line.strip() and not line.startswith("#")]
    paths = [cam / "data" / row[-1].strip() for row in rows]
    try:
        stamps = np.array([int(row[0]) for row in rows], np.int64)
    except (ValueError, OverflowError) as error:
        raise DeviceError(f"{cam / 'data.csv'}: {error}") from None
    if not paths:
        raise DeviceError(f"{cam / 'data.csv'}: no images")
    known = options.camera is None and (cam / "sensor.yaml").exists()
    given = _euroc_camera(cam, paths) if known else None
    return _folder(folder, "EuRoC", paths, stamps, given, options)


def _euroc_camera(cam: Path, paths: Sequence[Path]) -> CameraAndLens:
    """What sensor.yaml says.

    Raises:
        DeviceError: it is missing or wrong.
    """
    text = "\n".join(_lines(cam / "sensor.yaml"))
    intrinsics, lens = (
        _yaml_list(cam, text, "intrinsics", 4),
        _yaml_list(cam, text, "distortion_coefficients", 4),
    )
    model = re.search(r"^distortion_model:\s*(\S+)", text, re.M)
    name = str(LensModel.RADIAL_TANGENTIAL) if model is None else LENS_NAMES.get(model[1], model[1])
    if name not in list(LensModel):
        known = " and ".join(LensModel)
        raise DeviceError(f"{cam / 'sensor.yaml'}: lens model {name} is not supported; {known} are")
    fx, fy, cx, cy = intrinsics
    try:
        coefficients = [*lens, 0.0] if name == LensModel.RADIAL_TANGENTIAL else lens
        return lens_of(_camera(paths, (fx, fy, cx, cy)), LensModel(name), coefficients)
    except InvalidValue as error:
        raise DeviceError(f"{cam / 'sensor.yaml'}: {error}") from None


def tum_rgbd(folder: Path, options: RecordingOptions) -> Recording:
    """A TUM RGB-D sequence: rgb.txt and rgb/. The depth images are not read.

    Raises:
        DeviceError: something is missing or wrong.
    """
    rows = [line.split() for line in _lines(folder / "rgb.txt") if line.strip() and not line.startswith("#")]
    if not all(len(row) == 2 for row in rows) or not rows:
        raise DeviceError(f"{folder / 'rgb.txt'}: lines are `stamp file`")
    path = folder / "rgb.txt"
    stamps = stamps_of(path, _numbers(path, [row[0] for row in rows]))
    return _folder(folder, "TUM RGB-D", [folder / row[1] for row in rows], stamps, None, options)


def four_seasons(folder: Path, options: RecordingOptions) -> Recording:
    """A sequence as 4Seasons has it: undistorted_images/cam0 and times.txt (frame, seconds, exposure).

    The calibration is an archive of its own: a folder in the sequence or beside it.

    Raises:
        DeviceError: something is missing or wrong.
    """
    paths = images_in(folder / "undistorted_images" / "cam0")
    rows = {row[0]: row[1] for line in _lines(folder / "times.txt") if len(row := line.split()) >= 2}
    lost = [path for path in paths if path.stem not in rows]
    if lost:
        raise DeviceError(f"{folder / 'times.txt'}: no line for {lost[0].name}")
    times = folder / "times.txt"
    stamps = stamps_of(times, _numbers(times, [rows[path.stem] for path in paths]))
    file = next((file for file in _calibrations(folder) if file.exists()), None)
    given = None if file is None or options.camera is not None else _four_seasons_camera(file, paths)
    return _folder(folder, "4Seasons", paths, stamps, given, options)


def _calibrations(folder: Path) -> list[Path]:
    places = [
        place / name for place in (folder, folder.resolve().parent) for name in FOUR_SEASONS_CALIBRATION
    ]
    return [place / "undistorted_calib_0.txt" for place in places]


def _four_seasons_camera(file: Path, paths: Sequence[Path]) -> CameraAndLens:
    """The first line is `Pinhole fx fy cx cy` and zeros, px: the images are without distortion.

    Raises:
        DeviceError: it is not.
    """
    words = " ".join(_lines(file)[:1]).split()
    values = _numbers(file, words[1:])
    if words[:1] != ["Pinhole"] or len(values) < 4 or any(values[4:]):
        raise DeviceError(f"{file}: the first line must be `Pinhole fx fy cx cy 0`; else give --camera FILE")
    return _camera(paths, (values[0], values[1], values[2], values[3])), NO_DISTORTION


def images_folder(folder: Path, options: RecordingOptions) -> Recording:
    """images/, camera.toml, times.txt, and odometry.csv as increments or as stamped poses.

    Raises:
        DeviceError: something is missing or wrong.
    """
    paths, kind = images_of(folder), "folder of images"
    file = options.camera or folder / "camera.toml"
    if options.camera is None and not file.exists():
        optics = CameraGiven(
            None, f"no {file.name}; it must give the camera's intrinsics: give --camera FILE"
        )
    else:
        optics = CameraGiven(read_camera(file))
    times = folder / "times.txt"
    seconds, lacking = read_times(times, len(paths))
    stamps = stamps_of(times, seconds)
    lines: tuple[str, ...] = (f"{lacking}; the first {len(stamps)} images are used",) if lacking else ()
    path = folder / "odometry.csv"
    images = _images(paths, stamps, None if optics.known is None else optics.known[0])
    if not times.exists():
        images = replace(images, assumed=f"no {times.name}: ten images a second are assumed")
    if options.odometry is not None or _is_poses(path):
        return complete(folder, kind, optics, images, read_poses(options.odometry or path), damage=lines)
    if not path.exists():
        return complete(folder, kind, optics, images, None, damage=lines)
    increments, damage = read_increments(path, len(paths))
    images = replace(images, stamps_ns=stamps[: len(increments)])
    increments = increments[: len(images.stamps_ns)]
    lines += (f"{damage}; the images before it are used",) if damage else ()
    return complete(folder, kind, optics, images, increments, damage=lines)


def _is_poses(path: Path) -> bool:
    """Whether an odometry.csv has stamped poses rather than increments."""
    try:
        with path.open(newline="") as file:
            return "x_m" in named_columns(file)
    except (OSError, ValueError, csv.Error):
        return False


def _folder(
    folder: Path,
    kind: str,
    paths: Sequence[Path],
    stamps_ns: Stamps,
    given: CameraAndLens | None,
    options: RecordingOptions,
    assumed: str = "",
) -> Recording:
    optics = options.camera_of(given)
    beside = next((p for p in (folder / "odometry.csv", folder / "odometry.txt") if p.exists()), None)
    odometry = options.odometry or beside
    poses = None if odometry is None else read_poses(odometry)
    images = replace(_images(paths, stamps_ns), assumed=assumed)
    return complete(folder, kind, optics, images, poses)


def _images(paths: Sequence[Path], stamps_ns: Stamps, camera: Camera | None = None) -> Images:
    used = UsedBits(paths[0].parent.name)
    return Images(stamps_ns, lambda k: read_grey(paths[k], camera, "camera.toml", used))


def _camera(images: Sequence[Path], intrinsics: Intrinsics) -> Camera:
    """The camera of images of the size of the first that can be read.

    Raises:
        DeviceError: none can be read, or no camera has these intrinsics.
    """
    image, _ = first_image(len(images), lambda k: read_grey(images[k]))
    height, width = image.shape
    try:
        return Camera(width, height, *intrinsics, mount_height=0.0)
    except InvalidValue as error:
        raise DeviceError(f"{images[0].parent}: {error}") from None


def _lines(path: Path) -> list[str]:
    text, damage = read_text(path)
    if damage:
        raise DeviceError(damage)
    return text.splitlines()


def _numbers(path: Path, words: Sequence[str]) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise DeviceError(f"{path}: {error}") from None


def _numbered_seconds(path: Path, images: Sequence[Path]) -> Stamps:
    """Times of images of which each is named by its line, counted from 0; of an excerpt there are more lines.

    Raises:
        DeviceError: there are more lines, and the names are not their numbers, or there are fewer.
    """
    times = _numbers(path, "\n".join(_lines(path)).split())
    lines = [int(image.stem) for image in images if re.fullmatch(r"[0-9]+", image.stem)]
    if len(times) > len(images) == len(lines) and lines[-1] < len(times):
        times = [times[line] for line in lines]
    if len(times) != len(images):
        raise DeviceError(
            f"{path}: {len(times)} times for {len(images)} images; there must be a line for each image, or "
            "the name of each image must be the number of its line, counted from 0"
        )
    return stamps_of(path, times)


def _yaml_list(folder: Path, text: str, name: str, count: int) -> list[float]:
    """A list of numbers in a flat YAML file, in brackets or with a line each."""
    path = folder / "sensor.yaml"
    found = re.search(rf"^{name}:\s*(?:\[([^\]]*)\]|((?:\n\s*-[^\n]*)+))", text, re.M)
    words = [] if found is None else re.sub(r"^\s*-\s|,", " ", found[1] or found[2], flags=re.M).split()
    values = _numbers(path, words)
    if len(values) != count:
        raise DeviceError(f"{path}: {name} must have {count} numbers")
    return values
