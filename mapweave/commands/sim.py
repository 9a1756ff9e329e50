"""`mapweave sim`: serve simulated bodies, or run scenarios and judge them."""

from __future__ import annotations

import argparse
import json
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapweave.commands import values
from mapweave.commands.answer import add_json
from mapweave.commands.network import (
    add_log_format,
    add_network,
    client_settings,
    network_of,
    settings_of,
    simulator_beside,
    stop_on_signals,
    warn_without_router,
)
from mapweave.commands.usage import UsageError, arguments_read
from mapweave.commands.value_completion import complete_scenarios
from mapweave.exit_status import DONE, NO

if TYPE_CHECKING:
    from mapweave.scenarios.scenario import Scenario


def add_to(commands: Any) -> None:
    """Declare the commands."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "sim",
        help="simulated robots: run scenarios, or serve bodies for your own agents",
        description="Robots with cameras in PyBullet worlds. `run` tries a scenario with a whole fleet and "
        "judges it, `batch` does so with many seeds, `serve` only gives bodies to agents that you start.",
    )
    kinds = parser.add_subparsers(title="what to do", metavar="WHAT", required=True)
    _add_run(kinds)
    _add_batch(kinds)
    _add_serve(kinds)
    listing = kinds.add_parser(
        "list",
        help="the scenarios that come with Mapweave",
        description="Names and summaries. The files are a good start for your own: see docs/scenarios.md.",
    )
    add_json(listing)
    listing.set_defaults(run=run_list)


def _add_scenario(parser: argparse.ArgumentParser) -> None:
    scenario = parser.add_argument("scenario", help="a .toml file, or a name from `mapweave sim list`")
    complete_scenarios(scenario)
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="overrides",
        help="override the file, for example --set world.rooms=5; may be given several times",
    )  # fmt: skip


def _add_fleet(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--one-process", action="store_true", help="all robots in this process; the outcome is the same"
    )
    parser.add_argument(
        "--settings", type=Path, metavar="FILE", help="TOML for the robots' pipeline and the server's merge"
    )
    parser.add_argument("--json", action="store_true", help="print figures and verdicts as one JSON object")


def _add_run(kinds: Any) -> None:
    parser = kinds.add_parser(
        "run",
        help="try a scenario",
        description="Run a scenario with server, simulator and an agent for each robot; leave a report "
        "folder with figures, trajectories (TUM), map, picture and film. Exit status 0: all expectations "
        "were met; 4: not; 1: it could not be run.",
    )
    _add_scenario(parser)
    parser.add_argument(
        "--seed", type=values.seed, help="other seeds, other worlds (default: the scenario's)"
    )
    parser.add_argument("-o", "--out", type=Path, help="folder for the report (default: out/sim/NAME-SEED)")
    parser.add_argument(
        "--view", type=values.port, nargs="?", const=8090, metavar="PORT",
        help="show the trial live at http://127.0.0.1:PORT (default port: 8090)",
    )  # fmt: skip
    parser.add_argument(
        "--rerun", action="store_true",
        help="write what each robot senses and estimates for the Rerun viewer: rerun/ROBOT.1.rrd in --out",
    )  # fmt: skip
    parser.add_argument(
        "--mcap-log", action="store_true", help="the same for Foxglove and rviz: mcap/ROBOT.1/ in --out"
    )
    _add_fleet(parser)
    parser.set_defaults(run=run_one)


def _add_batch(kinds: Any) -> None:
    parser = kinds.add_parser(
        "batch",
        help="try a scenario with many seeds",
        description="Run a scenario once a seed and show the median and the worst of every figure; "
        "`sim run --seed` makes the film of one. Exit status 0: every trial met its expectations; 4: not; "
        "1: the scenario could not be read.",
    )
    _add_scenario(parser)
    parser.add_argument("--seeds", type=values.count, default=10, metavar="N", help="how many (default: 10)")
    parser.add_argument("--first", type=values.seed, help="the first seed (default: the scenario's)")
    parser.add_argument("-o", "--out", type=Path, help="folder for the reports (default: out/sim/NAME)")
    _add_fleet(parser)
    parser.set_defaults(run=run_batch)


def _add_serve(kinds: Any) -> None:
    parser = kinds.add_parser(
        "serve",
        help="simulated bodies for agents that you start yourself",
        description="Serve the robots of a scenario, in lock-step: time advances when every agent has sent "
        "its command. The scenario's events do not happen by themselves.",
    )
    _add_scenario(parser)
    parser.add_argument("--seed", type=values.seed, help="of world, start places and faults")
    parser.add_argument(
        "--listen",
        type=values.endpoint,
        metavar="ENDPOINT",
        help="be reachable here, instead of connecting to the fleet's router; with keys the only way",
    )
    parser.add_argument(
        "--held", action="store_true", help="let no time pass before a scenario's runner asks for it"
    )
    add_log_format(parser)
    add_network(parser)
    parser.set_defaults(run=run_serve)


def run_list(arguments: argparse.Namespace) -> int:
    """Name and summary of each scenario."""
    from rich.table import Table

    from mapweave.scenarios.scenario import load_scenario, scenario_names, scenario_path
    from mapweave.terminal import plain_or_terminal

    if arguments.json:
        summaries = {name: load_scenario(scenario_path(name)).summary for name in scenario_names()}
        print(json.dumps({"scenarios": summaries}))
        return DONE
    table = Table(box=None, show_header=False)
    for name in scenario_names():
        table.add_row(name, load_scenario(scenario_path(name)).summary)
    plain_or_terminal(stderr=False).print(table)
    return 0


def run_one(arguments: argparse.Namespace) -> int:
    """Run one trial and print what came of it."""
    from mapweave.extras import TRIAL, need

    need(*TRIAL, *(["rerun"] if arguments.rerun else []))
    from mapweave.scenarios.run import TrialOptions, run_trial
    from mapweave.scenarios.summary import summary_table
    from mapweave.terminal import plain_or_terminal

    settings = settings_of(arguments)
    scenario = _scenario(arguments)
    seed = scenario.seed if arguments.seed is None else arguments.seed
    out = arguments.out or Path("out/sim") / f"{scenario.name}-{seed}"
    options = TrialOptions(
        seed, out, not arguments.one_process, settings.agent, arguments.settings,
        view=arguments.view, rerun=arguments.rerun, mcap_log=arguments.mcap_log,
    )  # fmt: skip
    trial = run_trial(scenario, options)
    if arguments.json:
        print(json.dumps(trial.as_dict()))
    else:
        console = plain_or_terminal(stderr=False)
        console.print(summary_table(scenario, seed, trial))
        console.print(f"the report is in {out}: report.md, map.png, film.webm, trajectories ...")
    return DONE if trial.passed else NO


def run_batch(arguments: argparse.Namespace) -> int:
    """Run many trials and print the table."""
    from mapweave.extras import TRIAL, need

    need(*TRIAL)
    from mapweave.output_folder import check_output
    from mapweave.scenarios.batch import BatchOptions, run_batch_of_trials
    from mapweave.scenarios.run import TrialOptions

    settings = settings_of(arguments)
    scenario = _scenario(arguments)
    first = scenario.seed if arguments.first is None else arguments.first
    out = check_output(arguments.out or Path("out/sim") / scenario.name)
    trial = TrialOptions(
        first, out, not arguments.one_process, settings.agent, arguments.settings, film_every=0.0
    )
    options = BatchOptions(trial, arguments.seeds, arguments.json)
    return DONE if run_batch_of_trials(scenario, options) else NO


def run_serve(arguments: argparse.Namespace) -> int:
    """Serve the simulated robots until stopped."""
    settings = settings_of(arguments)
    network = network_of(arguments, settings)
    if network.keys and not arguments.listen:
        raise UsageError(simulator_beside(network))
    scenario = _scenario(arguments)
    from mapweave.processes.simulator import run_sim
    from mapweave.terminal import log_with_time
    from mapweave.wire.bus_settings import BusSettings
    from mapweave.wire.zenoh_bus import ZenohBus

    # Which robots time waits for, and which agents have gone.
    log_with_time(arguments.log_format)
    logging.getLogger("mapweave.sim").setLevel(logging.INFO)
    seed = scenario.seed if arguments.seed is None else arguments.seed
    stop = stop_on_signals()
    if arguments.listen:
        bus = ZenohBus(BusSettings(mode="router", listen=(arguments.listen,)))
    else:
        client = client_settings(network)
        bus = ZenohBus(client)
        warn_without_router(bus, "the simulator", client)
    try:
        run_sim(bus, network.fleet, scenario.world(seed), scenario.robots, seed, stop, arguments.held)
    finally:
        bus.close()
    return 0


def _scenario(arguments: argparse.Namespace) -> Scenario:
    """The scenario that is named, with what the command line changes of it.

    Raises:
        UsageError: there is none of this name, or what is to be changed is not in it.
        SettingsError: its file is wrong.
    """
    from mapweave.scenarios.scenario import load_scenario, scenario_path

    with arguments_read():
        path = scenario_path(arguments.scenario)
    scenario = load_scenario(path)
    if not arguments.overrides:
        return scenario
    with arguments_read():
        scenario = load_scenario(path, arguments.overrides)
        scenario.world(0)  # what is wrong with it is said before anything is started
    return scenario
