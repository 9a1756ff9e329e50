"""How long the processes of a trial may take to come up."""

import logging
from collections.abc import Sequence
from types import SimpleNamespace

import pytest

from mapweave.agent.settings import AgentSettings
from mapweave.hybridmap.errors import MapweaveError
from mapweave.scenarios import process_fleet
from mapweave.scenarios.fleet import TrialStage
from mapweave.scenarios.process_fleet import ProcessFleet
from mapweave.scenarios.scenario import load_scenario, scenario_path


class Slow:
    """Processes that run; the robots ask for their first step after so many looks."""

    def __init__(self, looks: int) -> None:
        self.looks, self.started = looks, list[str]()

    def start(self, name: str, arguments: Sequence[str]) -> None:
        self.started.append(name)

    def check(self) -> None:
        pass

    def status(self) -> SimpleNamespace:
        self.looks -= bool({"r0", "r1"} <= {*self.started})
        robot = SimpleNamespace(active=self.looks <= 0)
        return SimpleNamespace(tick=0, robots={"r0": robot, "r1": robot})


@pytest.mark.parametrize("looks", [2, 20])
def test_first_agents_may_compile_for_longer_than_others_take(tmp_path, monkeypatch, caplog, looks: int):
    """On a busy computer the first run ended after a minute, without a word until then."""
    fleet = ProcessFleet(
        TrialStage(load_scenario(scenario_path("agent-killed")), 1, tmp_path, AgentSettings())
    )
    fleet.end()
    slow = Slow(looks)
    connected = SimpleNamespace(connected=lambda: True)
    for name, part in (("_children", slow), ("control", slow), ("bus", connected), ("_sim_bus", connected)):
        monkeypatch.setattr(fleet, name, part)
    monkeypatch.setattr(process_fleet, "PATIENCE", 0.1)
    monkeypatch.setattr(process_fleet, "COMPILING", 10.0)
    monkeypatch.setattr(process_fleet, "SAY_EVERY", 0.15)
    with caplog.at_level(logging.WARNING):
        fleet.start()
    assert {*slow.started} >= {"server", "sim", "r0", "r1"}
    said = "\n".join(caplog.messages)
    assert ("an agent does not come up yet: waiting for" in said) is (looks == 20)
    slow.looks = 1000
    with pytest.raises(MapweaveError, match=r"agent r1 does not come up \(waited 0 s; see .*logs\)"):
        fleet.start_agent("r1")
