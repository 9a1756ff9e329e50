"""Worlds by kind and parameters, and by a scenario's table; what cannot be built is refused in one line."""

import math
from dataclasses import fields

import pytest

from mapweave.hybridmap.errors import InvalidValue, MapweaveError, SettingsError
from mapweave.sim.worlds.catalog import KINDS, make_world, world_from_table


@pytest.mark.parametrize(("kind", "parameters", "says"), [
    ("offices", {}, "no kind of world 'offices'; there are office, corridor"),
    ("office", {"rooms": 0}, "rooms must be a whole number, 1 to 32; it is 0"),
    ("office", {"rooms": 2.5}, "expected int"),
    ("office", {"room": 2}, "did you mean 'rooms'"),
    ("corridor", {"breadth": math.nan}, "is no float"),
    ("corridor", {"breadth": 0.2}, "breadth must be a number, 1.2 to 5; it is 0.2"),
    ("corridor", {"width": 5.0, "breadth": 3.0}, "has no middle"),
    ("warehouse", {"rows": 21}, "rows must be a whole number, 1 to 20; it is 21"),
    ("warehouse", {"bays": True}, "expected int"),
    ("twins", {"joined": 1}, "expected bool"),
    ("arena", {"length": -3.0}, "length must be a number, 2 to 60; it is -3.0"),
])  # fmt: skip
def test_wrong_parameters_are_reported_in_one_line(kind: str, parameters: dict[str, object], says: str):
    with pytest.raises(MapweaveError, match=says) as caught:
        make_world(kind, 1, **parameters)
    assert "\n" not in str(caught.value)


def test_negative_seeds_are_refused():
    """Numpy would say something else."""
    with pytest.raises(InvalidValue, match="seed is -1"):
        make_world("arena", -1)


@pytest.mark.parametrize("kind", KINDS)
def test_unusual_sizes_can_be_built(kind: str):
    """Or are refused in one line; and a robot can start there."""
    for name in (field.name for field in fields(KINDS[kind].parameters)):
        for value in (1, 2.5, 40.0, True):
            try:
                world = make_world(kind, 1, **{name: value})
            except MapweaveError:
                continue
            assert world.panels
            assert world.start_poses(1, 1)


def test_scenario_tables_name_a_kind_or_a_file(tmp_path):
    """Not both; an empty table is an office."""
    assert world_from_table({}, 3, tmp_path).plan == make_world("office", 3).plan
    table = {"kind": "arena", "length": 5.0}
    assert world_from_table(table, 3, tmp_path).plan == make_world("arena", 3, length=5.0).plan
    assert table == {"kind": "arena", "length": 5.0}
    for wrong in ({"file": "a.toml", "kind": "office"}, {"file": 3}, {"kind": 3}, {"file": "not there.toml"}):
        with pytest.raises(MapweaveError, match=r"file|kind"):
            world_from_table(wrong, 3, tmp_path)
    with pytest.raises(SettingsError, match="no setting 'rows'"):
        world_from_table({"kind": "arena", "rows": 2}, 3, tmp_path)
