"""Lookup of drivers: built-in ones, those of other packages, and classes in files.

A driver is a class that takes `RobotSettings` and has the methods of `Robot`. Other packages add drivers by
entry points:

    [project.entry-points."mapweave.robots"]
    rover = "my_package.rover:Rover"
"""

import difflib
import importlib
import importlib.util
import inspect
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path

from mapweave.agent.drivers.author_errors import driver_error
from mapweave.agent.drivers.robot import Robot
from mapweave.agent.drivers.settings import REMOTE, RobotSettings
from mapweave.hybridmap.errors import DeviceError, MapweaveError, SettingsError

GROUP = "mapweave.robots"
"""Group of the entry points of other packages."""

SHIPPED: Mapping[str, str] = {
    "arduino": "mapweave.agent.drivers.arduino:Arduino",
    "create": "mapweave.agent.drivers.create:Create",
    "koala": "mapweave.agent.drivers.koala:Koala",
    REMOTE: "mapweave.agent.drivers.remote:RemoteRobot",
    "ros2": "mapweave.agent.drivers.ros2:Ros2",
    "waveshare": "mapweave.agent.drivers.waveshare:Waveshare",
}
"""Drivers of this package; available without installed metadata."""

Driver = Callable[[RobotSettings], Robot]

METHODS = ("describe", "sense", "act", "close")


@dataclass(frozen=True)
class Listed:
    """A driver as listed by `mapweave robots`.

    Attributes:
        name: name in the settings.
        line: one-line description; empty if the driver cannot be loaded.
        missing: missing module; empty if none.
        error: other reason why the driver cannot be loaded.
    """

    name: str
    line: str = ""
    missing: str = ""
    error: str = ""


def drivers() -> Mapping[str, str]:
    """`module:Class` of every driver by name. Built-in drivers cannot be replaced by other packages."""
    found = {point.name: point.value for point in entry_points(group=GROUP)}
    return dict(sorted({**found, **SHIPPED}.items()))


def listing() -> list[Listed]:
    """All drivers by name, including those that cannot be loaded."""
    listed = []
    for name, target in drivers().items():
        try:
            words = inspect.getdoc(_imported(target)) or ""
            listed.append(Listed(name, words.split("\n")[0].rstrip(".")))
        except ModuleNotFoundError as error:
            listed.append(Listed(name, missing=error.name or ""))
        except Exception as error:  # noqa: BLE001 - code of another package
            listed.append(Listed(name, error=f"{type(error).__name__}: {error}"))
    return listed


def find_driver(name: str) -> Driver:
    """Find a driver by name, or by `FILE.py:CLASS`.

    Returns:
        What opens it; raises DeviceError with the file and line of a constructor that fails.

    Raises:
        SettingsError: no driver has this name.
        DeviceError: the file or the class is not usable.
        ModuleNotFoundError: a library of a driver of this package is not installed.
    """
    path, colon, class_name = name.rpartition(":")
    if colon and path.endswith(".py"):
        return _driver(_of_file(Path(path), class_name), name)
    known = drivers()
    if name not in known and name.endswith(".toml"):
        raise SettingsError(f"{name} is no driver; settings, which name one, are given by --settings {name}")
    if name not in known and name.endswith(".py"):
        raise SettingsError(f"{name} is no driver without its class: {name}:CLASS")
    if name not in known:
        close = difflib.get_close_matches(name, known, 1)
        hint = f"did you mean {close[0]!r}?" if close else f"there are {', '.join(known)}."
        raise SettingsError(f"no driver {name!r}; {hint} Your own is FILE.py:CLASS")
    try:
        return _driver(_imported(known[name]), name)
    except ModuleNotFoundError as error:
        if name in SHIPPED:
            raise
        raise DeviceError(f"driver {name}: needs the library {error.name}, which is not installed") from error
    except MapweaveError:
        raise
    except Exception as error:
        words = " ".join(str(error).split())
        raise DeviceError(f"driver {name} cannot be loaded: {type(error).__name__}: {words}") from error


def _imported(target: str) -> object:
    module, _, name = target.partition(":")
    return getattr(importlib.import_module(module), name)


def _of_file(path: Path, name: str) -> object:
    if not path.is_file():
        raise DeviceError(f"{path}: no such file; --robot takes FILE.py:CLASS")
    spec = importlib.util.spec_from_file_location(f"mapweave_robot_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Where dataclasses, and those that read type hints, look for the module of a class.
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    except MapweaveError:
        raise
    except Exception as error:
        line = error.lineno if isinstance(error, SyntaxError) else _last_line(error, path)
        raise DeviceError(f"{path}, line {line}: {type(error).__name__}: {error}") from error
    if not hasattr(module, name):
        classes = [
            n for n, v in vars(module).items() if isinstance(v, type) and v.__module__ == module.__name__
        ]
        raise DeviceError(f"{path}: no class {name!r}; there are {', '.join(classes) or 'none'}")
    return getattr(module, name)


def _last_line(error: Exception, path: Path) -> int:
    """Line of the file where the error was raised; 0 if none."""
    line, trace = 0, error.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code.co_filename == str(path):
            line = trace.tb_lineno
        trace = trace.tb_next
    return line


def _driver(found: object, name: str) -> Driver:
    lacking = [m for m in METHODS if not callable(getattr(found, m, None))]
    if not isinstance(found, type) or lacking:
        raise DeviceError(
            f"driver {name}: needs a class with {', '.join(METHODS)}; lacks {', '.join(lacking)}"
        )

    def opened(settings: RobotSettings) -> Robot:
        try:
            inspect.signature(found).bind(settings)
        except TypeError:
            raise DeviceError(f"driver {name}: __init__ must take one argument, the settings") from None
        except ValueError:
            pass  # a class of a compiled library may tell no signature
        try:
            robot: Robot = found(settings)
        except MapweaveError:
            raise
        except Exception as error:
            raise driver_error(error) from error
        _check_opened(robot, name)
        return robot

    return opened


def _check_opened(robot: Robot, name: str) -> None:
    """Refuse a subclass of `WheeledRobot` that has not called its constructor: every method would fail."""
    # Late: this module also lists drivers where OpenCV is missing.
    from mapweave.agent.drivers.wheeled import WheeledRobot

    if isinstance(robot, WheeledRobot) and not robot.initialized:
        raise DeviceError(
            f"driver {name}: __init__ must call super().__init__(base, settings) of WheeledRobot"
        )
