"""The demo: the scenario `demo` in processes, with a report of its own."""

import json
import shutil
from typing import Any

from mapweave.demo.report import report_of
from mapweave.scenarios.run import TrialOptions, run_trial
from mapweave.scenarios.scenario import load_scenario, scenario_path


def run_demo(options: TrialOptions, robots: int = 3, rooms: int = 3) -> dict[str, Any]:
    """Run everything; leave report, picture, film and maps in the output folder.

    Args:
        options: of the trial.
        robots: how many map; the first is kidnapped.
        rooms: along the corridor.

    Returns:
        The report, also when the robot did not arrive: `notes` lists what was missed.

    Raises:
        MapweaveError: something could not be started, or ended.
    """
    overrides = (f"robots={robots}", f"world.rooms={rooms}")
    trial = run_trial(load_scenario(scenario_path("demo"), overrides), options)
    report = report_of(trial)
    for own in (options.out / "agents").glob("*.mapweave"):
        shutil.copyfile(own, options.out / own.name)
    text = json.dumps(report, indent=2) + "\n"
    (options.out / "report.json").write_text(text, encoding="utf-8")
    return report
