"""Images of floor plans on the server's disk, in a folder beside the store, each named by its content."""

import hashlib
import threading
from collections.abc import Iterable, Mapping
from pathlib import Path

from mapweave.hybridmap.annotation import Annotations
from mapweave.hybridmap.errors import InvalidFile, InvalidValue
from mapweave.hybridmap.floor_plan import FloorPlan, PlanImage
from mapweave.mapserver.log.store import Store
from mapweave.storage.atomic_file import read_whole, write_whole
from mapweave.storage.os_errors import reason_of
from mapweave.storage.plan_image import check_plan_png

MOST_BYTES = 2**29
"""Of all images together: a plan takes about 2 MiB."""
SUFFIX = ".png"
RESULT = "plan image "
"""With which the names of images begin among the results of a store that servers share."""


def kept_images(store: Path, annotations: Annotations) -> dict[str, bytes]:
    """The images of a store's plans that are in force, read only; those that are lost are left out."""
    used = {plan.image.sha256 for _, plan in annotations.in_force(FloorPlan)}
    folder = _folder_of(store)
    files = {name: folder / f"{name}{SUFFIX}" for name in sorted(used)}
    return {name: path.read_bytes() for name, path in files.items() if path.is_file()}


def copy_images(store: Path, to: Path) -> None:
    """Copy all images of a store beside a copy of it. Those that are there are not written again.

    Raises:
        InvalidFile: one cannot be read, or the disk does not take it.
    """
    folder = _folder_of(to)
    for path in sorted(_folder_of(store).glob(f"*{SUFFIX}")):
        try:
            png = read_whole(path)
            folder.mkdir(exist_ok=True)
        except OSError as error:
            raise InvalidFile(f"{error.filename}: {reason_of(error)}") from None
        if not _holds(folder / path.name, png):
            write_whole(folder / path.name, png)


def recorded_images(store: Store, annotations: Annotations) -> dict[str, bytes]:
    """The same of a store that servers share."""
    used = sorted({plan.image.sha256 for _, plan in annotations.in_force(FloorPlan)})
    images = {name: store.result(RESULT + name) for name in used}
    return {name: png for name, png in images.items() if png is not None}


def _folder_of(store: Path) -> Path:
    return store.with_name(f"{store.name}.plans")


def _holds(path: Path, png: bytes) -> bool:
    """Whether an image is there, and whole: the disk may have damaged it."""
    try:
        return read_whole(path) == png
    except OSError:
        return False


class PlanImages:
    """Kept until no plan names them. Thread-safe."""

    def __init__(
        self,
        store: Path,
        used: Iterable[str],
        beside: Mapping[str, bytes] | None = None,
        shared: Store | None = None,
    ) -> None:
        """Open the folder of a store.

        Args:
            store: path of the store; the folder is made when the first image comes.
            used: names of images that plans use, or have used; others are removed.
            beside: images that are there besides, in memory.
            shared: the store of several servers: an image that one was given is there for all.
        """
        self._beside, self._shared = dict(beside or {}), shared
        self._folder = _folder_of(store)
        self._lock = threading.Lock()
        kept = {f"{name}{SUFFIX}" for name in used}
        for path in self._folder.glob(f"*{SUFFIX}"):
            if path.name not in kept:
                path.unlink(missing_ok=True)

    def put(self, png: bytes) -> PlanImage:
        """Keep an image; it is on the disk when this returns. The same one twice is kept once.

        Raises:
            InvalidValue: it is no PNG file, too large, or there are too many.
            InvalidFile: the disk does not take it.
        """
        image = check_plan_png(png)
        with self._lock:
            path = self._path(image.sha256)
            if not _holds(path, png):
                others = (other for other in self._folder.glob(f"*{SUFFIX}") if other != path)
                total = sum(other.stat().st_size for other in others)
                if total + len(png) > MOST_BYTES:
                    raise InvalidValue(f"the images of plans take {total >> 20} MiB: no more are kept")
                self._folder.mkdir(parents=True, exist_ok=True)
                if self._shared is not None:
                    self._shared.put_result(RESULT + image.sha256, png)
                write_whole(path, png)
        return image

    def get(self, sha256: str) -> bytes:
        """The PNG file of an image.

        Raises:
            InvalidFile: it is not there, or damaged.
        """
        path = self._path(sha256)
        if sha256 in self._beside:
            return self._beside[sha256]
        try:
            png = read_whole(path)
        except OSError:
            png = (self._shared and self._shared.result(RESULT + sha256)) or b""
        if not png:
            raise InvalidFile(f"the image {sha256[:12]} of a plan is not on the server's disk")
        if hashlib.sha256(png).hexdigest() != sha256:
            raise InvalidFile(f"the image {sha256[:12]} of a plan is damaged: add the plan again")
        return png

    def __contains__(self, sha256: str) -> bool:
        if sha256 in self._beside or self._path(sha256).is_file():
            return True
        return self._shared is not None and self._shared.result(RESULT + sha256) is not None

    def _path(self, sha256: str) -> Path:
        # A name comes from a message: `PlanImage` has checked it, others may not have.
        if len(sha256) != 64 or not set(sha256) <= set("0123456789abcdef"):
            raise InvalidValue(f"{sha256[:70]!r} is no name of an image")
        return self._folder / f"{sha256}{SUFFIX}"
