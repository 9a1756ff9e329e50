"""Every key of a fleet: the version first, then who, then what. Keys contain no data.

    mapweave/1/<fleet>/agent/<agent>/change/<epoch>   one change each; see mapweave.wire.log_messages
    mapweave/1/<fleet>/agent/<agent>/head/<epoch>     beacon: the newest sequence number
    mapweave/1/<fleet>/agent/<agent>/log/<epoch>      question: a range of the log
    mapweave/1/<fleet>/agent/<agent>/alive/<epoch>    liveliness
    mapweave/1/<fleet>/agent/<agent>/status           what it is doing, for people; question: the same, now
    mapweave/1/<fleet>/agent/<agent>/mission          question: a mission order
    mapweave/1/<fleet>/agent/<agent>/drive            question: a person's velocity command
    mapweave/1/<fleet>/agent/<agent>/portal           question: it was taken through a portal
    mapweave/1/<fleet>/agent/<agent>/view             question: the image of a node; liveliness: it keeps some
    mapweave/1/<fleet>/server/<server>/ack/<agent>    what is on that server's disk; question: its newest map
    mapweave/1/<fleet>/server/<server>/poses/<agent>  where its nodes lie in the merged map; question: all
    mapweave/1/<fleet>/server/<server>/relocalize     question; also route, known, map, explain, constrain,
                                                      constraints, annotate, annotations, resolve, history,
                                                      plans, plan_image and put_plan_image
    mapweave/1/<fleet>/server/<server>/mission        question: a mission; also missions, robots
    mapweave/1/<fleet>/server/<server>/reserve        question: may the next edges be driven?
    mapweave/1/<fleet>/server/<server>/nearby         question: which robots are around this one?
    mapweave/1/<fleet>/server/<server>/relocalize/<agent>  the same of a robot; also route, known, reserve,
                                                      nearby
    mapweave/1/<fleet>/server/<server>/status         as an agent's; likewise alive
    mapweave/1/<fleet>/server/<server>/constrain/<who>  the same of a person with a key; also annotate and
                                                      missions, see mapweave.wire.senders
    mapweave/1/<fleet>/robot/<robot>/describe         question to a robot base; likewise step
    mapweave/1/<fleet>/robot/<robot>/driver/<number>  liveliness of the driver of that base

The identity is a chunk at a fixed place before the class of the message, so that an access rule can name it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.ids import NAME, MapId, check_name

VERSION = "1"
MAX_EPOCH = 2**53
"""Greatest number up to which a float keeps each whole number apart: JSON readers in browsers have no
other."""
MAX_KEY = 256
"""Characters of a key that is read."""
KEYS_KEPT = 8192
"""Keys of which the meaning is kept: they come again and again."""


def check_epoch(epoch: int) -> int:
    """Return the epoch, or raise InvalidValue if it is out of range."""
    if not 0 <= epoch <= MAX_EPOCH:
        raise InvalidValue(f"epoch {epoch} is out of range 0..{MAX_EPOCH}")
    return epoch


def _pattern(form: str) -> Callable[[Keys], str]:
    """A method of Keys: a pattern."""
    return lambda keys: f"{keys.root}/{form}"


def _named(form: str) -> Callable[[Keys, str], str]:
    """A method of Keys: a key or pattern with a name in the place of `{}`."""
    return lambda keys, name: f"{keys.root}/{form.format(check_name(name))}"


def _of_map(what: str) -> Callable[[Keys, MapId], str]:
    """A method of Keys: an agent's key about one of its maps."""
    return lambda keys, map_id: (
        f"{keys.root}/agent/{check_name(map_id.agent)}/{what}/{check_epoch(map_id.epoch)}"
    )


def _parsed_map(what: str) -> Callable[[Keys, str], MapId]:
    """A method of Keys: the map that a key of `_of_map` is about."""
    return lambda keys, key: _map_of(keys, what, key)


def _of_servers(what: str) -> tuple[Callable[[Keys, str], str], Callable[[Keys], str]]:
    """Two methods of Keys: the key of one server's `what`, and the pattern of any server's."""
    return _named(f"server/{{}}/{what}"), _pattern(f"server/*/{what}")


