"""Worlds in files: TOML that a person can write, or that is saved from a made world and then edited.

    name = "flat"
    height = 2.4                      # of the walls, m

    [[rooms]]                         # where one may be; rooms that touch are open to one another
    name = "hall"
    low = [0.0, 0.0]                  # south-west corner, m: x to the east, y to the north
    high = [6.0, 2.0]                 # north-east corner

    [[walls]]                         # solid; along a line
    start = [0.0, 2.05]
    end = [6.0, 2.05]
    thickness = 0.1
    texture = "plaster"

    [[furniture]]                     # boxes that stand on the floor
    name = "cupboard"
    at = [5.4, 1.7]                   # the middle
    length = 1.0
    width = 0.45
    height = 1.7
    heading_deg = 0.0                 # of its length, counter-clockwise from east
    texture = "cupboard"

    [[posters]]                       # pictures on walls
    at = [2.0, 1.9]                   # a point in front of the wall
    width = 0.6
    height = 0.4
    bottom = 0.3                      # above the floor
    texture = "photo.jpg"             # a painter's name, or a picture beside this file

All fields are those of the dataclasses in `mapweave.sim.worlds.design`; what is left out keeps its default.
`docs/worlds.md` lists them together with all textures.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any

from mapweave.hybridmap.errors import SettingsError
from mapweave.sim.world import World
from mapweave.sim.worlds.build import build_world
from mapweave.sim.worlds.design import Design, Furniture, Poster, Room, Wall
from mapweave.storage.settings_file import build, read_toml

ITEMS: dict[str, type[Any]] = {"rooms": Room, "walls": Wall, "furniture": Furniture, "posters": Poster}
"""Lists of a file, and what each of their tables is."""


def load_world(path: Path) -> World:
    """Build the world that a file describes.

    Raises:
        MapweaveError: the file is missing, is not TOML, or describes nothing that can be built.
    """
    return build_world(load_design(path), str(path), path.parent)


def load_design(path: Path) -> Design:
    """Read what a file describes; what is out of range is found when it is built.

    Raises:
        SettingsError: the file is missing, is not TOML, or has an unknown name or a value of a wrong kind.
    """
    table = read_toml(path)
    table.setdefault("name", path.stem)
    for name, cls in ITEMS.items():
        tables = table.get(name, [])
        if not isinstance(tables, list) or not all(isinstance(entry, dict) for entry in tables):
            raise SettingsError(f"{path}: {name} must be a list of tables: write [[{name}]]")
        table[name] = tuple(build(cls, entry, f"{path}: {name}[{k}]") for k, entry in enumerate(tables))
    return build(Design, table, str(path))


def save_design(design: Design, path: Path) -> None:
    """Write a file that gives the same world again.

    Raises:
        SettingsError: the file cannot be written.
    """
    lines = _lines(design)
    for name in ITEMS:
        for item in getattr(design, name):
            lines += ["", f"[[{name}]]", *_lines(item)]
    try:
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise SettingsError(f"{path}: {error.strerror}") from None


def _lines(item: Any) -> list[str]:
    """Fields that are not as by default, one a line."""
    # Texts that can be printed, numbers that are finite, flags and lists are the same in JSON and in TOML.
    return [
        f"{field.name} = {json.dumps(value, ensure_ascii=False)}"
        for field in dataclasses.fields(item)
        if field.name not in ITEMS and (value := getattr(item, field.name)) != field.default
    ]
