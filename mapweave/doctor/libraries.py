"""Python, the libraries of the base installation with their versions, and the extras."""

import importlib
import platform
import re
import sys
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, requires, version
from importlib.util import find_spec

from mapweave.doctor.finding import Finding, good, skipped, wrong
from mapweave.extras import MODULES, how_to_install, pip

IMPORTED_AS = {"eclipse-zenoh": "zenoh", "opencv-python-headless": "cv2", "pyserial": "serial"}
"""Modules whose names differ from those of their packages."""
OLDEST_PYTHON = (3, 11)
"""As `requires-python` of pyproject.toml."""


def examine() -> Iterator[Finding]:
    """Import every library of the base installation; look for those of the extras."""
    yield _python()
    try:
        yield good("mapweave", f"version {version('mapweave')}")
        needed = [line for line in requires("mapweave") or [] if ";" not in line]
    except PackageNotFoundError:
        yield wrong("mapweave", "is not installed", f"in a checkout: {pip()} install .")
        return
    missing = list(filter(None, map(_fault, needed)))
    if not missing:
        names = (re.split(r"[<>=!~ ]", line)[0] for line in needed)
        yield good("libraries", ", ".join(f"{name} {version(name)}" for name in names))
    yield from missing
    for extra, modules in MODULES.items():
        lacking = [module for module in modules if find_spec(module) is None]
        if lacking:
            yield skipped(
                f"extra {extra}",
                f"not installed ({', '.join(lacking)}); a robot does without",
                how_to_install(extra),
            )
        else:
            yield good(f"extra {extra}", "installed")


def _python() -> Finding:
    words = f"{platform.python_version()} on {platform.machine()}, {platform.system()} {platform.release()}"
    if sys.version_info < OLDEST_PYTHON:
        return wrong("python", words, f"install Python {'.'.join(map(str, OLDEST_PYTHON))} or newer")
    return good("python", words)


def _fault(requirement: str) -> Finding | None:
    """What is wrong with a library, for example `numpy>=2.0`."""
    name, _, least = requirement.partition(">=")
    module = IMPORTED_AS.get(name, name)
    advice = f"{pip()} install --upgrade '{requirement}'"
    try:
        importlib.import_module(module)
        there = version(name)
    except (ModuleNotFoundError, PackageNotFoundError):
        return wrong(f"library {name}", "is not installed", advice)
    except Exception as error:  # noqa: BLE001 - a library for another machine raises anything
        words = " ".join(str(error).split()) or type(error).__name__
        return wrong(f"library {name}", f"cannot be imported: {words}", advice)
    if _numbers(there) < _numbers(least):
        return wrong(f"library {name}", f"version {there} is too old", advice)
    return None


def _numbers(words: str) -> list[int]:
    return [int(number) for number in re.findall(r"\d+", words)[:3]]
