"""The scenarios that come with Mapweave, with a seed that nothing was developed with, in real processes."""

import pytest

from mapweave.scenarios.run import TrialOptions, run_trial
from mapweave.scenarios.scenario import load_scenario, scenario_names, scenario_path

SEED = 77
LONG = {"one-liar": 3000}
"""Seconds that some may take: each lie is merged, and once more after a restart."""


@pytest.mark.scenario
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.timeout(LONG.get(name, 500)))
        for name in scenario_names()
        if name != "demo"
    ],
)
def test_scenario(name, tmp_path):
    options = TrialOptions(seed=SEED, out=tmp_path / "out", quiet=True)
    trial = run_trial(load_scenario(scenario_path(name)), options)
    complaints = [str(verdict) for verdict in trial.verdicts if not verdict.good]
    print(name, trial.figures.as_dict())
    assert complaints == [], [f"{m.stamp_ns / 1e9:.0f} s: {m.text}" for m in trial.recording.moments]
    assert (tmp_path / "out" / "film.webm").stat().st_size > 10_000
