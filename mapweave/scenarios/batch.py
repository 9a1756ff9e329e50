"""Many trials of one scenario, one after the other."""

import json
from dataclasses import dataclass, replace

from mapweave.hybridmap.errors import MapweaveError, SettingsError
from mapweave.scenarios.batch_table import Attempt, batch_json, batch_table
from mapweave.scenarios.run import TrialOptions, run_trial
from mapweave.scenarios.scenario import Scenario
from mapweave.terminal import Bar, plain_or_terminal

MOST_SEEDS = 10_000
"""Of one batch. Chosen: more is a slip of the pen."""


@dataclass(frozen=True)
class BatchOptions:
    """How a batch is run.

    Attributes:
        first: the first trial; the seeds of the others follow its own. Each has a folder of its own in `out`.
        seeds: how many.
        json: print one JSON object instead of a table.
    """

    first: TrialOptions
    seeds: int
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
    first, out = options.first.seed, options.first.out
    with Bar(console, scenario.name, options.seeds) as bar:
        for seed in range(first, first + options.seeds):
            bar.update(seed - first, f"seed {seed}")
            attempts.append(_attempt(scenario, options.first, seed))
            failed = [failed_attempt for failed_attempt in attempts if not failed_attempt.passed]
            if attempts[-1] in failed:
                for line in attempts[-1].complaints:
                    console.print(f"seed {seed}: {line}", highlight=False)
            bar.advance(1, f"{len(failed)} failed")
    summary = batch_json(attempts)
    out.mkdir(parents=True, exist_ok=True)
    (out / "batch.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    if options.json:
        print(json.dumps(summary))
    else:
        plain_or_terminal(stderr=False).print(batch_table(attempts, scenario.name))
    return all(attempt.passed for attempt in attempts)


def _attempt(scenario: Scenario, first: TrialOptions, seed: int) -> Attempt:
    try:
        trial = run_trial(scenario, replace(first, seed=seed, out=first.out / f"seed-{seed}", quiet=True))
    except MapweaveError as error:
        return Attempt(seed, failure=str(error))
    return Attempt(seed, trial.figures, trial.verdicts)
