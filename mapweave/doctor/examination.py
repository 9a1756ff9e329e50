"""The examination: what is examined in which order. What comes first makes what comes later possible."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mapweave.doctor import camera, camera_model, driver, learned, libraries, machine, server
from mapweave.doctor.finding import Finding, good, skipped, wrong

if TYPE_CHECKING:
    from mapweave.agent.drivers.robot import Robot
    from mapweave.settings import NetworkSettings, Settings


@dataclass(frozen=True)
class ExaminationOptions:
    """What is examined, and how.

    Attributes:
        load: reads the settings; raises MapweaveError.
        network: where the fleet is, by the settings.
        open_robot: opens the robot of the settings, or None if they name none; raises MapweaveError.
        data: folder of the map.
        drives: whether the robot may drive by itself.
        offline: whether the server is left out.
        ask: asks a person to do something.
    """

    load: Callable[[], Settings]
    network: Callable[[Settings], NetworkSettings]
    open_robot: Callable[[Settings], Callable[[], Robot] | None]
    data: Path
    drives: bool
    offline: bool
    ask: Callable[[str], bool]


def examine(options: ExaminationOptions) -> Iterator[Finding]:
    """All findings, in order."""
    yield from libraries.examine()
    yield from machine.clock()
    yield from machine.disk(options.data)
    yield from guarded(learned.SUBJECT, lambda: learned.examine(options.data))
    settings: list[Settings] = []
    yield from guarded("settings", lambda: _settings(options, settings))
    if not settings:
        return
    yield from guarded("camera", lambda: _camera(settings[0]))
    yield from guarded("driver", lambda: _driver(options, settings[0]))
    if options.offline:
        yield skipped(server.SUBJECT, "left out")
    else:
        yield from guarded(server.SUBJECT, lambda: server.examine(options.network(settings[0])))


def guarded(subject: str, check: Callable[[], Iterator[Finding]]) -> Iterator[Finding]:
    """What a check finds; an error that ends it is a finding, too."""
    from mapweave.hybridmap.errors import MapweaveError

    try:
        yield from check()
    except ModuleNotFoundError as error:
        yield skipped(subject, f"cannot be examined without the library {error.name}")
    except MapweaveError as error:
        yield wrong(subject, str(error), "see docs/robot.md")
    except Exception as error:  # noqa: BLE001 - the other checks shall still run
        words = " ".join(str(error).split())
        yield wrong(subject, f"{type(error).__name__}: {words}", "please report this error")


def _settings(options: ExaminationOptions, out: list[Settings]) -> Iterator[Finding]:
    out.append(options.load())
    robot = out[0].robot
    yield good("settings", f"driver {robot.driver}, {'a' if robot.camera else 'no'} camera")


def _camera(settings: Settings) -> Iterator[Finding]:
    declared = settings.robot.camera
    if declared is None:
        yield skipped("camera", "the settings have no [robot.camera]; images come from the driver, if any")
        return
    from mapweave.agent.observation import RobotDescription

    yield from camera_model.examine(RobotDescription(*declared.optics))
    yield from camera.examine(declared)


def _driver(options: ExaminationOptions, settings: Settings) -> Iterator[Finding]:
    open_robot = options.open_robot(settings)
    if open_robot is None:
        yield skipped("driver", "no robot is given", "mapweave doctor --robot robot.toml")
        return
    yield from driver.examine(open_robot, settings.robot.camera is not None, options.drives, options.ask)
