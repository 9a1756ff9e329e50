"""TOML files of recordings: a camera, a robot's geometry, the robots into which a recording is cut."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from mapweave.hybridmap.errors import DeviceError, SettingsError
from mapweave.storage.settings_file import no_setting, read_toml


def read_table(path: Path, advice: str) -> dict[str, Any]:
    """Read a file.

    Args:
        path: of the file.
        advice: what the file must say, for the error.

    Raises:
        DeviceError: the file is missing or is not TOML.
    """
    if not path.exists():
        raise DeviceError(f"{path}: no such file; {advice}")
    try:
        return read_toml(path)
    except SettingsError as error:
        raise DeviceError(str(error)) from None


def check_keys(values: Mapping[str, Any], known: Collection[str]) -> None:
    """Refuse a key that nothing reads. Tables of other programs may be there.

    Raises:
        ValueError: the key, and which one may be meant.
    """
    for key, value in values.items():
        tables = value if isinstance(value, list) and value else [value]
        if key not in known and not all(isinstance(table, Mapping) for table in tables):
            raise ValueError(no_setting(key, known))


def number(values: Mapping[str, Any], name: str) -> float:
    """A number of a table.

    Raises:
        KeyError: it is missing.
        ValueError: it is no number.
    """
    value = values[name]
    try:
        if isinstance(value, bool):
            raise TypeError
        return float(value)
    except OverflowError:
        raise ValueError(f"{name} has too many digits") from None
    except (TypeError, ValueError):
        # A row of a table that is too short holds None.
        raise ValueError(f"{name} {'is missing' if value is None else f'{value!r} is no number'}") from None


def whole(values: Mapping[str, Any], name: str) -> int:
    """A whole number of a table. Errors as of `number`."""
    value = values[name]
    if not isinstance(value, int) or isinstance(value, bool):
        # What fits nowhere is refused rather than rounded: half a frame or pixel is a mistake.
        raise ValueError(f"{name} {value!r} is no whole number")  # noqa: TRY004
    return value
