"""Writes `[robot.camera]` into a robot's settings file; all else in the file stays as it is."""

import json
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path

from mapweave.hybridmap.errors import SettingsError
from mapweave.storage.atomic_file import read_whole, write_whole
from mapweave.storage.settings_file import read_toml

HEADER = re.compile(r"\s*\[robot\.camera\]\s*(#.*)?$")
Value = str | int | float | tuple[float, ...]


def camera_table(path: Path) -> dict[str, object]:
    """The `[robot.camera]` table of a file, as it is; empty if there is none.

    Raises:
        SettingsError: the file is no TOML, or the table no table.
    """
    table: object = read_toml(path) if path.exists() else {}
    for name in ("robot", "camera"):
        if not isinstance(table, dict):
            break
        table = table.get(name, {})
    if not isinstance(table, dict):
        raise SettingsError(f"{path}: robot.camera is no table")
    return table


def write_camera(path: Path, values: Mapping[str, Value]) -> None:
    """Set keys of `[robot.camera]`; the file is made if it is not there.

    Raises:
        SettingsError: the file cannot be read, or its camera is written in a way that cannot be changed.
    """
    old = read_whole(path).decode("utf-8-sig") if path.exists() else ""
    camera_table(path)
    lines = old.splitlines()
    at = next((k for k, line in enumerate(lines) if HEADER.match(line)), None)
    if at is None:
        lines += [""] * bool(lines) + ["[robot.camera]"]
        at = len(lines) - 1
    end = next((k for k in range(at + 1, len(lines)) if re.match(r"\s*\[", lines[k])), len(lines))
    while end > at + 1 and not lines[end - 1].strip():
        end -= 1
    for key, value in values.items():
        # Numbers, texts and lists of these are the same in JSON and in TOML.
        text = f"{key} = {json.dumps(value, ensure_ascii=False)}"
        known = next((k for k in range(at + 1, end) if re.match(rf"\s*{key}\s*=", lines[k])), None)
        if known is not None:
            comment = re.search(r"\s+#[^\"\]]*$", lines[known])
            lines[known] = text + (comment[0] if comment else "")
        else:
            lines.insert(end, text)
            end += 1
    new = "\n".join(lines) + "\n"
    try:
        written = tomllib.loads(new)["robot"]["camera"]
        good = all(written[key] == (list(v) if isinstance(v, tuple) else v) for key, v in values.items())
    except (ValueError, KeyError, TypeError):
        good = False
    if not good:
        raise SettingsError(
            f"{path}: its camera is no table [robot.camera] with one key a line; nothing is changed"
        )
    write_whole(path, new.encode())
