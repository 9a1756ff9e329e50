"""What an agent costs on one core, with the base installation only.

    python -m benchmarks.agent [--seed N] [--seconds S] [--json]

A robot explores the simulated office; what it senses is kept. Then a process of its own, bound to one core,
plays that to the whole agent: pipeline, journal on the disk, a Zenoh session to a router. A tick is the time
from an observation to the request for the next. The libraries of all extras are hidden from that process;
`with_numba` are the figures of another one that has numba, which the extra `fast` installs.

`tick_cpu_ms_*` is the processor time of the loop's thread, which other programs prolong less. `node_ms` is
the median of the ticks in which a node is made. `wheel_mb` is the size of what `pip install mapweave`
downloads besides Mapweave itself.
"""

import json
import os
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.agent.drive import render
from benchmarks.command_line import command_line
from mapweave.extras import MODULES
from mapweave.hybridmap.errors import InvalidValue, MapweaveError
from mapweave.scenarios.children import Children, free_port

ROOT = Path(__file__).parents[2]
TICKS_PER_SECOND = 10
FAST = ("numba", "scipy")
"""What the extra `fast` installs."""
ASKED = {"tick_ms_p50": 10.0, "tick_ms_p99": 40.0, "rss_mb": 300.0, "import_s": 2.0}
"""At most."""

Figures = dict[str, float]


def played(drive: Path, folder: Path, seed: int, hidden: list[str]) -> Figures:
    """The figures of a process on one core.

    Args:
        drive: that it plays.
        folder: new; for its journal.
        seed: of the agent.
        hidden: libraries that it does not have.

    Raises:
        InvalidValue: it has failed.
    """
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    core = min(os.sched_getaffinity(0))
    with Children(folder / "logs") as children:
        children.start("router", ["router", "--listen", endpoint])
        command = [
            sys.executable,
            "-m",
            "benchmarks.agent.process",
            str(drive),
            str(folder),
            endpoint,
            str(seed),
        ]
        one_thread = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        done = subprocess.run(
            ["taskset", "--cpu-list", str(core), *command, *hidden],
            capture_output=True, text=True, check=False, env=os.environ | one_thread, cwd=ROOT,
        )  # fmt: skip
    if done.returncode:
        raise InvalidValue(f"the agent has failed: {(done.stderr.strip().splitlines() or [''])[-1]}")
    figures: Figures = json.loads(done.stdout.splitlines()[-1])
    return figures


def wheel_mb(folder: Path) -> float:
    """Size of the wheels of the base installation, MB.

    Raises:
        InvalidValue: pip cannot download them.
    """
    base = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["dependencies"]
    command = [
        sys.executable,
        "-m",
        "pip",
        "download",
        "--quiet",
        "--only-binary",
        ":all:",
        "--dest",
        str(folder),
    ]
    done = subprocess.run(
        [*command, "--constraint", "constraints.txt", *base],
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
    )
    if done.returncode:
        raise InvalidValue(f"pip download has failed: {(done.stderr.strip().splitlines() or [''])[-1]}")
    return sum(wheel.stat().st_size for wheel in folder.glob("*.whl")) / 1e6


def measure(seed: int, seconds: float) -> dict[str, float | Figures]:
    """All figures."""
    extras = sorted({module for modules in MODULES.values() for module in modules} | {*FAST})
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        drive = folder / "drive.msgpack"
        render(drive, seed, round(seconds * TICKS_PER_SECOND))
        base = played(drive, folder / "base", seed, extras)
        fast = played(drive, folder / "fast", seed, [module for module in extras if module not in FAST])
        wheels = folder / "wheels"
        wheels.mkdir()
        return {**base, "wheel_mb": wheel_mb(wheels), "with_numba": fast}


def main() -> None:
    """Run and print."""
    parser = command_line("agent", __doc__)
    parser.add_argument("--seconds", type=float, default=180.0, help="of the drive (default: 180)")
    arguments = parser.parse_args()
    if not 10.0 <= arguments.seconds <= 3600.0:
        parser.error("--seconds must be between 10 and 3600")
    console = Console(stderr=arguments.json)
    try:
        with console.status("a robot drives, and two agents see it ..."):
            figures = measure(arguments.seed, arguments.seconds)
    except MapweaveError as error:
        raise SystemExit(f"agent: {error}") from None
    table = Table("figure", "base", "with numba", "asked", title="an agent on one core")
    fast = figures["with_numba"]
    assert isinstance(fast, dict)
    for name, value in figures.items():
        if isinstance(value, float | int):
            with_numba = f"{fast[name]:.1f}" if name in fast else ""
            most = f"at most {ASKED[name]:g}" if name in ASKED else ""
            table.add_row(name, f"{value:.1f}", with_numba, most)
    console.print(table)
    if arguments.json:
        print(json.dumps(rounded(figures)))


def rounded(figures: dict[str, float | Figures]) -> dict[str, float | Figures]:
    """The value with four digits."""
    return {
        name: {key: float(f"{one:.4g}") for key, one in value.items()}
        if isinstance(value, dict)
        else float(f"{value:.4g}")
        for name, value in figures.items()
    }
