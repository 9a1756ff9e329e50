"""The mount of a camera and the scales of wheels in a TOML file: a camera.toml, or a robot's own.

See docs/calibrate-drive.md for the keys.
"""

import math
import re
from collections.abc import Mapping
from pathlib import Path

from mapweave.agent.drive_geometry import FARTHEST, DriveGeometry
from mapweave.agent.recordings.toml_file import check_keys, number, read_table
from mapweave.hybridmap.errors import DeviceError
from mapweave.storage.atomic_file import read_whole, write_whole

KEYS = {
    "forward": "forward_m", "left": "left_m", "height": "height_m", "heading": "heading_deg",
    "pitch": "pitch_deg", "roll": "roll_deg", "wheel_scale": "wheel_scale", "turn_scale": "turn_scale",
    "drift": "drift_deg_per_m", "delay": "delay_s",
}  # fmt: skip
"""Key by field of `DriveGeometry`; keys with `deg` are in degrees."""
CAMERA_KEYS = ("width", "height", "fx", "fy", "cx", "cy", "lens", "distortion")
FILE_KEYS = (*CAMERA_KEYS, *KEYS.values())
"""What a camera.toml or a robot's own file may give."""
LIMITS = {
    "forward": (-FARTHEST, FARTHEST), "left": (-FARTHEST, FARTHEST), "height": (0.001, FARTHEST),
    "heading": (-0.6, 0.6), "pitch": (-0.6, 0.6), "roll": (-0.6, 0.6),
    "wheel_scale": (0.2, 5.0), "turn_scale": (0.2, 5.0), "drift": (-1.0, 1.0), "delay": (-1.0, 1.0),
}  # fmt: skip
"""What cannot be right is a mistake in the file; m, rad, rad/m, s."""


def read_geometry(path: Path) -> dict[str, float]:
    """The fields of `DriveGeometry` that a file gives; none if there is no file.

    Raises:
        DeviceError: the file cannot be read, has an unknown key, or a value is no number or cannot be right.
    """
    if not path.exists():
        return {}
    values = read_table(path, "it must give the robot's geometry")
    try:
        check_keys(values, FILE_KEYS)
        found = {field: _scale(key) * number(values, key) for field, key in KEYS.items() if key in values}
    except ValueError as error:
        raise DeviceError(f"{path}: {error}") from None
    if wrong := beyond_limits(found):
        raise DeviceError(f"{path}: {wrong}")
    return found


def beyond_limits(values: Mapping[str, float]) -> str:
    """The first of some fields of `DriveGeometry` that cannot be right, in words; empty if all can."""
    for field, value in values.items():
        low, high = LIMITS[field]
        if not low <= value <= high:
            key = KEYS[field]
            scale = _scale(key)
            return f"{key} is {value / scale:g}; it must be from {low / scale:.4g} to {high / scale:.4g}"
    return ""


def write_geometry(path: Path, geometry: DriveGeometry, notes: Mapping[str, str]) -> None:
    """Write a geometry into a file; all else in it stays.

    Args:
        path: of the file; its folder is made.
        geometry: to write.
        notes: a comment by field.

    Raises:
        DeviceError: the file cannot be read or written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = read_whole(path).decode("utf-8-sig").splitlines() if path.exists() else []
        tables = [k for k, line in enumerate(lines) if line.lstrip().startswith("[")]
        end = tables[0] if tables else len(lines)
        for field, key in KEYS.items():
            text = f"{key} = {getattr(geometry, field) / _scale(key):.6g}"
            if field in notes:
                text += f"  # {notes[field]}"
            at = next((k for k in range(end) if re.match(rf"\s*{key}\s*=", lines[k])), end)
            lines[at : at + (at < end)] = [text]
            end += at == end
        write_whole(path, ("\n".join(lines) + "\n").encode())
    except (OSError, ValueError) as error:
        raise DeviceError(f"{path}: {error}") from None


def _scale(key: str) -> float:
    """The scale of a value in the file, to SI."""
    return math.radians(1.0) if "deg" in key else 1.0
