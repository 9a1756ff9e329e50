"""A scenario file: a world, robots, what happens to them in which order, and what shall come of it.

name = "network-cut"
summary = "One robot maps for a minute without a network; nothing is lost."
robots = 3                        # or a [[robot]] table each: name, camera, body, start, mission ...

[world]
kind = "office"                   # see docs/worlds.md; or file = "my_world.toml"

[[events]]                        # in order; each waits for its time, then happens
at = 60.0                         # not before this time, s
do = "cut"
robot = "r2"

[[events]]
plus = 60.0                       # so long after the event before, or after what `after` names
do = "restore"
robot = "r2"

[[events]]
after = "joined"                  # what must have come true first: see CONDITIONS
within = 400.0                    # ... but no longer than this after the event before, s
do = "wait"

[expect]                          # figures: see mapweave.scenarios.figures
components = 1
merged_ate_m = 0.1                # at most
"""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from mapweave.hybridmap.errors import MapweaveError, SettingsError
from mapweave.scenarios.actions import MISSION_KINDS, Action, parse_action
from mapweave.scenarios.expectations import Expectation, parse_expectations
from mapweave.sim.robots import MOST_ROBOTS, RobotSetup, robot_from_table
from mapweave.sim.world import World
from mapweave.sim.worlds.catalog import world_from_table
from mapweave.storage.settings_file import build, read_toml

CONDITIONS = {
    "joined": "the merged map has one component that holds every robot's map",
    "explored": "no robot finds anything new to explore",
    "found": "the robot that was lost last knows where it is",
    "arrived": "the robots that were sent report that they have arrived",
    "asked": "a robot asks to be taken through a lift",
    "grown": "the agent that was started last has made a new node",
}

LONGEST = 86_400.0
"""No event waits longer, s."""
Wait = Annotated[float, Meta(ge=0.0, le=LONGEST)]
"""s."""
Table = dict[str, Any]


@dataclass(frozen=True)
class When:
    """When an event happens. Events keep their order: none happens before the one before it.

    Attributes:
        at: not before this simulated time, s.
        after: not before this has come true; see CONDITIONS.
        plus: and so long after that, or, without `after`, after the event before, s.
        within: without success no longer than this after the event before, s; then it happens all the same,
            and the trial notes what had not come true.
    """

    at: Wait = 0.0
    after: str = ""
    plus: Wait = 0.0
    within: Wait = LONGEST

    def __post_init__(self) -> None:
        """Refuse what cannot be waited for (ValueError)."""
        if self.after and self.after not in CONDITIONS:
            raise ValueError(f"after = {self.after!r}; known are {', '.join(CONDITIONS)}")
        if self.after and self.within == LONGEST:
            raise ValueError(f"after = {self.after!r} needs within = seconds: it may never come true")


@dataclass(frozen=True)
class ScenarioEvent:
    """One entry of a scenario.

    Attributes:
        when: it happens.
        action: what happens.
        table: the same as in the file, without the time.
    """

    when: When
    action: Action
    table: Mapping[str, Any]


@dataclass(frozen=True)
class Scenario:
    """What is to be tried.

    Attributes:
        name: short.
        summary: one line.
        robots: in the order of the file.
        missions: of each at the start.
        events: in order.
        expectations: what shall come of it.
        world_table: as in the file.
        path: the file; a world's file is found from its folder.
        overrides: of the file's values.
        seed: if the command line gives none.
        text: the file as it was read, with overrides noted.
    """

    name: str
    summary: str
    robots: tuple[RobotSetup, ...]
    missions: Mapping[str, str]
    events: tuple[ScenarioEvent, ...]
    expectations: tuple[Expectation, ...]
    world_table: Mapping[str, Any]
    path: Path
    overrides: tuple[str, ...] = ()
    seed: int = 0
    text: str = ""

    def world(self, seed: int) -> World:
        """Build the world.

        Raises:
            SettingsError: it cannot be built.
        """
        try:
            return world_from_table(self.world_table, seed, self.path.parent)
        except SettingsError:
            raise
        except MapweaveError as error:
            raise SettingsError(f"{self.name}: world: {error}") from None


@dataclass(frozen=True)
class ScenarioFile:
    """The tables of a file, see above."""

    name: str = ""
    summary: str = ""
    seed: Annotated[int, Meta(ge=0)] = 0
    robots: Annotated[int, Meta(ge=1, le=MOST_ROBOTS)] | None = None
    robot: Annotated[list[Table], Meta(max_length=MOST_ROBOTS)] = field(default_factory=list)
    world: Table = field(default_factory=lambda: {"kind": "office"})
    events: list[Table] = field(default_factory=list)
    expect: Table = field(default_factory=dict)


