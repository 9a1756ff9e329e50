"""The library's examples, and the environment by Gymnasium's own rules."""

import builtins
import importlib
import math
import runpy
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from mapweave.hybridmap.errors import InvalidValue, SettingsError
from mapweave.hybridmap.pose import Pose2, wrap_angle
from mapweave.sim.gym import MapweaveEnv
from tests.quick import first_quick

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.mark.parametrize("name", first_quick(["ten_lines", "gym_random"], 1))
def test_examples_run(name: str, capsys):
    runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    assert len(capsys.readouterr().out.splitlines()) >= 3


def test_ten_lines_are_ten():
    """Code lines, imports included."""
    lines = (EXAMPLES / "ten_lines.py").read_text().splitlines()[1:]
    assert sum(bool(line.strip()) for line in lines) <= 10


@pytest.mark.slow
def test_gymnasium_accepts_the_environment(opened):
    """Spaces, seeds, types, rendering."""
    env = opened(gymnasium.make("mapweave.sim.gym:mapweave/Park-v0", seconds=5.0, render_mode="rgb_array"))
    check_env(env.unwrapped)


def drive(env: MapweaveEnv, info: dict) -> tuple[float, dict, bool]:
    """Park by the truth: turn to the goal, drive, turn to its heading."""
    total, over, success = 0.0, False, False
    while not over:
        robot, goal = (Pose2.from_vector(info[k]) for k in ("world_from_robot", "world_from_goal"))
        off = robot.inverse() @ goal
        bearing = math.atan2(off.y, off.x)
        if math.hypot(off.x, off.y) < 0.03:
            action = [0.0, 1.5 * off.heading]
        elif abs(bearing) > 0.15:
            action = [0.0, 1.5 * bearing]
        else:
            action = [min(0.3, 0.8 * off.x), 1.5 * bearing]
        _, reward, success, truncated, info = env.step(np.array(action, np.float32))
        total += reward
        over = success or truncated
    return total, info, success


@pytest.mark.slow
def test_parking_succeeds_and_pays():
    """A driver who knows the truth parks, in other worlds for other seeds; who stands still is truncated."""
    env = MapweaveEnv()
    goals = []
    for seed in range(3):
        _, info = env.reset(seed=seed)
        goals.append(tuple(info["world_from_goal"]))
        begin = info["distance"]
        total, info, success = drive(env, info)
        assert success
        assert info["success"]
        assert info["distance"] < 0.05
        assert abs(info["angle"]) < math.radians(3)
        assert total > 5.0 + 0.8 * begin - 1.2
    assert len(set(goals)) == 3
    env = MapweaveEnv(seconds=1.0)
    env.reset(seed=0)
    outcomes = [env.step(np.zeros(2, np.float32))[1:4] for _ in range(10)]
    assert [truncated for _, _, truncated in outcomes] == [False] * 9 + [True]
    assert not any(success for _, success, _ in outcomes)
    assert sum(reward for reward, _, _ in outcomes) < 0.1
    env.close()


def test_the_goal_is_given_in_the_frame_of_the_start():
    env = MapweaveEnv()
    seen, info = env.reset(seed=4)
    start = Pose2.from_vector(info["world_from_robot"])
    goal = Pose2.from_vector(info["world_from_goal"])
    result = start @ Pose2.from_vector(seen["goal"].astype(float))
    assert result.distance(goal) < 1e-3
    assert abs(wrap_angle(result.heading - goal.heading)) < 1e-3
    env.close()
    with pytest.raises(InvalidValue, match="reset"):
        env.step(np.zeros(2, np.float32))


def test_without_gymnasium_one_line_names_the_package(monkeypatch):
    real = builtins.__import__

    def without(name: str, *rest, **more):
        if name.split(".")[0] == "gymnasium":
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.delitem(sys.modules, "mapweave.sim.gym")
    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(SettingsError, match=r"pip install 'mapweave\[gym\]'"):
        importlib.import_module("mapweave.sim.gym")
