"""Cameras in files: camera.toml."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import DeviceError, InvalidValue
from mapweave.storage.atomic_file import read_whole
from mapweave.vision.lens import Distortion, LensModel, lens_of


def read_camera(path: Path) -> tuple[Camera, Distortion]:
    """Read a `camera.toml`: px, and metres above the floor.

    Returns:
        The ideal camera and the lens.

    Raises:
        DeviceError: the file is missing or wrong.
    """
    try:
        values = tomllib.loads(read_whole(path).decode("utf-8"))
        camera = Camera(
            width=whole(values["width"]), height=whole(values["height"]), fx=number(values, "fx"),
            fy=number(values, "fy"), cx=number(values, "cx"), cy=number(values, "cy"),
            mount_height=number(values, "height_m"),
            mount_forward=number(values, "forward_m") if "forward_m" in values else 0.0,
        )  # fmt: skip
        model = LensModel(values.get("lens", LensModel.RADIAL_TANGENTIAL))
        return lens_of(camera, model, values.get("distortion", ()))
    except FileNotFoundError:
        raise DeviceError(f"{path}: no such file; it must give the camera's intrinsics") from None
    except KeyError as missing:
        raise DeviceError(f"{path}: {missing.args[0]!r} is missing") from None
    except (OSError, ValueError, TypeError, OverflowError, InvalidValue) as error:
        raise DeviceError(f"{path}: {error}") from None


def number(values: Mapping[str, Any], name: str) -> float:
    value = values[name]
    try:
        return float(value)
    except (TypeError, ValueError):
        # A row of a table that is too short holds None.
        raise ValueError(f"{name} {'is missing' if value is None else f'{value!r} is no number'}") from None


def whole(value: Any) -> int:
    if not isinstance(value, int):
        # What fits nowhere is refused rather than rounded: half a frame or pixel is a mistake.
        raise ValueError(f"{value!r} is no whole number")  # noqa: TRY004
    return value
