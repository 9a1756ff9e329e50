"""The printed settings file and its page: complete, true, and few enough to be read."""

import dataclasses
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

import mapweave
from mapweave.agent.drivers.settings import CameraSettings, Geometry
from mapweave.cli import main
from mapweave.hybridmap.errors import MapweaveError
from mapweave.settings import Settings
from mapweave.settings_reference import as_markdown, as_toml, sections
from mapweave.storage.settings_file import build

PAGE = Path(mapweave.__file__).resolve().parent.parent / "docs" / "settings.md"


def leaves(values: dict[str, Any], path: str = "") -> dict[str, Any]:
    """All values that are not None, by their whole name; an empty table is a value."""
    out: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, dict) and value:
            out |= leaves(value, f"{path}{name}.")
        elif value is not None:
            out[path + name] = value
    return out


EVERY = leaves(dataclasses.asdict(Settings()))
OPTIONAL = {*dataclasses.fields(CameraSettings), *dataclasses.fields(Geometry)}


def test_the_printed_file_holds_every_setting_with_its_default(capsys):
    assert main(["settings"]) == 0
    printed = capsys.readouterr().out
    assert printed == as_toml()
    table = tomllib.loads(printed)
    assert build(Settings, table, "printed") == Settings()
    assert leaves(table).keys() - {"robot.geometry"} == EVERY.keys(), "nothing of the geometry has a default"


def test_what_has_no_default_is_printed_as_a_comment():
    """Filled in, the comments are a file."""
    off = re.findall(r"^#(\w+) =", as_toml(), re.MULTILINE)
    assert sorted(off) == sorted(item.name for item in OPTIONAL)
    text = re.sub(r"^#(\[|\w+ =)", r"\1", as_toml(), flags=re.MULTILINE)
    text = text.replace("ranger_bearings_deg =", "ranger_bearings_deg = [1]")
    text = text.replace("wheel_noise =", "wheel_noise = 0.1")
    text = text.replace("height_m =", "height_m = 0.2")
    text = re.sub(r"^(radius|axle) =", r"\1 = 0.3", text, flags=re.MULTILINE)
    text = re.sub(r"= *$", "= 64", text, flags=re.MULTILINE)
    settings = build(Settings, tomllib.loads(text), "filled in")
    assert settings.robot.camera is not None and settings.robot.geometry.axle == 0.3


def test_each_has_a_text_and_the_page_counts_them():
    every = [setting for section in sections() for setting in section.settings]
    assert len(every) == len(EVERY) + len(OPTIONAL) <= 150
    assert all(len(setting.text) > 3 and setting.text.endswith(".") for setting in every)
    assert f"There are {len(every)} settings." in as_markdown()


@pytest.mark.skipif(not PAGE.parent.is_dir(), reason="installed without the documentation")
def test_the_page_is_current():
    assert PAGE.read_text() == as_markdown(), "run: mapweave settings --markdown > docs/settings.md"


@pytest.mark.parametrize("name", [name for name, value in EVERY.items() if type(value) in (int, float)])
def test_no_number_may_be_anything(name: str):
    """Each has a range that keeps out a large negative number."""
    *path, last = name.split(".")
    table: dict[str, Any] = {last: -(10**9)}
    for part in reversed(path):
        table = {part: table}
    with pytest.raises(MapweaveError, match=last):
        build(Settings, table, "file")