def scenario_names() -> list[str]:
    """Those that come with Mapweave."""
    return sorted(p.name.removesuffix(".toml") for p in _shipped().iterdir() if p.name.endswith(".toml"))


def scenario_path(given: str) -> Path:
    """The file of a scenario: a path, or the name of one that comes with Mapweave.

    Raises:
        SettingsError: there is none.
    """
    path = Path(given)
    if path.suffix == ".toml" or path.exists():
        return path
    shipped = Path(str(_shipped() / f"{given}.toml"))
    if shipped.is_file():
        return shipped
    raise SettingsError(f"no scenario {given!r}; give a .toml file or one of {', '.join(scenario_names())}")


def load_scenario(path: Path, overrides: Sequence[str] = ()) -> Scenario:
    """Read a scenario.

    Args:
        path: of the TOML file.
        overrides: `key=value` with dots between the names of nested tables and a TOML value, for example
            `world.rooms=5`; they replace the file's values.

    Raises:
        SettingsError: one line with the reason and the place.
    """
    table = read_toml(path)
    for override in overrides:
        _override(table, override)
    where = " with ".join([str(path), *(f"--set {override}" for override in overrides)])
    file = build(ScenarioFile, table, where)
    if not file.events:
        raise SettingsError(f"{where}: give at least one [[events]] table; the last one ends the trial")
    robots, missions = _robots(file, where)
    noted = "".join(f"# --set {override}\n" for override in overrides)
    scenario = Scenario(
        name=file.name or path.stem,
        summary=file.summary,
        robots=robots,
        missions=missions,
        events=tuple(_event(e, f"{where}: event {k}") for k, e in enumerate(file.events, start=1)),
        expectations=parse_expectations(file.expect, f"{where}: expect"),
        world_table=file.world,
        path=path,
        overrides=tuple(overrides),
        seed=file.seed,
        text=noted + path.read_text(encoding="utf-8"),
    )
    _check_names(scenario, where)
    return scenario


def _shipped() -> Any:
    return resources.files("mapweave.scenarios") / "scenarios"


def _override(table: dict[str, Any], override: str) -> None:
    key, equals, text = override.partition("=")
    names = [name.strip() for name in key.split(".")]
    if not equals or not all(names):
        raise SettingsError(f"--set {override}: write key=value, for example world.rooms=5")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text.strip()
    place = table
    for name in names[:-1]:
        inner = place.setdefault(name, {})
        if not isinstance(inner, dict):
            raise SettingsError(f"--set {override}: {name} is no table")
        place = inner
    place[names[-1]] = value


def _robots(file: ScenarioFile, where: str) -> tuple[tuple[RobotSetup, ...], dict[str, str]]:
    if file.robot and file.robots is not None:
        raise SettingsError(f"{where}: give robots = a number, or [[robot]] tables, not both")
    known = tuple(MISSION_KINDS)
    setups, missions = [], {}
    for k, given in enumerate(file.robot or [{}] * (file.robots or 1)):
        values = {"name": f"r{k}", **given}
        mission = values.pop("mission", "explore")
        if mission not in known:
            raise SettingsError(f"{where}: robot {k}: mission = {mission!r}; known are {', '.join(known)}")
        try:
            setup = robot_from_table(values, f"{where}: robot {k}")
        except SettingsError:
            raise
        except MapweaveError as error:
            raise SettingsError(f"{where}: robot {k}: {error}") from None
        setups.append(setup)
        missions[setup.name] = mission
    if len(missions) != len(setups):
        raise SettingsError(f"{where}: two robots have the same name")
    return tuple(setups), missions


def _event(given: Table, where: str) -> ScenarioEvent:
    times: Table = {name: given[name] for name in ("at", "after", "plus", "within") if name in given}
    rest = {name: value for name, value in given.items() if name not in times}
    do = rest.pop("do", None)
    if not isinstance(do, str):
        raise SettingsError(f"{where}: do is missing: what shall happen?")
    return ScenarioEvent(build(When, times, where), parse_action(do, rest, where), {"do": do, **rest})


def _check_names(scenario: Scenario, where: str) -> None:
    names = {robot.name for robot in scenario.robots}
    for number, event in enumerate(scenario.events, start=1):
        for key in ("robot", "near"):
            name = event.table.get(key, "")
            if name and name != "all" and name not in names:
                raise SettingsError(
                    f"{where}: event {number}: no robot {name!r}; there are {', '.join(sorted(names))}"
                )
