"""Settings: TOML into the parts' own dataclasses. Defaults work; a wrong name or value says so at once."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from agent.pipeline import PipelineSettings
from mapserver.desk import DeskSettings
from wire.tables import build, read_toml


@dataclasses.dataclass(frozen=True)
class NetworkSettings:
    """How to reach the fleet.

    Attributes:
        fleet: name that robots, server and simulator share.
        endpoints: Zenoh endpoints of the router, tried in order.
        server: name of the map server that must have a change before the agent may forget it.
    """

    fleet: str = "demo"
    endpoints: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    server: str = "s0"


@dataclasses.dataclass(frozen=True)
class Settings:
    """All settings of a process; each role reads what it needs.

    Attributes:
        network: how to reach the fleet.
        pipeline: of an agent.
        desk: how a map server shares out the questions that take long.
    """

    network: NetworkSettings = dataclasses.field(default_factory=NetworkSettings)
    pipeline: PipelineSettings = dataclasses.field(default_factory=PipelineSettings)
    desk: DeskSettings = dataclasses.field(default_factory=DeskSettings)


def load_settings(path: Path | None) -> Settings:
    """Read a TOML file over the defaults; None gives the defaults.

    Raises:
        SettingsError: the file is missing, is not TOML, or names or values are wrong.
    """
    if path is None:
        return Settings()
    return build(Settings, read_toml(path), str(path))
