"""`mapweave agent`: one robot."""

from __future__ import annotations

import argparse
import os
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapweave.commands import values
from mapweave.commands.network import (
    add_log_format,
    add_network,
    client_settings,
    connect,
    keep_files_private,
    network_of,
    own_key,
    reach,
    settings_of,
    simulator_beside,
    stop_on_signals,
    warn_without_router,
)
from mapweave.commands.value_completion import complete_drivers
from mapweave.connection import found_soon
from mapweave.extras import need

if TYPE_CHECKING:
    from mapweave.agent.drivers.checked import CheckedRobot
    from mapweave.agent.drivers.robot import Robot
    from mapweave.agent.drivers.settings import RobotSettings
    from mapweave.agent.synchronization import Synchronization
    from mapweave.settings import NetworkSettings
    from mapweave.wire.bus import Bus
    from mapweave.wire.ros2.settings import Ros2Link
    from mapweave.wire.zenoh_bus import ZenohBus


def add_to(commands: Any) -> None:
    """Declare the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "agent",
        help="run one robot's agent",
        description="Run one robot: its whole pipeline, its own map on its own disk, its link to the fleet. "
        "Without a network it goes on mapping; what it mapped is sent when a server can be reached.",
    )
    parser.add_argument("name", type=values.name, help="the robot's name in the fleet, for example r0")
    add_robot(parser)
    parser.add_argument(
        "--mission", choices=["idle", "explore", "carried"],
        help="what to do now (default: go on with the last mission; a robot without one explores)",
    )  # fmt: skip
    parser.add_argument(
        "--without-rangers", action="store_true",
        help="a robot without proximity sensors may explore, slowly, by its camera and by touch",
    )  # fmt: skip
    parser.add_argument(
        "--data",
        type=Path,
        default=Path("out/agents"),
        help="folder for the robot's map (default: out/agents)",
    )
    parser.add_argument(
        "--epoch", type=int, help="least number of a new map (default: the next one, as the server knows it)"
    )
    which = parser.add_mutually_exclusive_group()
    which.add_argument(
        "--fresh", action="store_true", help="begin a new map; else the newest map of the journal goes on"
    )
    which.add_argument("--resume", metavar="MAP", help="go on with this map of the journal, for example r0.3")
    add_calibration(parser)
    parser.add_argument("--record", type=Path, metavar="DIR", help="record what the robot senses, as MCAP")
    parser.add_argument(
        "--ros2", nargs="?", const="", metavar="ENDPOINT",
        help="publish pose, tf, path and map as ROS 2 topics, for rviz and Nav2 (docs/ros2.md), through this "
        "Zenoh router (default: that of the driver ros2, else tcp/127.0.0.1:7447)",
    )  # fmt: skip
    add_logs(parser)
    parser.add_argument(
        "--metrics", type=values.port, metavar="PORT",
        help="tell Prometheus about the robot at http://127.0.0.1:PORT/metrics, on this machine alone "
        "(docs/monitoring.md; default: off)",
    )  # fmt: skip
    parser.add_argument(
        "--seed", type=values.seed, default=0, help="of the random choices in exploration (default: 0)"
    )
    parser.add_argument(
        "--lockstep", action="store_true", help="wait for answers between ticks: repeatable simulation"
    )
    add_log_format(parser)
    add_network(parser)
    parser.set_defaults(run=run)


def add_logs(parser: argparse.ArgumentParser) -> None:
    """Declare the logs for the Rerun viewer and for Foxglove."""
    parser.add_argument(
        "--rerun", nargs="?", const="connect", metavar="FILE|connect",
        help="show what it senses and estimates in the Rerun viewer: into FILE.rrd, or to the viewer on this "
        "computer (default), or to that at rerun+http://HOST:PORT/proxy (docs/see-inside.md)",
    )  # fmt: skip
    parser.add_argument(
        "--mcap-log", metavar="FOLDER", help="the same into FOLDER/NAME.mcap, for Foxglove and rviz"
    )


def add_robot(parser: argparse.ArgumentParser) -> None:
    """Declare which robot it is, and where it is reached."""
    robot = parser.add_argument(
        "--robot", metavar="DRIVER|FILE",
        help="a driver as `mapweave robots` lists them, your own class, FILE.py:CLASS, or the settings file, "
        "FILE.toml, that names the driver (default: [robot] driver of --settings, else remote, a base behind "
        "Zenoh keys such as the simulator's)",
    )  # fmt: skip
    complete_drivers(robot)
    parser.add_argument(
        "--body",
        type=values.endpoint,
        metavar="ENDPOINT",
        help="Zenoh endpoint of the robot's body (default: the fleet's)",
    )


def take_robot_file(arguments: argparse.Namespace) -> None:
    """Read a settings file that is given as the robot as --settings.

    Raises:
        UsageError: --settings is given, too.
    """
    from mapweave.commands.usage import UsageError

    given: str | None = arguments.robot
    if given is None or not given.endswith(".toml"):
        return
    if arguments.settings not in (None, Path(given)):
        raise UsageError(f"--robot {given} is a settings file, and so is --settings: give one of them")
    arguments.settings, arguments.robot = Path(given), None


def run(arguments: argparse.Namespace) -> int:
    """Run the robot until its driver ends or the process is stopped."""
    from mapweave.agent.drivers.settings import REMOTE
    from mapweave.commands.usage import UsageError, arguments_read
    from mapweave.hybridmap.errors import Refused
    from mapweave.terminal import log_with_time
    from mapweave.wire.keys import check_epoch

    name: str = arguments.name
    log_with_time(arguments.log_format, robot=name)
    if arguments.metrics is not None:
        need("metrics")  # before the robot is waited for
    if arguments.epoch is not None:
        with arguments_read():
            check_epoch(arguments.epoch)
    resume = None
    if arguments.resume is not None:
        from mapweave.commands.map_ends import map_of

        resume = map_of(arguments.resume)
        if not (arguments.data / f"{name}.sqlite").exists():
            raise Refused(f"{arguments.data}: there is no journal of {name} with a map to resume")
    take_robot_file(arguments)
    settings = settings_of(arguments)
    network = network_of(arguments, settings, name)
    simulated = arguments.lockstep and (arguments.robot or settings.robot.driver) == REMOTE
    if simulated and network.keys and not arguments.body:
        raise UsageError(simulator_beside(network))
    keep_files_private(network)
    calibration = calibration_of(arguments, name)
    if arguments.record is not None:
        from mapweave.agent.recordings.mcap_writer import check_new

        check_new(arguments.record)
    bus, keys = connect(network)
    opened, body, beside, claim = time.monotonic(), bus, network, None
    robot: Robot | None = None
    key = own_key(bus, network, name)
    try:
        if arguments.body:
            beside = replace(network, endpoints=(arguments.body,), keys="")
            body, _ = connect(beside)
        # The whole pipeline, while the router is looked for. What is wrong with settings, keys or command
        # line is said before.
        from mapweave.agent.drivers.claim import Claim
        from mapweave.agent.drivers.recorded import RecordedRobot
        from mapweave.hybridmap.mission_order import MissionKind
        from mapweave.processes.agent import AgentOptions
        from mapweave.processes.agent_process import run_agent

        stop = stop_on_signals()
        if found_soon(body, client_settings(beside)):
            claim = Claim(body, keys, name)
        robot, synchronization = checked, _ = open_robot(
            arguments, settings.robot, body, network.fleet, name, arguments.lockstep, stop
        )
        # After what is wrong with settings and driver, which then is the only line.
        warn_without_router(bus, name, client_settings(network), opened)
        if arguments.record is not None:
            robot = RecordedRobot(robot, arguments.record, print_line=print_error)
        # A stop signal ends the wait for the robot.
        threading.Thread(target=close_on, args=(stop, checked), name="stop", daemon=True).start()
        kinds = {"explore": MissionKind.EXPLORE, "carried": MissionKind.CARRIED, "idle": MissionKind.STOP}
        options = AgentOptions(
            name=name,
            data=arguments.data,
            epoch=arguments.epoch,
            fresh=arguments.fresh,
            resume=resume,
            mission=kinds.get(arguments.mission),
            otherwise=MissionKind.EXPLORE,
            seed=arguments.seed,
            synchronization=synchronization,
            server=network.server,
            calibration=calibration,
            ros2=None if arguments.ros2 is None else ros2_link(arguments, settings.robot),
            rerun=arguments.rerun,
            mcap_log=arguments.mcap_log,
            metrics=arguments.metrics,
        )
        agent = settings.agent
        if arguments.without_rangers:
            agent = replace(agent, exploration=replace(agent.exploration, without_rangers=True))
        run_agent(robot, bus, keys, agent, options, stop)
    finally:
        if key is not None:
            key.close()
        if robot is not None:
            robot.close()
        if claim is not None:
            claim.close()
        if body is not bus:
            body.close()
        bus.close()
    return 0


def add_calibration(parser: argparse.ArgumentParser) -> None:
    """Declare where the measured geometry of robots is."""
    parser.add_argument(
        "--calibration", type=Path, default=Path("out/calibration"), metavar="DIR",
        help="folder of what `mapweave calibrate` has measured, a file per robot (default: out/calibration)",
    )  # fmt: skip


def calibration_of(arguments: argparse.Namespace, name: str) -> Path:
    """The file of what was measured of a robot.

    Raises:
        SettingsError: what should be the folder is a file.
    """
    from mapweave.hybridmap.errors import SettingsError

    folder: Path = arguments.calibration
    if folder.exists() and not folder.is_dir():
        raise SettingsError(f"--calibration {folder}: is a file; give the folder in which it is")
    return folder / f"{name}.toml"


def ros2_link(arguments: argparse.Namespace, settings: RobotSettings) -> Ros2Link:
    """Where to publish: where the robot's own topics are, if it has any."""
    from mapweave.agent.drivers.ros2 import Ros2Options
    from mapweave.wire.ros2.settings import Ros2Link

    link = Ros2Link()
    if (arguments.robot or settings.driver) == "ros2":
        link = settings.options_as(Ros2Options)
    if arguments.ros2:
        link = replace(link, endpoint=arguments.ros2)
    link.domain_id()
    return link


