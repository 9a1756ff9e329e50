"""Actions of a scenario on the fleet; those on the world are in `mapweave.sim.events`."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from msgspec import Meta

from mapweave.hybridmap.errors import InvalidValue, SettingsError
from mapweave.hybridmap.ids import NodeId, check_name
from mapweave.hybridmap.mission_order import MissionKind
from mapweave.scenarios.liar.lies import EVERY
from mapweave.sim import events
from mapweave.sim.robots import camera_from_table
from mapweave.storage.settings_file import build

ALL_ROBOTS = "all"
MISSION_KINDS = {"idle": MissionKind.STOP, "explore": MissionKind.EXPLORE, "carried": MissionKind.CARRIED}
"""By their names in scenarios."""
GOALS = ("foreign", "own", "photographed", "beyond")


@dataclass(frozen=True)
class Wait:
    """Nothing; only its time, or what it waits for, counts."""


@dataclass(frozen=True)
class SetMission:
    """An operator's command.

    Attributes:
        mission: idle, explore or carried.
        robot: name, or all.
    """

    mission: str
    robot: str = ALL_ROBOTS

    def __post_init__(self) -> None:
        """Refuse an unknown mission (InvalidValue)."""
        if self.mission not in MISSION_KINDS:
            raise InvalidValue(f"mission: no mission {self.mission!r}; known are {', '.join(MISSION_KINDS)}")


@dataclass(frozen=True)
class Abduct:
    """A robot is put into a room that only one other robot has mapped (truth chooses; it does not help).

    Attributes:
        robot: name; chosen from the seed if not given.
    """

    robot: str = ""


@dataclass(frozen=True)
class Send:
    """A robot shall go to a node.

    Attributes:
        robot: name; the robot that was lost last if not given.
        goal: the node; `foreign`: another robot's, in another room; `own`: one of its own, in view of which
            it is not now; `photographed`: the last photograph; `beyond`: beyond the lift.
    """

    robot: str = ""
    goal: str = "foreign"

    def __post_init__(self) -> None:
        """Refuse what is no node (InvalidValue)."""
        if self.goal not in GOALS:
            NodeId.parse(self.goal)


@dataclass(frozen=True)
class MapByPhotographs:
    """A free way, chosen from the seed, is mapped by photographs; a robot is put down where it begins.

    Attributes:
        robot: name.
        count: of photographs.
        spacing: m between two of them, about.
        said_spacing: as the photographer states it, m; the truth by default.
        camera: that is carried, by its name.
        name: of the map.
    """

    robot: str
    count: Annotated[int, Meta(ge=3, le=100)] = 9
    spacing: Annotated[float, Meta(ge=0.1, le=2.0)] = 0.5
    said_spacing: Annotated[float, Meta(ge=0.0, le=4.0)] = 0.0
    camera: str = "phone"
    name: str = "photos"

    def __post_init__(self) -> None:
        """Refuse a camera that does not exist, and a name that cannot be one (MapweaveError)."""
        check_name(self.name)
        camera_from_table(self.camera, "photograph: camera")


@dataclass(frozen=True)
class Floors:
    """Each robot's map is labelled as a floor of its own; a lift leads from the first to the second."""


@dataclass(frozen=True)
class TakeThrough:
    """The robots that ask at a lift are put down at its other side, and a person says so."""


@dataclass(frozen=True)
class TryLies:
    """What would become of the others is tried if a robot had lied about its map.

    Attributes:
        robot: name.
        ways: in which it lies, see mapweave.scenarios.liar.lies; all if not given.
        queries: views of lost robots that are asked.
    """

    robot: str
    ways: tuple[str, ...] = ()
    queries: Annotated[int, Meta(ge=1, le=1000)] = 12

    def __post_init__(self) -> None:
        """Refuse an unknown way (InvalidValue)."""
        for way in self.ways:
            if way not in EVERY:
                raise InvalidValue(f"lie: no way {way!r}; known are {', '.join(EVERY)}")


@dataclass(frozen=True)
class KillAgent:
    """An agent's process dies at once, without a word."""

    robot: str


@dataclass(frozen=True)
class StartAgent:
    """An agent's process is started again, with the same disk."""

    robot: str


@dataclass(frozen=True)
class KillServer:
    """The map server's process dies at once, without a word; the router is in it."""


@dataclass(frozen=True)
class StartServer:
    """The map server is started again, with the same disk."""


@dataclass(frozen=True)
class Cut:
    """A robot's network is cut; its wheels and sensors work on."""

    robot: str


@dataclass(frozen=True)
class Worsen:
    """A robot's network becomes bad.

    Attributes:
        robot: name.
        loss: share of what it sends that is lost (in one process), or has to be sent again (TCP), 0 to 1.
        delay: of what is not lost, s.
    """

    robot: str
    loss: Annotated[float, Meta(ge=0.0, lt=1.0)] = 0.2
    delay: Annotated[float, Meta(ge=0.0, le=5.0)] = 0.05


@dataclass(frozen=True)
class Restore:
    """A robot's network is as good as new."""

    robot: str


Action = (
    Wait
    | SetMission
    | Abduct
    | Send
    | MapByPhotographs
    | Floors
    | TakeThrough
    | TryLies
    | KillAgent
    | StartAgent
    | KillServer
    | StartServer
    | Cut
    | Worsen
    | Restore
    | events.SimEvent
)

KINDS: dict[str, type[Any]] = {
    "wait": Wait,
    "mission": SetMission,
    "abduct": Abduct,
    "goto": Send,
    "photograph": MapByPhotographs,
    "floors": Floors,
    "take_through": TakeThrough,
    "lie": TryLies,
    "kill_agent": KillAgent,
    "start_agent": StartAgent,
    "kill_server": KillServer,
    "start_server": StartServer,
    "cut": Cut,
    "worsen": Worsen,
    "restore": Restore,
}
"""By the `do` of an event's table."""


def parse_action(do: str, table: Mapping[str, Any], where: str) -> Action:
    """Make an action of a scenario's table.

    Raises:
        SettingsError: an unknown kind or field, or a value that cannot work.
    """
    try:
        if do in events.KINDS:
            return events.parse_event({"do": do, **table}, where)
        if do not in KINDS:
            raise SettingsError(f"{where}: do = {do!r}; known are {', '.join((*KINDS, *events.KINDS))}")
        action: Action = build(KINDS[do], table, f"{where}: {do}")
    except InvalidValue as error:
        raise SettingsError(f"{where}: {error}") from None
    return action
