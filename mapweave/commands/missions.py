"""`mapweave go`, `explore`, `stop` and `missions`: missions of robots of a running fleet."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Collection
from typing import TYPE_CHECKING, Any

from mapweave.commands import values
from mapweave.commands.answer import add_json
from mapweave.commands.network import add_network, add_reason, network_of, settings_of
from mapweave.commands.usage import UsageError
from mapweave.exit_status import DONE, NO

if TYPE_CHECKING:
    from mapweave.fleet import Fleet
    from mapweave.hybridmap.agent_status import AgentStatus
    from mapweave.hybridmap.mission_order import MissionReport

NOT_TAKEN = "4 if it did not, or the map server refused it, 1 if neither can be asked."
STATUS = (
    "Exit status: 0 if the robot took the mission (with --wait: has done it within --timeout), " + NOT_TAKEN
)


def add_to(commands: Any) -> None:
    """Declare the commands."""
    go: argparse.ArgumentParser = commands.add_parser(
        "go",
        help="send a robot to a node, a position or home",
        description="Send a robot to a place of the merged map, where it parks: `mapweave go r0 r1.1.17` to "
        "a node, `mapweave go r0 kitchen` to a named place "
        "(`mapweave place`), `mapweave go r0 3.1,-2.0` to the node nearest to a position (m, in the "
        "frame of the robot's component), `mapweave go r0 home` to the first node of its map. A "
        "goal that does not exist is refused; one that cannot be reached is given up, with the reason. "
        f"{STATUS}",
    )
    go.add_argument("robot", type=values.name, help="the robot's name, for example r0")
    go.add_argument(
        "goal",
        type=values.goal,
        metavar="GOAL",
        help="a node (r0.1.17), a named place, a position (3.1,-2.0) or home",
    )
    go.add_argument(
        "--via", type=values.goal, action="append", default=[], metavar="PLACE",
        help="pass this first: a node, a place or a position; may be given again, in the order of the way",
    )  # fmt: skip
    go.add_argument("--plan", metavar="NAME", help="positions are on this floor plan, m")
    _add_common(go, 600.0)
    go.set_defaults(
        run=lambda arguments: run(
            arguments,
            lambda f: f.go(
                arguments.robot,
                arguments.goal,
                via=arguments.via,
                plan=arguments.plan,
                because=arguments.because,
            ),
        )
    )

    explore: argparse.ArgumentParser = commands.add_parser(
        "explore",
        help="let a robot explore",
        description="Let a robot map all floor that it can reach: `mapweave explore r0`. " + STATUS,
    )
    explore.add_argument("robot", type=values.name, help="the robot's name, for example r0")
    _add_common(explore, 3600.0)
    explore.set_defaults(
        run=lambda arguments: run(arguments, lambda f: f.explore(arguments.robot, because=arguments.because))
    )

    stop: argparse.ArgumentParser = commands.add_parser(
        "stop",
        help="stop a robot, or all",
        description="Stop a robot, `mapweave stop r0`, or all, `mapweave stop --all`. The order goes to the "
        "robots directly, and works without a map server; a robot that is away gets it once it is back, "
        f"and no mission of before. Exit status: 0 if every robot took it, {NOT_TAKEN}",
    )
    which = stop.add_mutually_exclusive_group(required=True)
    which.add_argument("robot", nargs="?", type=values.name, help="the robot's name, for example r0")
    which.add_argument("--all", action="store_true", help="every robot of the fleet")
    _add_common(stop, None)
    stop.set_defaults(run=run_stop)

    missions: argparse.ArgumentParser = commands.add_parser(
        "missions",
        help="list the missions of robots",
        description="List the newest missions that the map server keeps, oldest first: robot, goal, state, "
        "reason.",
    )
    missions.add_argument("robot", nargs="?", type=values.name, help="of this robot alone, for example r0")
    add_json(missions)
    add_network(missions)
    missions.set_defaults(run=run_missions)


def _add_common(parser: argparse.ArgumentParser, patience: float | None) -> None:
    if patience is not None:
        parser.add_argument("--wait", action="store_true", help="wait until it is over, and say how it ended")
        parser.add_argument(
            "--timeout", type=values.seconds, default=patience, metavar="S",
            help=f"with --wait: at most so long (default: {patience:g})",
        )  # fmt: skip
    add_reason(parser)
    add_json(parser)
    add_network(parser)


def fleet_of(arguments: argparse.Namespace) -> Fleet:
    """The fleet that the command line names; raises NotConnected."""
    from mapweave.fleet import Fleet

    network = network_of(arguments, settings_of(arguments))
    return Fleet(network.endpoints, network.fleet, getattr(arguments, "by", ""), network.keys)


def run(arguments: argparse.Namespace, give: Callable[[Fleet], MissionReport]) -> int:
    """Give a mission, and wait for its end if that is wanted."""
    if arguments.wait and not arguments.timeout > 0.0:
        raise UsageError(f"--timeout {arguments.timeout:g}: give seconds")
    with fleet_of(arguments) as fleet:
        report = give(fleet)
        if arguments.wait and report.open:
            print(words(report), file=sys.stderr)
            keys = network_of(arguments, settings_of(arguments)).keys
            report = fleet.wait(report, arguments.timeout, _progress(), _silence(arguments.robot, keys))
            if report.open:
                print(_late(report, arguments.timeout), file=sys.stderr)
        elif report.open and (follows := unattended(fleet)):
            print(f"{follows.rstrip('.')}; --wait counts as a page", file=sys.stderr)
    _print([report], arguments.json)
    return _exit_status([report], arguments.wait)


def unattended(fleet: Fleet) -> str:
    """What robots do once no operator is there, if a map server says so."""
    return next((str(one["unattended"]) for one in fleet.servers() if one.get("unattended")), "")


def run_stop(arguments: argparse.Namespace) -> int:
    """Stop robots."""
    with fleet_of(arguments) as fleet:
        reports = list(fleet.stop(arguments.robot or "", arguments.because))
    if not reports and not arguments.json:
        print("no robot is there")
    _print(reports, arguments.json)
    return _exit_status(reports, False, sent_is_good=False)


def run_missions(arguments: argparse.Namespace) -> int:
    """List missions."""
    with fleet_of(arguments) as fleet:
        reports = list(fleet.missions(arguments.robot or ""))
        gone = set[str]()
        if not arguments.json and any(report.open for report in reports):
            gone = {entry.robot for entry in fleet.status().robots if not entry.alive}
    if not reports and not arguments.json:
        print("no missions yet")
    _print(reports, arguments.json, gone)
    return DONE


def words(report: MissionReport) -> str:
    """One line."""
    order = report.order
    reason = f": {report.reason}" if report.reason else ""
    return f"{order.robot}: {order.words}, mission {order.id}, {report.state}{reason}"


def _progress() -> Callable[[MissionReport, AgentStatus], None]:
    """Prints a line when the robot does something else."""
    last = [""]

    def show(report: MissionReport, status: AgentStatus) -> None:
        if status.status.doing != last[0] and report.open:
            last[0] = status.status.doing
            print(f"{status.robot}: {last[0]} ({report.progress:.0%})", file=sys.stderr, flush=True)

    return show


def _silence(robot: str, keys: str) -> Callable[[float], None]:
    """Prints a line while nothing is heard of the robot; who waits hears nothing once the key is revoked."""
    also = f" Is {keys} still good (`mapweave keys list` at the server)?" if keys else ""

    def show(silent: float) -> None:
        words = f"{robot}: nothing heard for {silent:.0f} s: is its agent running, and its network up?"
        print(words + also, file=sys.stderr, flush=True)

    return show


def _late(report: MissionReport, timeout: float) -> str:
    """That the wait is over and the mission is not."""
    robot = report.order.robot
    on = f"the mission goes on: `mapweave stop {robot}` ends it"
    return f"{robot}: not over after {timeout:g} s (--timeout); {on}"


def _print(reports: list[MissionReport], as_json: bool, gone: Collection[str] = ()) -> None:
    """Print missions; those of robots that are gone go on once their agents are back."""
    if not as_json:
        for report in reports:
            waits = report.open and report.order.robot in gone
            print(words(report) + ("; the robot is gone, see `mapweave status`" if waits else ""))
        return
    import json

    from mapweave.mapserver.http.json_values import json_values

    print(json.dumps({"missions": [json_values(report) for report in reports]}))


def _exit_status(reports: list[MissionReport], waited: bool, sent_is_good: bool = True) -> int:
    """A stop that has not reached its robot is not good: the robot may drive."""
    from mapweave.hybridmap.mission_order import MissionState

    good = {MissionState.DONE} if waited else {MissionState.DONE, MissionState.RUNNING}
    if sent_is_good and not waited:
        good.add(MissionState.SENT)
    return DONE if all(report.state in good for report in reports) else NO
