"""Many trials of one scenario, one after the other."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

from mapweave.agent.settings import AgentSettings
from mapweave.hybridmap.errors import MapweaveError, SettingsError
from mapweave.scenarios.batch_table import Attempt, batch_json, batch_table
from mapweave.scenarios.run import TrialOptions, run_trial
from mapweave.scenarios.scenario import Scenario
from mapweave.terminal import Bar, plain_or_terminal

MOST_SEEDS = 10_000


@dataclass(frozen=True)
class BatchOptions:
    """How a batch is run.

    Attributes:
        first: the first seed; the others follow it.
        seeds: how many.
        out: folder; each trial has one of its own in it.
        processes: see TrialOptions.
        settings: of every robot's pipeline.
        settings_file: where they came from, if from a file.
        film: make a film of each trial.
        json: print one JSON object instead of a table.
    """

    first: int
    seeds: int
    out: Path
    processes: bool = True
    settings: AgentSettings = field(default_factory=AgentSettings)
    settings_file: Path | None = None
    film: bool = False
    json: bool = False

    def __post_init__(self) -> None:
        """Refuse what cannot be run (SettingsError)."""
        if not 1 <= self.seeds <= MOST_SEEDS:
            raise SettingsError(f"--seeds {self.seeds}: use 1 to {MOST_SEEDS}")


def run_batch_of_trials(scenario: Scenario, options: BatchOptions) -> bool:
    """Run all trials; one that cannot be run is a failure of its seed, not of the batch.

    Returns:
        Whether every trial ran to its end and met its expectations.
    """
    console = plain_or_terminal()
    attempts: list[Attempt] = []
    with Bar(console, scenario.name, options.seeds) as bar:
        for seed in range(options.first, options.first + options.seeds):
            bar.update(seed - options.first, f"seed {seed}")
            attempts.append(_attempt(scenario, options, seed))
            failed = [failed_attempt for failed_attempt in attempts if not failed_attempt.passed]
            if attempts[-1] in failed:
                for line in attempts[-1].complaints:
                    console.print(f"seed {seed}: {line}", highlight=False)
            bar.advance(1, f"{len(failed)} failed")
    summary = batch_json(attempts)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "batch.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    if options.json:
        print(json.dumps(summary))
    else:
        plain_or_terminal(stderr=False).print(batch_table(attempts, scenario.name))
    return all(attempt.passed for attempt in attempts)


def _attempt(scenario: Scenario, options: BatchOptions, seed: int) -> Attempt:
    try:
        trial = run_trial(
            scenario,
            TrialOptions(
                seed=seed,
                out=options.out / f"seed-{seed}",
                processes=options.processes,
                settings=options.settings,
                settings_file=options.settings_file,
                film_every=1.0 if options.film else 0.0,
                quiet=True,
            ),
        )
    except MapweaveError as error:
        return Attempt(seed, failure=str(error))
    return Attempt(seed, trial.figures, trial.verdicts)
