"""Tables in text files: rows of columns that commas separate, below a line with their names."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapweave.hybridmap.errors import DeviceError
from mapweave.storage.atomic_file import read_whole
from mapweave.storage.os_errors import reason_of

if TYPE_CHECKING:
    _Rows = csv.DictReader[str]
else:
    # Python 3.11 knows the values' type to checkers alone.
    _Rows = csv.DictReader

SEPARATORS = ";\t|"
"""What programs write in the place of commas."""


def read_text(path: Path) -> tuple[str, str]:
    """The lines of a file up to the first that is no text.

    Returns:
        The lines before it, and which line it is, in one line; empty if all are text.

    Raises:
        DeviceError: the file is missing, cannot be read, or does not begin with text.
    """
    try:
        data = read_whole(path)
    except FileNotFoundError:
        raise DeviceError(f"{path}: no such file") from None
    except OSError as error:
        raise DeviceError(f"{path}: {reason_of(error)}") from None
    except ValueError as error:
        raise DeviceError(f"{path}: {error}") from None
    end = data.find(b"\0")
    end = len(data) if end < 0 else end
    try:
        text = data[:end].decode("utf-8-sig")
    except UnicodeDecodeError as error:
        end = error.start
        text = data[:end].decode("utf-8-sig", "ignore")
    if end == len(data):
        return text, ""
    text = text[: text.rfind("\n") + 1]
    if not text:
        raise DeviceError(f"{path}: is no text in UTF-8; it must be one")
    return text, f"{path}: line {text.count(chr(10)) + 1}: is no text"


def named_columns(lines: Iterable[str]) -> list[str]:
    """The names in the first line of a table, whatever separates them."""
    first = next(iter(lines), "")
    for separator in SEPARATORS:
        first = first.replace(separator, ",")
    return next(csv.reader([first]), [])


class TableRows(_Rows):
    """The rows of a table, by the names of their columns."""

    def __next__(self) -> dict[str | Any, str | Any]:
        """The next row.

        Raises:
            ValueError: it has more values than the table has columns: a decimal comma separates, too.
        """
        row = super().__next__()
        if any(row.get(self.restkey) or ()):
            raise ValueError("more values than columns; write numbers with a point, not a comma")
        return row


def rows_of(path: Path, lines: Sequence[str], columns: Sequence[str], otherwise: str = "") -> TableRows:
    """The rows of a table.

    Args:
        path: of the file, for the error.
        lines: of it.
        columns: that it must have; others are not read.
        otherwise: what else such a file may have, for the error.

    Raises:
        DeviceError: it lacks a column or has one twice, or something else separates the columns.
    """
    reader = TableRows(lines, skipinitialspace=True)
    try:
        lacking = [name for name in columns if name not in (reader.fieldnames or ())]
    except csv.Error as error:
        raise DeviceError(f"{path}: line 1: {error}") from None
    for name in columns:
        if list(reader.fieldnames or ()).count(name) > 1:
            raise DeviceError(f"{path}: column {name!r} is there twice; keep one")
    if not lacking:
        return reader
    if lacking[0] in named_columns(lines):
        found = next(one for one in SEPARATORS if one in lines[0])
        raise DeviceError(
            f"{path}: columns are separated by {found!r}; separate them by commas, and write numbers with "
            "a point"
        )
    raise DeviceError(f"{path}: no column {lacking[0]!r}; it must have {', '.join(columns)}{otherwise}")
