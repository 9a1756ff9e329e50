"""The printed settings file and its page: complete, true, and few enough to be read."""

from __future__ import annotations

import dataclasses
import tomllib
from pathlib import Path
from typing import Any

import pytest

import mapweave
from mapweave.cli import main
from mapweave.hybridmap.errors import MapweaveError
from mapweave.settings import Settings
from mapweave.settings_reference import as_markdown, as_toml, sections
from mapweave.storage.settings_file import build

PAGE = Path(mapweave.__file__).resolve().parent.parent / "docs" / "settings.md"


def leaves(values: dict[str, Any], path: str = "") -> dict[str, Any]:
    """All values by their whole name."""
    out: dict[str, Any] = {}
    for name, value in values.items():
        out |= leaves(value, f"{path}{name}.") if isinstance(value, dict) else {path + name: value}
    return out


EVERY = leaves(dataclasses.asdict(Settings()))


def test_the_printed_file_holds_every_setting_with_its_default(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["settings"]) == 0
    printed = capsys.readouterr().out
    assert printed == as_toml()
    table = tomllib.loads(printed)
    assert build(Settings, table, "printed") == Settings()
    assert leaves(table).keys() == EVERY.keys()


def test_each_has_a_text_and_the_page_counts_them() -> None:
    every = [one for section in sections() for one in section.settings]
    assert len(every) == len(EVERY) <= 150
    assert all(len(one.text) > 10 and one.text.endswith(".") for one in every)
    assert f"There are {len(EVERY)} settings." in as_markdown()


@pytest.mark.skipif(not PAGE.parent.is_dir(), reason="installed without the documentation")
def test_the_page_is_current() -> None:
    assert PAGE.read_text() == as_markdown(), "run: mapweave settings --markdown > docs/settings.md"


@pytest.mark.parametrize("name", [name for name, value in EVERY.items() if type(value) in (int, float)])
def test_no_number_may_be_anything(name: str) -> None:
    """Each has a range that keeps out a large negative number."""
    *path, last = name.split(".")
    table: dict[str, Any] = {last: -(10**9)}
    for part in reversed(path):
        table = {part: table}
    with pytest.raises(MapweaveError, match=last):
        build(Settings, table, "file")
