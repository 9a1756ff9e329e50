"""Which format a recording has, and the way to open it."""

import os
from collections.abc import Callable
from pathlib import Path

from mapweave.agent.recordings import bag as bags
from mapweave.agent.recordings import video as videos
from mapweave.agent.recordings.folders import (
    KITTI_IMAGES,
    euroc,
    four_seasons,
    images_folder,
    kitti,
    tum_rgbd,
)
from mapweave.agent.recordings.image_folder import has_images
from mapweave.agent.recordings.options import RecordingOptions
from mapweave.agent.recordings.recording import Recording
from mapweave.hybridmap.errors import DeviceError
from mapweave.storage.os_errors import unreadable

PACKED = ".zstd"
Opener = Callable[[Path, RecordingOptions], Recording]
FORMATS = (
    "a folder of images with camera.toml, a bag (.mcap, .bag, .db3 or its folder), a video, or a sequence "
    "of KITTI odometry, EuRoC, TUM RGB-D or 4Seasons"
)

MARKS: dict[str, Opener] = {
    "images": images_folder, "camera.toml": images_folder, "metadata.yaml": bags.bag, "mav0": euroc,
    "rgb.txt": tum_rgbd, "undistorted_images": four_seasons, "calib.txt": kitti,
    **dict.fromkeys(KITTI_IMAGES, kitti),
}  # fmt: skip
"""Names in a folder that say which format it has, the surest first."""


def open_recording(path: Path, options: RecordingOptions | None = None) -> Recording:
    """Open a recording of any known format.

    Raises:
        DeviceError: it is none, or something in it is missing or wrong; one line says what.
    """
    options = options or RecordingOptions()
    opened = _opener(path)
    has_height = opened is images_folder and (path / "camera.toml").exists()
    options.check_used(path, opened is bags.bag, has_height)
    return opened(path, options.of_bag() if opened is bags.bag else options)


def _opener(path: Path) -> Opener:
    """What opens a recording of this format.

    Raises:
        DeviceError: it is none.
    """
    if path.is_file():
        try:
            path.open("rb").close()
        except OSError as error:
            # Those that read bags and videos say that it is none.
            raise DeviceError(str(unreadable(path, error))) from None
        if not path.stat().st_size:
            # As a copy that has failed. Readers say that it is another format, or that its index is lost.
            raise DeviceError(f"{path}: the file is empty")
        if path.suffix.lower() in bags.SUFFIXES:
            return bags.bag
        if path.suffix.lower() in videos.SUFFIXES:
            return videos.video
        if path.suffix.lower() == PACKED and Path(path.stem).suffix.lower() in bags.SUFFIXES:
            raise DeviceError(
                f"{path}: a bag that is packed as a whole; give its folder with metadata.yaml, or unpack it "
                "with `unzstd`"
            )
        raise DeviceError(f"{path}: not a recording; one is {FORMATS}")
    if not path.is_dir():
        raise DeviceError(f"{path}: no such folder or file; a recording is {FORMATS}")
    opened = _named(path) or _unnamed(path)
    if opened is None:
        raise DeviceError(f"{path}: not a recording{_near(path)}; one is {FORMATS}")
    return opened


def _named(folder: Path) -> Opener | None:
    """What opens a folder by a name in it."""
    return next((opened for mark, opened in MARKS.items() if (folder / mark).exists()), None)


def _unnamed(folder: Path) -> Opener | None:
    """What opens a folder of bags, or of images."""
    if bags.parts_of(folder):
        return bags.bag
    return images_folder if has_images(folder) else None


def _near(path: Path) -> str:
    """Which folder around or inside a folder is one, in words: archives unpack to several levels."""
    try:
        below = _folders_in(path)
        below += [inside for each in below for inside in _folders_in(each)]
        found = next((each for each in below if _named(each)), None)
        if found is None and path.resolve().name in MARKS:
            found = path.resolve().parent
        found = found or next((each for each in below if _unnamed(each)), None)
    except OSError:
        # It is a hint alone: another user's folder is not looked into.
        return ""
    return "" if found is None else f", but {found} is"


def _folders_in(folder: Path) -> list[Path]:
    with os.scandir(folder) as entries:
        return sorted(Path(entry.path) for entry in entries if entry.is_dir())
