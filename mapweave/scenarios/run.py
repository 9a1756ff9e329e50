"""One trial from beginning to end: fleet, runner, recording, figures, folder."""

import shutil
import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from mapweave.agent.settings import AgentSettings
from mapweave.hybridmap.errors import SettingsError
from mapweave.scenarios.disks import read_disks
from mapweave.scenarios.expectations import check
from mapweave.scenarios.filming import FilmingOptions, filming
from mapweave.scenarios.fleet import TrialFleet, TrialStage
from mapweave.scenarios.recording import RobotRecord, TrialRecording, TrialTrajectory
from mapweave.scenarios.scenario import Scenario
from mapweave.scenarios.scenario_runner import ScenarioRunner
from mapweave.scenarios.score import TrialResult, score
from mapweave.scenarios.terminal_progress import TerminalProgress
from mapweave.sim.placement import starting_places

OWN = ".mapweave-trial"
"""A file of this name marks a folder as a trial's: only there folders are taken away."""
FOLDERS = ("agents", "server", "logs", "photographs", "rerun", "mcap")
FILES = (
    "*.tum", "*.mapweave", "figures.json", "report.*", "map.png", "errors.png", "film.webm", "scenario.toml",
)  # fmt: skip


@dataclass(frozen=True)
class TrialOptions:
    """How a trial is run.

    Attributes:
        seed: of everything.
        out: folder for the report; an earlier trial's in it is replaced.
        processes: a process for each agent, the server and the simulator; else all in one.
        settings: of every robot's pipeline.
        settings_file: where they came from, if from a file.
        film_every: simulated seconds between two frames of the film; 0 makes none.
        view: port of the live view, None for none.
        quiet: no progress on the terminal.
        rerun: whether each robot's agent writes a log for the Rerun viewer.
        mcap_log: whether it writes one for Foxglove.
    """

    seed: int
    out: Path
    processes: bool = True
    settings: AgentSettings = field(default_factory=AgentSettings)
    settings_file: Path | None = None
    film_every: float = 1.0
    view: int | None = None
    quiet: bool = False
    rerun: bool = False
    mcap_log: bool = False


def run_trial(scenario: Scenario, options: TrialOptions) -> TrialResult:
    """Run a scenario and leave its report in a folder.

    Raises:
        MapweaveError: something could not be started, or ended; one line gives the reason.
    """
    from mapweave.scenarios.report_folder import write_folder

    # A world that cannot be built shall be one line, before anything has been started.
    starting_places(scenario.world(options.seed), scenario.robots, options.seed)
    _make_room(options.out)
    stage = TrialStage(
        scenario, options.seed, options.out, options.settings, options.settings_file, options.rerun,
        options.mcap_log,
    )  # fmt: skip
    with TerminalProgress(scenario.name, stage.robots, len(scenario.events), options.quiet) as show:
        recording = _record(stage, options, show)
        show.stage("scoring")
        figures = score(recording)
        trial = TrialResult(recording, figures, tuple(check(figures, scenario.expectations)))
        write_folder(options.out, trial, scenario.text)
    return trial


def _record(stage: TrialStage, options: TrialOptions, show: TerminalProgress) -> TrialRecording:
    began = time.monotonic()
    with ExitStack() as stack:
        fleet = _fleet(stage, options.processes)
        stack.callback(fleet.end)
        show.stage("starting server, simulator and agents")
        fleet.start()
        started = time.monotonic()
        wanted = FilmingOptions(options.film_every or 1.0, bool(options.film_every), options.view, show.say)
        camera = stack.enter_context(filming(stage, wanted, fleet, options.out))

        def look(runner: ScenarioRunner) -> None:
            show.look(runner)
            camera(runner)

        runner = ScenarioRunner(stage, fleet, look, options.film_every or 1.0)
        stack.callback(runner.reports.close)
        runner.run()
        ran = time.monotonic() - started
        show.stage("asking for the merged map and the truth")
        merged = runner.merged()
        status, control = fleet.control.status(), fleet.control
        truth = {robot: TrialTrajectory(*control.trajectory(robot)) for robot in stage.robots}
        runner.agents = runner.reports.agents(stage.robots)
        plan, wall = control.plan(), fleet.wall()
        reports = runner.reports
        fleet.end()
    disks = read_disks(stage.agents, stage.store, stage.robots)
    robots = {
        robot: RobotRecord(
            truth=truth[robot],
            estimates=reports.estimates(robot),
            collisions=status.robots[robot].collisions,
            map_bytes=disks[robot].map_bytes,
            wire_bytes=reports.traffic(robot),
            unsaved=disks[robot].unsaved,
            map_hash=disks[robot].map_hash,
        )
        for robot in stage.robots
    }
    return TrialRecording(
        scenario=stage.scenario.name,
        seed=stage.seed,
        robots=robots,
        plan=plan,
        merged=merged,
        lost=tuple(runner.lost),
        photographed=runner.photographed,
        lies=runner.lies,
        moments=tuple(runner.moments),
        recoveries_s=tuple(runner.recoveries_s),
        sim_s=status.stamp_ns / 1e9,
        wall_s=ran,
        wall={**wall, "starting": started - began, "whole": time.monotonic() - began},
    )


def _fleet(stage: TrialStage, processes: bool) -> TrialFleet:
    if processes:
        from mapweave.scenarios.process_fleet import ProcessFleet

        return ProcessFleet(stage)
    from mapweave.scenarios.local_fleet import LocalFleet

    return LocalFleet(stage)


def _make_room(out: Path) -> None:
    """Take away what an earlier trial left in the folder, and nothing else.

    Raises:
        SettingsError: there are folders that no trial has made.
    """
    out.mkdir(parents=True, exist_ok=True)
    taken = [name for name in FOLDERS if (out / name).exists()]
    if taken and not (out / OWN).is_file():
        raise SettingsError(f"{out / taken[0]}: was made by no earlier trial; choose another --out")
    for name in taken:
        shutil.rmtree(out / name)
    for pattern in FILES:
        for old in out.glob(pattern):
            old.unlink()
    (out / OWN).write_text("A trial made the files in this folder; the next trial removes them.\n")
