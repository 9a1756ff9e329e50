"""A drive through the simulated office, kept as the messages of a robot's base, and played again."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import msgpack

from mapweave.agent.drivers.messages import (
    decode_description,
    decode_observation,
    encode_description,
    encode_observation,
)
from mapweave.agent.mission import Explore
from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.agent.settings import AgentSettings
from mapweave.hybridmap.ids import MapId

NAME = "r0"


def render(path: Path, seed: int, ticks: int) -> None:
    """Let a robot explore the simulated office, and write what it senses to a file."""
    from mapweave.agent.pipeline import Pipeline
    from mapweave.sim.simulation import Simulation
    from mapweave.sim.worlds.catalog import make_world

    with path.open("wb") as file, Simulation(make_world("office", seed), [NAME], seed) as simulation:
        description = simulation.describe(NAME)
        pipeline = Pipeline(MapId(NAME, 1), description, replace(AgentSettings(), seed=seed))
        pipeline.set_mission(Explore())
        file.write(msgpack.packb(encode_description(description)))
        command = Command()
        for _ in range(ticks):
            observation = simulation.step({NAME: command})[NAME]
            file.write(msgpack.packb(encode_observation(observation)))
            command = pipeline.step(observation).command


class RenderedDrive:
    """The Robot protocol over a drive in a file. It goes the way that it went, whatever is commanded."""

    def __init__(self, path: Path) -> None:
        """Open the file."""
        self._file = path.open("rb")
        self._messages: Iterator[bytes] = iter(msgpack.Unpacker(self._file, max_buffer_size=0))
        self._description = decode_description(next(self._messages))

    def describe(self) -> RobotDescription:
        """The simulated robot."""
        return self._description

    def sense(self) -> Observation | None:
        """The next observation; None at the end."""
        data = next(self._messages, None)
        return None if data is None else decode_observation(data)

    def act(self, command: Command) -> Command:
        """Nothing."""
        return command

    def close(self) -> None:
        """Close the file."""
        self._file.close()
