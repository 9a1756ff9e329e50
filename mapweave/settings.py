"""Settings: TOML into the parts' own dataclasses. Defaults work; a wrong name or value says so at once."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapweave.agent.drivers.settings import RobotSettings
from mapweave.agent.pipeline import PipelineSettings
from mapweave.mapserver.admission_control import AdmissionSettings
from mapweave.storage.settings_file import build, read_toml

if TYPE_CHECKING:
    from mapweave.merge.merging import MergeSettings


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
        robot: driver, camera and geometry of an agent's robot.
        pipeline: of an agent.
        desk: how a map server shares out the questions that take long.
        merge: how maps are merged, as it stands in the file; see `merge_settings`.
    """

    network: NetworkSettings = dataclasses.field(default_factory=NetworkSettings)
    robot: RobotSettings = dataclasses.field(default_factory=RobotSettings)
    pipeline: PipelineSettings = dataclasses.field(default_factory=PipelineSettings)
    desk: AdmissionSettings = dataclasses.field(default_factory=AdmissionSettings)
    merge: Mapping[str, Any] = dataclasses.field(default_factory=dict)


def load_settings(path: Path | None) -> Settings:
    """Read a TOML file over the defaults; None gives the defaults.

    Raises:
        SettingsError: the file is missing, is not TOML, or names or values are wrong.
    """
    if path is None:
        return Settings()
    return build(Settings, read_toml(path), str(path))


def merge_settings(settings: Settings, path: Path | None) -> MergeSettings:
    """How maps are merged, for those who merge them: a robot has none of the libraries that this needs.

    Args:
        settings: read from the file.
        path: of the file; for the error's text.

    Raises:
        SettingsError: names or values are wrong.
    """
    from mapweave.merge.merging import MergeSettings

    return build(MergeSettings, settings.merge, f"{path}: merge")