@dataclass(frozen=True, slots=True)
class Keys:
    """The keys of one fleet. Methods with a plural or `any_` in their name give patterns.

    Attributes:
        fleet: its name; fleets share a router without seeing each other.
    """

    fleet: str = "fleet"

    def __post_init__(self) -> None:
        """Refuse a name that cannot be part of a key (InvalidValue)."""
        check_name(self.fleet)

    @property
    def root(self) -> str:
        """The prefix of every key of the fleet."""
        return f"mapweave/{VERSION}/{self.fleet}"

    # Keys of an agent.

    change = _of_map("change")
    """Where an agent publishes the changes of one map."""
    changes = _pattern("agent/*/change/*")
    """Pattern: the changes of every map."""
    head = _of_map("head")
    """Where an agent publishes the newest sequence number of a map."""
    heads = _pattern("agent/*/head/*")
    """Pattern: the beacons of every map."""
    log = _of_map("log")
    """Where an agent answers for ranges of a map's log."""
    logs = _named("agent/{}/log/*")
    """Pattern: the logs of all maps of an agent."""
    agent_alive = _of_map("alive")
    """Under which an agent that makes this map is alive."""
    agents_alive = _pattern("agent/*/alive/*")
    """Pattern: every agent."""
    agent_status = _named("agent/{}/status")
    """Where an agent publishes what it is doing."""
    agent_statuses = _pattern("agent/*/status")
    """Pattern: what every agent is doing."""
    mission = _named("agent/{}/mission")
    """Where an agent takes orders."""
    drive = _named("agent/{}/drive")
    """Where an agent takes a person's velocity commands."""
    portal = _named("agent/{}/portal")
    """Where an agent takes reports that it was taken through a portal."""
    view = _named("agent/{}/view")
    """Where an agent that keeps images of its nodes gives them to servers, and under which it says so."""
    views = _pattern("agent/*/view")
    """Pattern: every agent that keeps images."""

    # Keys of a server.

    def ack(self, server: str, agent: str) -> str:
        """Acknowledgements of a server to an agent."""
        return f"{self.root}/server/{check_name(server)}/ack/{check_name(agent)}"

    all_acks = _named("server/{}/ack/*")
    """Pattern: a server's acknowledgements to all agents; a question: the newest map of one."""
    acks = _named("server/*/ack/{}")
    """Pattern: acknowledgements of any server to an agent."""

    def poses(self, server: str, agent: str) -> str:
        """Merged poses of an agent's nodes, published by a server; a question returns all of them."""
        return f"{self.root}/server/{check_name(server)}/poses/{check_name(agent)}"

    all_poses = _named("server/{}/poses/*")
    """Pattern: a server's merged poses for all agents."""

    # Of each pair the first takes the name of a server, and the second gives the pattern of any server.

    relocalize, any_relocalize = _of_servers("relocalize")
    """Relocalization by a server."""
    route, any_route = _of_servers("route")
    """Where a server gives a way from node to node."""
    known, any_known = _of_servers("known")
    """Fleet coverage by a server."""
    server_map, any_server_map = _of_servers("map")
    """Where a server hands out the merged map as the bytes of a map file."""
    server_mission, any_mission = _of_servers("mission")
    """Where a server takes missions, and hands them on."""
    missions, any_missions = _of_servers("missions")
    """The missions that a server knows of."""
    robots, any_robots = _of_servers("robots")
    """The robots as a server sees them."""
    reserve, any_reserve = _of_servers("reserve")
    """Reservations of edges by a server."""
    nearby, any_nearby = _of_servers("nearby")
    """Where a server says which robots are around a robot."""
    explain, any_explain = _of_servers("explain")
    """Explanations by a server."""
    constrain, any_constrain = _of_servers("constrain")
    """Manual constraints to a server."""
    annotate, any_annotate = _of_servers("annotate")
    """Annotations to a server."""
    annotations, any_annotations = _of_servers("annotations")
    """The record of annotations, from a server."""
    resolve, any_resolve = _of_servers("resolve")
    """Which nodes names and positions are, by a server."""
    plans, any_plans = _of_servers("plans")
    """Floor plans under the merged map, from a server."""
    plan_image, any_plan_image = _of_servers("plan_image")
    """Images of floor plans, from a server."""
    put_plan_image, any_put_plan_image = _of_servers("put_plan_image")
    """Images of floor plans to a server."""
    constraints, any_constraints = _of_servers("constraints")
    """The record of manual constraints of a server."""
    history, any_history = _of_servers("history")
    """The history of the maps, from a server."""
    server_status, server_statuses = _of_servers("status")
    """Where a server publishes what it is doing."""
    server_alive, servers_alive = _of_servers("alive")
    """Under which a server is alive."""

    # Keys of a robot base.

    robot_describe = _named("robot/{}/describe")
    """Description of a robot base."""
    robot_step = _named("robot/{}/step")
    """A robot base takes a command and returns the next observation."""

    def robot_driver(self, robot: str, number: int) -> str:
        """Liveliness of a robot base's driver."""
        return f"{self.root}/robot/{check_name(robot)}/driver/{check_epoch(number)}"

    def robot_drivers_of(self, robot: str) -> str:
        """Pattern: all agents that drive one base."""
        return f"{self.root}/robot/{check_name(robot)}/driver/*"

    robot_drivers = _pattern("robot/*/driver/*")
    """Pattern: all drivers of a base."""

    # Parsing of received keys. Each raises InvalidMessage if the key is of another form.

    parse_change = _parsed_map("change")
    """Whose changes."""
    parse_head = _parsed_map("head")
    """Whose beacon."""
    parse_log = _parsed_map("log")
    """Whose log."""
    parse_agent_alive = _parsed_map("alive")
    """Which agent, and which map it makes."""

    def parse_agent_status(self, key: str) -> str:
        """Which agent."""
        return _agent_of(self, "status", key)

    def parse_view(self, key: str) -> str:
        """Which agent."""
        return _agent_of(self, "view", key)

    def parse_robot_driver(self, key: str) -> tuple[str, int]:
        """Which robot, and the number of who drives it."""
        robot, number = self._chunks("robot/*/driver/*", key)
        return _name(robot, key), _number(number, key)

    def parse_ack(self, key: str) -> tuple[str, str]:
        """Which server, to which agent."""
        server, agent = self._parse_names("server/*/ack/*", key)
        return server, agent

    def parse_poses(self, key: str) -> tuple[str, str]:
        """Which server, to which agent."""
        server, agent = self._parse_names("server/*/poses/*", key)
        return server, agent

    def _parse_names(self, form: str, key: str) -> list[str]:
        return [_name(chunk, key) for chunk in self._chunks(form, key)]

    def _chunks(self, form: str, key: str) -> list[str]:
        """The chunks that match `*` of the form."""
        wanted = [*self.root.split("/"), *form.split("/")]
        given = key.split("/") if len(key) <= MAX_KEY else []
        if len(given) != len(wanted) or any(w not in ("*", g) for w, g in zip(wanted, given, strict=True)):
            raise InvalidMessage(f"key {key[:MAX_KEY]!r} is not of the form {self.root}/{form}")
        return [g for w, g in zip(wanted, given, strict=True) if w == "*"]


