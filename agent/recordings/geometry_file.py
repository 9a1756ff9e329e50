"""The mount of a camera and the scales of wheels in a camera.toml; see docs/calibration.md."""

from __future__ import annotations

import math
import re
import tomllib
from pathlib import Path

from mapweave.agent.calibration.drive_geometry import DriveGeometry
from mapweave.agent.recordings.camera_file import number
from mapweave.hybridmap.errors import DeviceError
from mapweave.storage.atomic_file import read_whole, write_whole

KEYS = {
    "forward_m": "forward", "height_m": "height", "left_m": "left", "heading_deg": "heading",
    "pitch_deg": "pitch", "roll_deg": "roll", "wheel_scale": "wheel_scale", "turn_scale": "turn_scale",
    "drift_deg_per_m": "drift", "delay_s": "delay",
}  # fmt: skip
"""Field of `DriveGeometry` by key; keys with `deg` are in degrees."""
LIMITS = {
    "heading": 0.6,
    "pitch": 0.6,
    "roll": 0.6,
    "left": 10.0,
    "forward": 10.0,
    "drift": 1.0,
    "delay": 1.0,
}


def read_geometry(path: Path) -> DriveGeometry | None:
    """The geometry that a camera.toml gives beyond the camera's height and way ahead; None if it gives none.

    Raises:
        DeviceError: a value is no number or cannot be right.
    """
    try:
        values = tomllib.loads(read_whole(path).decode("utf-8"))
        found = {KEYS[key]: _radians(key, number(values, key)) for key in KEYS if key in values}
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise DeviceError(f"{path}: {error}") from None
    for name, value in found.items():
        scale = name.endswith("scale")
        if not math.isfinite(value) or (scale and not 0.2 < value < 5.0):
            raise DeviceError(f"{path}: {name} {value:g} is out of range")
        if abs(value) > LIMITS.get(name, math.inf):
            raise DeviceError(f"{path}: {name} {value:g} is out of range")
    return DriveGeometry(**found) if set(found) - {"forward", "height"} else None


def write_geometry(path: Path, geometry: DriveGeometry) -> None:
    """Write a geometry into a camera.toml; all else in the file stays.

    Raises:
        DeviceError: the file cannot be read.
    """
    try:
        lines = read_whole(path).decode("utf-8").splitlines()
    except OSError as error:
        raise DeviceError(f"{path}: {error.strerror or error}") from None
    tables = [k for k, line in enumerate(lines) if line.lstrip().startswith("[") and "=" not in line]
    end = tables[0] if tables else len(lines)
    for key, name in KEYS.items():
        value = getattr(geometry, name)
        text = f"{key} = {math.degrees(value) if 'deg' in key else value:.6g}"
        at = next((k for k in range(end) if re.match(rf"\s*{key}\s*=", lines[k])), None)
        if at is not None:
            lines[at] = text
        elif value != getattr(DriveGeometry(), name):
            lines.insert(end, text)
            end += 1
    write_whole(path, ("\n".join(lines) + "\n").encode())


def _radians(key: str, value: float) -> float:
    return math.radians(value) if "deg" in key else value