def print_error(line: str) -> None:
    """Print an event for people, with the time, beside the output proper."""
    from mapweave.terminal import stamped

    print(stamped(line), file=sys.stderr, flush=True)


def open_robot(
    arguments: argparse.Namespace,
    settings: RobotSettings,
    bus: Bus,
    fleet: str,
    name: str,
    lockstep: bool = False,
    stop: threading.Event | None = None,
) -> tuple[CheckedRobot, Synchronization]:
    """The robot, its output checked, and how the loop is synchronised: a simulation may run in lock-step.

    Until `stop` a camera's stream that does not answer yet is waited for; without it, it is an error at once.
    """
    from mapweave.agent.drivers.checked import CheckedRobot
    from mapweave.agent.drivers.registry import find_driver
    from mapweave.agent.drivers.remote import RemoteRobot
    from mapweave.agent.drivers.settings import REMOTE
    from mapweave.agent.synchronization import FreeRunning, LockstepWaiting
    from mapweave.commands.usage import UsageError
    from mapweave.hybridmap.errors import SettingsError

    driver = arguments.robot or settings.driver
    if driver == REMOTE and not arguments.robot:
        settings.check_remote()
    if driver == REMOTE and not lockstep:
        return CheckedRobot(RemoteRobot(bus, fleet, name)), FreeRunning()
    if driver == REMOTE:
        from mapweave.sim.lockstep_robot import LockstepRobot

        robot = LockstepRobot(bus, fleet, name)
        return CheckedRobot(robot), LockstepWaiting(robot.rendezvous)
    if lockstep or arguments.body:
        raise UsageError(f"--lockstep and --body are for simulated robots, not for the driver {driver}")
    try:
        make = find_driver(driver)
    except SettingsError as error:
        raise (UsageError(str(error)) if arguments.robot else error) from None
    if stop is None:
        return CheckedRobot(make(settings)), FreeRunning()
    from mapweave.processes.stream_wait import made_with_stream

    opened = made_with_stream(lambda: make(settings), lambda line: print_error(f"{name}: {line}"), stop)
    return CheckedRobot(opened), FreeRunning()


def bus_of(arguments: argparse.Namespace, settings: RobotSettings, network: NetworkSettings) -> ZenohBus:
    """A connection of a command that needs the network only if the robot's base is behind it.

    Raises:
        NotConnected: the base is, and there is no router.
    """
    from mapweave.agent.drivers.settings import REMOTE

    remote = (arguments.robot or settings.driver) == REMOTE
    if remote and not arguments.robot:
        settings.check_remote()
    return (reach(network) if remote else connect(network))[0]


PATIENCE = 5.0
"""s that a driver may take to return once it is closed."""


def close_on(stop: threading.Event, robot: CheckedRobot) -> None:
    """Close a robot once the process is stopped, which ends a wait for an observation.

    A driver that does not return even then is named, and the process ends without it: each change of the map
    is in the journal already.
    """
    stop.wait()
    end = threading.Timer(PATIENCE, end_without, args=(robot,))
    end.daemon = True
    end.start()
    robot.close()


def end_without(robot: CheckedRobot) -> None:
    """End the process if the driver hangs."""
    if robot.waiting >= PATIENCE:
        print_error(
            f"the driver's sense() has not returned for {robot.waiting:.0f} s: the process ends without it"
        )
        os._exit(1)
