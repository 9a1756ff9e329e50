"""The logs for Foxglove and for Rerun of the robots of a trial."""

from importlib.util import find_spec

import pytest

from mapweave.agent.settings import AgentSettings
from mapweave.scenarios.fleet import TrialStage
from mapweave.scenarios.scenario import load_scenario, scenario_path
from tests.mapweave.log_readers import read, rows_of
from tests.simulator import needs_simulator


@needs_simulator
@pytest.mark.skipif(find_spec("rerun") is None, reason='needs the extra "rerun"')
def test_each_robot_of_a_trial_has_logs_and_one_that_is_started_again_others(tmp_path):
    from mapweave.scenarios.local_fleet import LocalFleet

    scenario = load_scenario(scenario_path("office"), ["robots=2", "world.rooms=3"])
    fleet = LocalFleet(TrialStage(scenario, 1, tmp_path, AgentSettings(), rerun=True, mcap_log=True))
    fleet.start()
    fleet.advance(6)
    fleet.kill_agent("r0")
    fleet.start_agent("r0")
    fleet.advance(10)
    fleet.end()
    names = ("r0.1", "r0.2", "r1.1")
    for folder in ("mcap", "rerun"):
        assert sorted(path.name.removesuffix(".rrd") for path in (tmp_path / folder).iterdir()) == sorted(
            names
        )
    for_foxglove = [len(read(tmp_path / "mcap" / name)["/status"]) for name in names]
    for_rerun = [len(rows_of(tmp_path / "rerun" / f"{name}.rrd")[f"/{name[:2]}/now:text"]) for name in names]
    assert for_foxglove == for_rerun and for_rerun[0] + for_rerun[1] == for_rerun[2] == 10
