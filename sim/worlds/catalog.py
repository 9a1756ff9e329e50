"""The kinds of world there are, by name."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mapweave.hybridmap.errors import InvalidValue
from mapweave.sim.world import World
from mapweave.sim.worlds.arena import ArenaParameters, arena
from mapweave.sim.worlds.build import build_world
from mapweave.sim.worlds.corridor import CorridorParameters, corridor
from mapweave.sim.worlds.design import MAX_SEED, Design, within
from mapweave.sim.worlds.file import load_world
from mapweave.sim.worlds.office import OfficeParameters, office
from mapweave.sim.worlds.passage import PassageParameters, passage
from mapweave.sim.worlds.twins import TwinsParameters, twins
from mapweave.sim.worlds.warehouse import WarehouseParameters, warehouse
from mapweave.storage.settings_file import build


@dataclass(frozen=True)
class WorldKind:
    """How one kind of world is made.

    Attributes:
        parameters: a frozen dataclass, with defaults that work.
        design: of (parameters, seed).
    """

    parameters: type[Any]
    design: Callable[[Any, int], Design]


KINDS: dict[str, WorldKind] = {
    "office": WorldKind(OfficeParameters, office),
    "corridor": WorldKind(CorridorParameters, corridor),
    "warehouse": WorldKind(WarehouseParameters, warehouse),
    "twins": WorldKind(TwinsParameters, twins),
    "arena": WorldKind(ArenaParameters, arena),
    "passage": WorldKind(PassageParameters, passage),
}


def make_design(kind: str, seed: int, **parameters: Any) -> Design:
    """Design a world.

    Args:
        kind: one of `KINDS`.
        seed: other seeds, other worlds of this kind.
        parameters: fields of `KINDS[kind].parameters`.

    Raises:
        InvalidValue: no such kind or seed, or sizes that do not fit each other.
        SettingsError: no such parameter, or one of another type or out of range.
    """
    if kind not in KINDS:
        raise InvalidValue(f"no kind of world {kind!r}; there are {', '.join(KINDS)}")
    within("a world's seed", seed, 0, MAX_SEED)
    made = KINDS[kind]
    return made.design(build(made.parameters, parameters, kind), seed)


def make_world(kind: str, seed: int, **parameters: Any) -> World:
    """Build a world: see `make_design`."""
    return build_world(make_design(kind, seed, **parameters), kind)


def world_from_table(table: Mapping[str, Any], seed: int, folder: Path) -> World:
    """The world that a scenario's `[world]` table asks for.

    Args:
        table: `kind` (by default office) and its parameters, or `file` alone.
        seed: of generated worlds; a world from a file does not depend on it.
        folder: that the file's name starts from.

    Raises:
        MapweaveError: a table, or a file, that makes no world.
    """
    rest = dict(table)
    file, kind = rest.pop("file", None), rest.pop("kind", None)
    if file is not None:
        if kind is not None or rest:
            raise InvalidValue("world: with file, nothing else can be set; edit the file")
        if not isinstance(file, str):
            raise InvalidValue(f"world: file must be a name, not {file!r}")
        return load_world(folder / file)
    if kind is None:
        kind = "office"
    if not isinstance(kind, str):
        raise InvalidValue(f"world: kind must be a name, not {kind!r}")
    return make_world(kind, seed, **rest)
