"""Scenario files: what is said is meant, and what is wrong is said in one line."""

import tomllib
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.errors import SettingsError
from mapweave.scenarios import actions
from mapweave.scenarios.scenario import load_scenario, scenario_names, scenario_path
from mapweave.sim import events

GOOD = """
name = "try"
robots = 2
[world]
kind = "office"
[[events]]
at = 5.0
do = "cut"
robot = "r1"
[[events]]
plus = 3.0
do = "light"
factor = 0.5
[[events]]
after = "joined"
within = 60.0
do = "wait"
[expect]
components = 1
"""


def load(tmp_path: Path, text: str, overrides=()):
    path = tmp_path / "try.toml"
    path.write_text(text, encoding="utf-8")
    return load_scenario(path, overrides)


def refused(tmp_path: Path, text: str, overrides=()) -> str:
    with pytest.raises(SettingsError) as error:
        load(tmp_path, text, overrides)
    output = str(error.value)
    assert "\n" not in output
    return output


def test_a_file_is_parsed_as_written(tmp_path):
    scenario = load(tmp_path, GOOD)
    assert [robot.name for robot in scenario.robots] == ["r0", "r1"]
    assert scenario.missions == {"r0": "explore", "r1": "explore"}
    cut, light, wait = scenario.events
    assert cut.action == actions.Cut("r1")
    assert (cut.when.at, cut.when.after) == (5.0, "")
    assert light.action == events.Light(0.5)
    assert light.when.plus == 3.0
    assert wait.action == actions.Wait()
    assert (wait.when.after, wait.when.within) == ("joined", 60.0)
    assert str(scenario.expectations[0]) == "1"


def test_overrides_lie_over_the_file_and_are_noted(tmp_path):
    scenario = load(tmp_path, GOOD, ["robots=4", "world.rooms = 5", "name=other", "expect.components=2"])
    assert len(scenario.robots) == 4
    assert scenario.world_table == {"kind": "office", "rooms": 5}
    assert scenario.name == "other"
    assert str(scenario.expectations[0]) == "2"
    assert scenario.text.startswith("# --set robots=4\n")
    # What was read is still TOML, and says what the file said.
    assert tomllib.loads(scenario.text)["robots"] == 2


def test_robots_of_different_kinds(tmp_path):
    tables = (
        GOOD.replace("robots = 2", "") + '[[robot]]\n[[robot]]\nname="r1"\ncamera="wide"\nmission="idle"\n'
    )
    scenario = load(tmp_path, tables)
    assert [robot.name for robot in scenario.robots] == ["r0", "r1"]
    assert scenario.robots[0].camera != scenario.robots[1].camera
    assert scenario.missions["r1"] == "idle"


@pytest.mark.parametrize(("change", "said"), [
    (("robots = 2", "robots = 0"), "robots must be a whole number, 1 to 16; it is 0"),
    (("robots = 2", "robot = 2"), "robot: expected list, got int; it is 2"),
    (("robots = 2", "robots = 1"), "no robot 'r1'; there are r0"),
    (('kind = "office"', 'kind = "ofice"'), None),
    (('do = "cut"', 'do = "cutt"'), "do = 'cutt'; known are"),
    (('do = "cut"', ""), "do is missing"),
    (('robot = "r1"', 'robott = "r1"'), "did you mean 'robot'"),
    (('robot = "r1"', ""), "robot is missing"),
    (("factor = 0.5", "factor = -1.0"), "factor"),
    (("at = 5.0", "at = -5.0"), "at must be a number, 0 to 86400; it is -5.0"),
    (("at = 5.0", 'at = "soon"'), "at: expected float, got str; it is 'soon'"),
    (('after = "joined"', 'after = "merged"'), "known are joined"),
    (("within = 60.0", ""), "needs within"),
    (("components = 1", "component = 1"), "did you mean 'components'"),
    (('name = "try"', 'title = "try"'), "no setting 'title'"),
    (("[expect]", "[expect"), "try.toml"),
])  # fmt: skip
def test_errors_are_reported_in_one_line(tmp_path, change, said):
    text = GOOD.replace(*change)
    assert text != GOOD
    if said is None:  # a world is built when it is needed
        scenario = load(tmp_path, text)
        with pytest.raises(SettingsError, match="no kind of world 'ofice'"):
            scenario.world(0)
        return
    assert said in refused(tmp_path, text)


@pytest.mark.parametrize("override", ["robots", "=3", "a..b=1", "name.x=1", "robots=many"])
def test_a_wrong_override_is_refused(tmp_path, override):
    assert refused(tmp_path, GOOD, [override])


def test_without_events_a_trial_would_never_end(tmp_path):
    assert "at least one [[events]]" in refused(tmp_path, 'name = "try"')


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=6,
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=80)
@given(
    name=st.sampled_from(["robots", "robot", "world", "events", "expect", "seed", "name", "summary"]),
    value=values,
)
def test_any_file_is_read_or_refused(tmp_path, monkeypatch, name, value):
    path = tmp_path / "try.toml"
    path.write_text(GOOD, encoding="utf-8")
    table = {**tomllib.loads(GOOD), name: value}
    monkeypatch.setattr("mapweave.scenarios.scenario.read_toml", lambda path: table)
    try:
        load_scenario(path)
    except SettingsError as error:
        assert str(error).startswith(str(path))


def test_those_that_come_with_mapweave_can_be_read_and_their_worlds_hold_their_robots():
    names = scenario_names()
    assert len(names) >= 8
    for name in names:
        scenario = load_scenario(scenario_path(name))
        assert scenario.name == name
        assert scenario.summary.endswith(".")
        world = scenario.world(3)
        assert len(world.start_poses(len(scenario.robots), 3)) == len(scenario.robots)


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(
        SettingsError, match=r"no scenario 'offices'; give a \.toml file or one of agent-killed"
    ):
        scenario_path("offices")
