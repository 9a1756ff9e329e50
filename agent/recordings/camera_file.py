"""Cameras in files: camera.toml."""

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

from mapweave.agent.drive_geometry import check_mount
from mapweave.agent.recordings.geometry_file import FILE_KEYS
from mapweave.agent.recordings.toml_file import check_keys, number, read_table, whole
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import DeviceError, InvalidValue
from mapweave.vision.lens import Distortion, LensModel, lens_of


def read_camera(path: str | PathLike[str]) -> tuple[Camera, Distortion]:
    """Read a `camera.toml`: px, and metres above the floor.

    Returns:
        The ideal camera and the lens.

    Raises:
        DeviceError: the file is missing or wrong.
    """
    values = read_table(Path(path), "it must give the camera's intrinsics")
    try:
        check_keys(values, FILE_KEYS)
        camera = Camera(
            width=whole(values, "width"), height=whole(values, "height"), fx=number(values, "fx"),
            fy=number(values, "fy"), cx=number(values, "cx"), cy=number(values, "cy"),
            mount_height=number(values, "height_m"),
            mount_forward=number(values, "forward_m") if "forward_m" in values else 0.0,
        )  # fmt: skip
        check_mount(camera.mount_height, camera.mount_forward)
        model = values.get("lens", LensModel.RADIAL_TANGENTIAL)
        if model not in list(LensModel):
            raise ValueError(f"lens {model!r} is not known; it is {' or '.join(LensModel)}")
        return lens_of(camera, LensModel(model), values.get("distortion", ()))
    except KeyError as missing:
        raise DeviceError(f"{path}: {missing.args[0]!r} is missing{_where_it_is(values)}") from None
    except (ValueError, TypeError, OverflowError, InvalidValue) as error:
        raise DeviceError(f"{path}: {error}") from None


def _where_it_is(values: Mapping[str, Any]) -> str:
    """What to do about a key that is missing: a robot's settings file has the camera in a table."""
    robot = values.get("robot")
    if isinstance(robot, Mapping) and "camera" in robot:
        return ": this is a settings file; copy what is below [robot.camera] into a file of its own"
    return "; a camera's file gives width, height, fx, fy, cx, cy (px) and height_m"
