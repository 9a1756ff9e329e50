"""The demo: the scenario `demo` in processes, with a report of its own."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from mapweave.demo.options import DemoOptions
from mapweave.demo.report import Report
from mapweave.scenarios.run import TrialOptions, run_trial
from mapweave.scenarios.scenario import load_scenario, scenario_path


def run_demo(options: DemoOptions) -> Report:
    """Run everything; leave report, picture, film and maps in the output folder.

    Returns:
        The report, also when the robot did not arrive: `notes` lists what was missed.

    Raises:
        MapweaveError: something could not be started, or ended.
    """
    overrides = (f"robots={options.robots}", f"world.rooms={options.rooms}")
    scenario = load_scenario(scenario_path("demo"), overrides)
    trial = run_trial(
        scenario,
        TrialOptions(seed=options.seed, out=options.out, quiet=options.quiet, film_every=options.film_every),
    )
    report = Report.of(trial)
    for own in (options.out / "agents").glob("*.mapweave"):
        shutil.copyfile(own, options.out / own.name)
    write_report(options.out, report)
    return report


def write_report(out: Path, report: Report) -> None:
    """Write `report.json`."""
    (out / "report.json").write_text(json.dumps(report.as_dict(), indent=2) + "\n", encoding="utf-8")