@lru_cache(KEYS_KEPT)
def _map_of(keys: Keys, what: str, key: str) -> MapId:
    agent, epoch = keys._chunks(f"agent/*/{what}/*", key)
    return MapId(_name(agent, key), _number(epoch, key))


@lru_cache(KEYS_KEPT)
def _agent_of(keys: Keys, what: str, key: str) -> str:
    (agent,) = keys._parse_names(f"agent/*/{what}", key)
    return agent


def questions_to_robot(key: str) -> str:
    """Pattern: all questions to the robot to which this one goes; empty if it goes to no robot.

    A robot declares it once, instead of each key at which it answers: the more robots there are, the more a
    declaration costs the router.
    """
    match key.split("/"):
        case ["mapweave", version, fleet, "agent", name, _, *_] if NAME.fullmatch(name):
            return f"mapweave/{version}/{fleet}/agent/{name}/**"
        case _:
            return ""


def robot_of(key: str) -> str:
    """The name in which a message or a question comes: a robot's, or a person's with a key; else empty."""
    return _robot_in(key) if len(key) <= MAX_KEY else _robot_in.__wrapped__(key)


@lru_cache(KEYS_KEPT)
def _robot_in(key: str) -> str:
    match key.split("/")[3:]:
        case ["agent" | "robot", name, *_] | ["server", _, _, name] if NAME.fullmatch(name):
            return name
        case _:
            return ""


def _name(chunk: str, key: str) -> str:
    try:
        return check_name(chunk)
    except InvalidValue as error:
        raise InvalidMessage(f"key {key!r}: {error}") from None


def _number(chunk: str, key: str) -> int:
    # The text must be the canonical form of a number: "007" and digits of other scripts are refused.
    if not (chunk.isascii() and chunk.isdigit() and str(int(chunk)) == chunk and int(chunk) <= MAX_EPOCH):
        raise InvalidMessage(f"key {key!r}: {chunk!r} is no epoch")
    return int(chunk)
