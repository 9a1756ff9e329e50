"""Settings: a TOML file into the parts' own dataclasses. Defaults work; errors in one line."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mapweave.agent.drivers.settings import RobotSettings
from mapweave.agent.recordings.options import RecordingSettings
from mapweave.agent.settings import AgentSettings
from mapweave.hybridmap.errors import InvalidValue, SettingsError
from mapweave.mapserver.admission_control import AdmissionSettings
from mapweave.mapserver.attendance import AttendanceSettings
from mapweave.mapserver.cluster.settings import ClusterSettings
from mapweave.mapserver.quotas import QuotaSettings
from mapweave.merge.settings import MergeSettings
from mapweave.storage.settings_file import build, read_toml


@dataclass(frozen=True)
class NetworkSettings:
    """How to reach the fleet.

    Attributes:
        fleet: name that robots, server and simulator share.
        endpoints: Zenoh endpoints of routers, tried in order; when one fails a robot goes on with the next.
            A server or router listens at all of them.
        routers: of a router: the endpoint of another one that it joins. Of a server: likewise if `endpoints`
            are given, where it listens; else endpoints of routers, tried in order, of which it is a client.
        server: name of the map server that must have a change before the agent may forget it.
        keys: key file of this robot or person; for a server or router the folder of `mapweave keys init`.
    """

    fleet: str = "demo"
    endpoints: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    routers: tuple[str, ...] = ()
    server: str = "s0"
    keys: str = ""


@dataclass(frozen=True)
class Settings:
    """All settings of a process; each role reads what it needs.

    Attributes:
        network: how to reach the fleet.
        robot: driver, camera and geometry of an agent's robot.
        recording: which topics of a bag are the robot's.
        agent: of a robot's program.
        admission_control: how a map server shares out the questions that take long.
        quotas: what a map server takes of one robot at most.
        attendance: what robots do once no operator is there.
        merge: how maps are merged.
        cluster: of machines that help a map server.
    """

    network: NetworkSettings = field(default_factory=NetworkSettings)
    robot: RobotSettings = field(default_factory=RobotSettings)
    recording: RecordingSettings = field(default_factory=RecordingSettings)
    agent: AgentSettings = field(default_factory=AgentSettings)
    admission_control: AdmissionSettings = field(default_factory=AdmissionSettings)
    quotas: QuotaSettings = field(default_factory=QuotaSettings)
    attendance: AttendanceSettings = field(default_factory=AttendanceSettings)
    merge: MergeSettings = field(default_factory=MergeSettings)
    cluster: ClusterSettings = field(default_factory=ClusterSettings)


def load_settings(path: Path | None) -> Settings:
    """Read a TOML file over the defaults; None gives the defaults.

    Raises:
        SettingsError: the file is missing, is not TOML, or names or values are wrong.
    """
    return Settings() if path is None else settings_from(read_toml(path), str(path))


def settings_from(table: Mapping[str, Any], where: str) -> Settings:
    """Read a table over the defaults.

    Args:
        table: as TOML gives it.
        where: for the error's text.

    Raises:
        SettingsError: names or values are wrong.
    """
    try:
        return build(Settings, table, where)
    except InvalidValue as error:
        raise SettingsError(f"{where}: {error}") from None
