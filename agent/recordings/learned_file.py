"""What a robot has learned of its geometry, in a TOML file that people can read, and delete to forget it."""

import math
from dataclasses import asdict
from datetime import date
from pathlib import Path
from typing import Any

from mapweave.agent.calibration.learned import LEARNABLE, LearnedGeometry, LearnedParameter
from mapweave.agent.drive_geometry import DriveGeometry, Parameter
from mapweave.agent.recordings.geometry_file import beyond_limits
from mapweave.agent.recordings.toml_file import number, read_table
from mapweave.hybridmap.errors import DeviceError
from mapweave.storage.atomic_file import write_whole

INTRINSICS = ("fx", "fy", "cx", "cy")
LOGARITHMIC = (Parameter.WHEEL_SCALE,)


def write_learned(path: Path, learned: LearnedGeometry, on: date) -> None:
    """Write what is learned in place of what was.

    Raises:
        DeviceError: the disk does not take it.
    """
    lines = [
        "# What the robot has learned of its geometry while it mapped, in m, rad and s.",
        "# Written by `mapweave agent`; delete this file to forget it.",
        f"learned_on = {on.isoformat()}",
        "",
        "[declared]",
        *(f"{field} = {value!r}" for field, value in asdict(learned.declared).items()),
        "",
        "[camera]",
        *(f"{name} = {value!r}" for name, value in zip(INTRINSICS, learned.intrinsics, strict=True)),
    ]
    for p, one in learned.parameters.items():
        value = math.exp(one.value) if p in LOGARITHMIC else one.value
        lines += ["", f"[learned.{p.name.lower()}]", f"value = {value!r}", f"sigma = {one.sigma!r}"]
    try:
        write_whole(path, ("\n".join(lines) + "\n").encode())
    except OSError as error:
        raise DeviceError(f"{path}: {error}") from None


def read_learned(path: Path) -> tuple[LearnedGeometry, date] | None:
    """What is learned, and the day; None if there is no file.

    Raises:
        DeviceError: the file cannot be read, or a value cannot be right.
    """
    if not path.exists():
        return None
    values = read_table(path, "an agent writes it")
    try:
        on = values.get("learned_on")
        if not isinstance(on, date):
            raise ValueError("learned_on is no date")  # noqa: TRY004
        fields = list(asdict(DriveGeometry()))
        declared = _numbers(values, "declared", fields)
        intrinsics = _numbers(values, "camera", INTRINSICS)
        learned = values.get("learned", {})
        names = [p.name.lower() for p in LEARNABLE]
        for name in learned:
            if name not in names:
                raise ValueError(f"{name} is nothing that a robot learns")
        parameters = {p: _parameter(learned, p) for p in LEARNABLE if p.name.lower() in learned}
        whole = LearnedGeometry(
            DriveGeometry(**declared),
            (intrinsics["fx"], intrinsics["fy"], intrinsics["cx"], intrinsics["cy"]),
            parameters,
        )
        for geometry in (whole.declared, whole.over(whole.declared)):
            if wrong := beyond_limits(asdict(geometry)):
                raise ValueError(wrong)
    except KeyError as error:
        raise DeviceError(f"{path}: {error.args[0]} is missing") from None
    except ValueError as error:
        raise DeviceError(f"{path}: {error}") from None
    return whole, on


def _parameter(learned: dict[str, Any], p: Parameter) -> LearnedParameter:
    given = _numbers(learned, p.name.lower(), ("value", "sigma"))
    if not 0.0 < given["sigma"] < math.inf:
        raise ValueError(f"sigma of {p.name.lower()} is {given['sigma']:g}; it must be positive")
    value = given["value"]
    if p in LOGARITHMIC:
        if not value > 0.0:
            raise ValueError(f"{p.name.lower()} is {value:g}; it must be positive")
        value = math.log(value)
    return LearnedParameter(value, given["sigma"])


def _numbers(values: dict[str, Any], table: str, names: Any) -> dict[str, float]:
    """Some numbers of a table.

    Raises:
        KeyError: one is missing.
        ValueError: one is no number, or there is no such table.
    """
    found = values.get(table, {})
    if not isinstance(found, dict):
        raise ValueError(f"{table} is no table")  # noqa: TRY004
    numbers = {name: number(found, name) for name in names}
    for name, value in numbers.items():
        if not math.isfinite(value):
            raise ValueError(f"{name} is {value:g}")
    return numbers
