"""Every key of a fleet: the version first, then who, then what. Keys contain no data.

    mapweave/1/<fleet>/agent/<agent>/change/<epoch>   one change each; see mapweave.wire.log_messages
    mapweave/1/<fleet>/agent/<agent>/head/<epoch>     beacon: the newest sequence number
    mapweave/1/<fleet>/agent/<agent>/log/<epoch>      question: a range of the log
    mapweave/1/<fleet>/agent/<agent>/alive/<epoch>    liveliness
    mapweave/1/<fleet>/agent/<agent>/status           what it is doing, for people; question: the same, now
    mapweave/1/<fleet>/agent/<agent>/mission          question: a mission order
    mapweave/1/<fleet>/agent/<agent>/drive            question: a person's velocity command
    mapweave/1/<fleet>/agent/<agent>/portal           question: it was taken through a portal
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

from dataclasses import dataclass

from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.node import NAME, MapId, check_name

VERSION = "1"
MAX_EPOCH = 2**53


def check_epoch(epoch: int) -> int:
    """Return the epoch, or raise InvalidValue if it is out of range."""
    if not 0 <= epoch <= MAX_EPOCH:
        raise InvalidValue(f"epoch {epoch} is out of range 0..{MAX_EPOCH}")
    return epoch


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

    def change(self, map_id: MapId) -> str:
        """Where an agent publishes the changes of one map."""
        return self._of_map("change", map_id)

    def changes(self) -> str:
        """Pattern: the changes of every map."""
        return f"{self.root}/agent/*/change/*"

    def head(self, map_id: MapId) -> str:
        """Where an agent publishes the newest sequence number of a map."""
        return self._of_map("head", map_id)

    def heads(self) -> str:
        """Pattern: the beacons of every map."""
        return f"{self.root}/agent/*/head/*"

    def log(self, map_id: MapId) -> str:
        """Where an agent answers for ranges of a map's log."""
        return self._of_map("log", map_id)

    def logs(self, agent: str) -> str:
        """Pattern: the logs of all maps of an agent."""
        return f"{self.root}/agent/{check_name(agent)}/log/*"

    def agent_alive(self, map_id: MapId) -> str:
        """Under which an agent that makes this map is alive."""
        return self._of_map("alive", map_id)

    def agents_alive(self) -> str:
        """Pattern: every agent."""
        return f"{self.root}/agent/*/alive/*"

    def agent_status(self, agent: str) -> str:
        """Where an agent publishes what it is doing."""
        return f"{self.root}/agent/{check_name(agent)}/status"

    def agent_statuses(self) -> str:
        """Pattern: what every agent is doing."""
        return f"{self.root}/agent/*/status"

    def mission(self, agent: str) -> str:
        """Where an agent takes orders."""
        return f"{self.root}/agent/{check_name(agent)}/mission"

    def drive(self, agent: str) -> str:
        """Where an agent takes a person's velocity commands."""
        return f"{self.root}/agent/{check_name(agent)}/drive"

    def portal(self, agent: str) -> str:
        """Where an agent takes reports that it was taken through a portal."""
        return f"{self.root}/agent/{check_name(agent)}/portal"

    # Keys of a server.

    def ack(self, server: str, agent: str) -> str:
        """Acknowledgements of a server to an agent."""
        return f"{self.root}/server/{check_name(server)}/ack/{check_name(agent)}"

    def all_acks(self, server: str) -> str:
        """Pattern: a server's acknowledgements to all agents; a question: the newest map of one."""
        return f"{self.root}/server/{check_name(server)}/ack/*"

    def acks(self, agent: str) -> str:
        """Pattern: acknowledgements of any server to an agent."""
        return f"{self.root}/server/*/ack/{check_name(agent)}"

    def poses(self, server: str, agent: str) -> str:
        """Merged poses of an agent's nodes, published by a server; a question returns all of them."""
        return f"{self.root}/server/{check_name(server)}/poses/{check_name(agent)}"

    def all_poses(self, server: str) -> str:
        """Pattern: a server's merged poses for all agents."""
        return f"{self.root}/server/{check_name(server)}/poses/*"

    def relocalize(self, server: str) -> str:
        """Relocalization by a server."""
        return self._of_server("relocalize", server)

    def any_relocalize(self) -> str:
        """Pattern: any server."""
        return f"{self.root}/server/*/relocalize"

    def route(self, server: str) -> str:
        """Where a server gives a way from node to node."""
        return self._of_server("route", server)

    def any_route(self) -> str:
        """Pattern: any server."""
        return f"{self.root}/server/*/route"

    def known(self, server: str) -> str:
        """Fleet coverage by a server."""
        return self._of_server("known", server)

    def any_known(self) -> str:
        """Pattern: any server."""
        return f"{self.root}/server/*/known"

    def server_map(self, server: str) -> str:
        """Where a server hands out the merged map as the bytes of a map file."""
        return self._of_server("map", server)

    def any_server_map(self) -> str:
        """Pattern: any server."""
        return f"{self.root}/server/*/map"

    def server_mission(self, server: str) -> str:
        """Where a server takes missions, and hands them on."""
        return self._of_server("mission", server)

    def any_mission(self) -> str:
        """Pattern: any server."""
        return f"{self.root}/server/*/mission"

    def missions(self, server: str) -> str:
        """The missions that a server knows of."""
        return self._of_server("missions", server)

    def any_missions(self) -> str:
        """Pattern: any server."""
        return f"{self.root}/server/*/missions"

    def robots(self, server: str) -> str:
        """The robots as a server sees them."""
        return self._of_server("robots", server)

    def any_robots(self) -> str:
        """Pattern: any server."""
        return f"{self.root}/server/*/robots"

    def reserve(self, server: str) -> str:
        """Reservations of edges by a server."""
        return self._of_server("reserve", server)

    def any_reserve(self) -> str:
        """Pattern: any server."""
        return f"{self.root}/server/*/reserve"

    def nearby(self, server: str) -> str:
        """Where a server says which robots are around a robot."""
        return self._of_server("nearby", server)

    def any_nearby(self) -> str:
        """Pattern: any server."""
        return f"{self.root}/server/*/nearby"

    def explain(self, server: str) -> str:
        """Explanations by a server."""
        return self._of_server("explain", server)

    def any_explain(self) -> str:
        """Pattern: any server."""
        return f"{self.root}/server/*/explain"

    def constrain(self, server: str) -> str:
        """Manual constraints to a server."""
        return self._of_server("constrain", server)

    def any_constrain(self) -> str:
        """Pattern: every server of the fleet."""
        return f"{self.root}/server/*/constrain"

    def annotate(self, server: str) -> str:
        """Annotations to a server."""
        return self._of_server("annotate", server)

    def any_annotate(self) -> str:
        """Pattern: every server of the fleet."""
        return f"{self.root}/server/*/annotate"

    def annotations(self, server: str) -> str:
        """The record of annotations, from a server."""
        return self._of_server("annotations", server)

    def any_annotations(self) -> str:
        """Pattern: every server of the fleet."""
        return f"{self.root}/server/*/annotations"

    def resolve(self, server: str) -> str:
        """Which nodes names and positions are, by a server."""
        return self._of_server("resolve", server)

    def any_resolve(self) -> str:
        """Pattern: every server of the fleet."""
        return f"{self.root}/server/*/resolve"

    def plans(self, server: str) -> str:
        """Floor plans under the merged map, from a server."""
        return self._of_server("plans", server)

    def any_plans(self) -> str:
        """Pattern: any server."""
        return f"{self.root}/server/*/plans"

    def plan_image(self, server: str) -> str:
        """Images of floor plans, from a server."""
        return self._of_server("plan_image", server)

    def any_plan_image(self) -> str:
        """Pattern: any server."""
        return f"{self.root}/server/*/plan_image"

    def put_plan_image(self, server: str) -> str:
        """Images of floor plans to a server."""
        return self._of_server("put_plan_image", server)

    def any_put_plan_image(self) -> str:
        """Pattern: every server of the fleet."""
        return f"{self.root}/server/*/put_plan_image"

    def constraints(self, server: str) -> str:
        """The record of manual constraints of a server."""
        return self._of_server("constraints", server)

    def any_constraints(self) -> str:
        """Pattern: any server."""
        return f"{self.root}/server/*/constraints"

    def history(self, server: str) -> str:
        """The history of the maps, from a server."""
        return self._of_server("history", server)

    def any_history(self) -> str:
        """Pattern: every server of the fleet."""
        return f"{self.root}/server/*/history"

    def server_status(self, server: str) -> str:
        """Where a server publishes what it is doing."""
        return self._of_server("status", server)

    def server_statuses(self) -> str:
        """Pattern: what every server is doing."""
        return f"{self.root}/server/*/status"

    def server_alive(self, server: str) -> str:
        """Under which a server is alive."""
        return self._of_server("alive", server)

    def servers_alive(self) -> str:
        """Likewise of every server."""
        return f"{self.root}/server/*/alive"

    # Keys of a robot base.

    def robot_describe(self, robot: str) -> str:
        """Description of a robot base."""
        return f"{self.root}/robot/{check_name(robot)}/describe"

    def robot_step(self, robot: str) -> str:
        """A robot base takes a command and returns the next observation."""
        return f"{self.root}/robot/{check_name(robot)}/step"

    def robot_driver(self, robot: str, number: int) -> str:
        """Liveliness of a robot base's driver."""
        return f"{self.root}/robot/{check_name(robot)}/driver/{check_epoch(number)}"

    def robot_drivers_of(self, robot: str) -> str:
        """Pattern: all agents that drive one base."""
        return f"{self.root}/robot/{check_name(robot)}/driver/*"

    def robot_drivers(self) -> str:
        """Pattern: all drivers of a base."""
        return f"{self.root}/robot/*/driver/*"

    # Parsing of received keys. Each raises InvalidMessage if the key is of another form.

    def parse_change(self, key: str) -> MapId:
        """Whose changes."""
        return self._parse_map("change", key)

    def parse_head(self, key: str) -> MapId:
        """Whose beacon."""
        return self._parse_map("head", key)

    def parse_log(self, key: str) -> MapId:
        """Whose log."""
        return self._parse_map("log", key)

    def parse_agent_alive(self, key: str) -> MapId:
        """Which agent, and which map it makes."""
        return self._parse_map("alive", key)

    def parse_agent_status(self, key: str) -> str:
        """Which agent."""
        return self._parse_names("agent/*/status", key)[0]

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

    def _of_map(self, what: str, map_id: MapId) -> str:
        return f"{self.root}/agent/{check_name(map_id.agent)}/{what}/{check_epoch(map_id.epoch)}"

    def _of_server(self, what: str, server: str) -> str:
        return f"{self.root}/server/{check_name(server)}/{what}"

    def _parse_map(self, what: str, key: str) -> MapId:
        agent, epoch = self._chunks(f"agent/*/{what}/*", key)
        return MapId(_name(agent, key), _number(epoch, key))

    def _parse_names(self, form: str, key: str) -> list[str]:
        return [_name(chunk, key) for chunk in self._chunks(form, key)]

    def _chunks(self, form: str, key: str) -> list[str]:
        """The chunks that match `*` of the form."""
        wanted = [*self.root.split("/"), *form.split("/")]
        given = key.split("/") if len(key) <= 256 else []
        if len(given) != len(wanted) or any(w not in ("*", g) for w, g in zip(wanted, given, strict=True)):
            raise InvalidMessage(f"key {key[:256]!r} is not of the form {self.root}/{form}")
        return [g for w, g in zip(wanted, given, strict=True) if w == "*"]


def robot_of(key: str) -> str:
    """In whose name a message or a question comes: a robot's, or a person's with a key; else empty."""
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
