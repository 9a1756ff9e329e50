"""Stored results: a command, when and where it ran, and the JSON object that it printed last."""

import json
import os
import platform
import resource
import shlex
import subprocess
import sys
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from mapweave.hybridmap.errors import InvalidFile, InvalidValue

FOLDER = Path(__file__).parents[2] / "docs" / "figures"


@dataclass(frozen=True)
class StoredResult:
    """What one command has measured.

    Attributes:
        command: as it was run, with `DATA` for the folder of recordings.
        date: on which it ended, ISO 8601.
        version: of Mapweave.
        machine: in words.
        minutes: of the processor that it took.
        figures: the JSON object.
    """

    command: str
    date: str
    version: str
    machine: str
    minutes: float
    figures: dict[str, Any]


def run(command: str, data: Path | None) -> StoredResult:
    """Run a command; what it prints besides the figures goes to standard error.

    Raises:
        InvalidValue: it needs recordings and none are given, it fails, or its last line is no JSON object.
            One that ends with 1 and has figures has not failed: they are not good.
    """
    words = shlex.split(command)
    if any("DATA" in word for word in words):
        if data is None:
            raise InvalidValue(f"{command}: say with --data where the recordings are")
        words = [word.replace("DATA", str(data), 1) for word in words]
    program = [sys.executable] if words[0] == "python" else [sys.executable, "-m", words[0]]
    load, began = os.getloadavg()[0], _processor_s()
    done = subprocess.run([*program, *words[1:]], stdout=subprocess.PIPE, text=True, check=False)
    spent = _processor_s() - began
    if done.returncode not in (0, 1):
        raise InvalidValue(f"{command}: exit status {done.returncode}")
    lines = done.stdout.strip().splitlines() or [""]
    try:
        figures = json.loads(lines[-1])
    except ValueError:
        figures = None
    if not isinstance(figures, dict):
        status = f"exit status {done.returncode}, and " if done.returncode else ""
        raise InvalidValue(f"{command}: {status}the last line is no JSON object")
    if done.returncode:
        # Figures that are not good are kept as well: else only good ones would ever be published.
        print(f"{command}: exit status 1, its figures are not good", file=sys.stderr)
    busy = f", load {load:.0f} from other programs" if load >= 0.5 else ""
    return StoredResult(
        command=command,
        date=datetime.now(UTC).date().isoformat(),
        version=version("mapweave"),
        machine=f"{os.cpu_count()} cores, {platform.machine()}{busy}",
        minutes=round(spent / 60.0, 1),
        figures=figures,
    )


def _processor_s() -> float:
    """Processor time of all processes that this one has started and waited for."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def store(name: str, result: StoredResult, folder: Path = FOLDER) -> Path:
    """Write a result to its file."""
    path = folder / f"{name}.json"
    path.write_text(json.dumps(asdict(result), indent=1) + "\n", encoding="utf-8")
    return path


def load(name: str, folder: Path = FOLDER) -> StoredResult:
    """A stored result.

    Raises:
        InvalidFile: it is missing or cannot be read as a result.
    """
    path = folder / f"{name}.json"
    try:
        return StoredResult(**json.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError:
        raise InvalidFile(f"{path} is missing: python -m benchmarks.figures --run {name}") from None
    except (OSError, ValueError, TypeError) as error:
        raise InvalidFile(f"{path}: {error}") from None
