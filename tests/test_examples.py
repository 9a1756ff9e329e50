"""The examples run from a checkout as they are, and what they print is so."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import mapweave
from mapweave.exit_status import MISSING_EXTRA
from mapweave.extras import MODULES
from mapweave.mapserver.server import MapServer
from mapweave.photographs import send_map
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.zenoh_bus import ZenohBus
from tests.programs import going
from tests.simulator import needs_simulator
from tests.waiting import eventually, free_port

EXAMPLES = Path(__file__).parents[1] / "examples"
LACKING = {
    "drive_in_simulator": ["sim"], "gym_random": ["sim", "gym"], "merge_maps": ["server"],
    "plot_map": ["viz"], "relocalize_photo": ["server"], "rerun_log": ["rerun"],
    "ten_lines": ["sim"], "watch_fleet": ["viz"],
}  # fmt: skip
"""Extras that are not there, by the example that needs them."""
SHORT = sorted(path.stem for path in EXAMPLES.glob("*.py"))


def run(folder: Path, name: str, *words: str) -> str:
    """What an example prints."""
    ran = subprocess.run(
        [sys.executable, str(EXAMPLES / f"{name}.py"), *words],
        cwd=folder, capture_output=True, text=True, timeout=200,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


@pytest.mark.parametrize("name", SHORT)
def test_they_are_short(name: str):
    assert len((EXAMPLES / f"{name}.py").read_text().splitlines()) <= 30


@pytest.mark.parametrize("name", [*LACKING])
def test_an_example_without_its_extra_ends_in_one_line(name: str, tmp_path):
    """As a command does: it was a traceback of fifteen lines."""
    missing = sorted({module for extra in LACKING[name] for module in MODULES[extra]})
    program = (
        "import runpy, sys\n"
        "from tests.mapweave.without_libraries import Without\n"
        f"sys.meta_path[:] = [Without(finder, frozenset({missing})) for finder in sys.meta_path]\n"
        "sys.argv[:] = sys.argv[1:]\n"
        f"sys.path.insert(0, {str(EXAMPLES)!r})\n"
        "runpy.run_path(sys.argv[0], run_name='__main__')\n"
    )
    ran = subprocess.run(
        [sys.executable, "-c", program, str(EXAMPLES / f"{name}.py")],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(EXAMPLES.parent)},
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    needs = " and ".join(f'"{extra}"' for extra in LACKING[name])
    assert re.fullmatch(rf"{name}\.py needs the extras? {needs}: .*\n", ran.stderr), ran.stderr
    assert (ran.returncode, ran.stdout) == (MISSING_EXTRA, "")


def test_watching_a_fleet_without_a_router_ends_in_one_line(tmp_path):
    """It was a traceback."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    ran = subprocess.run(
        [sys.executable, EXAMPLES / "watch_fleet.py", endpoint],
        cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert re.fullmatch(rf"no router at {re.escape(endpoint)}: start `mapweave server`, .*\n", ran.stderr)
    assert (ran.returncode, ran.stdout) == (1, "")


@pytest.mark.slow
@needs_simulator
def test_they_run(tmp_path, opened):
    """Each by itself; what one has driven the next finds, as in a person's folder."""
    out = tmp_path / "out" / "examples"
    printed = run(tmp_path, "plot_map")
    own = mapweave.open(out / "r0.mapweave")
    assert f"{own.hash[:12]}" in printed and len(re.findall(r"r0\.1\.\d+: ", printed)) == len(own.nodes) >= 4
    assert (out / "map.png").stat().st_size > 5000

    printed = run(tmp_path, "merge_maps")
    office = mapweave.open(out / "office.mapweave")
    assert "r0.1 and r1.1: one map" in printed and set(office.nodes.component) == {0}
    assert {name.split(".")[0] for name in office.nodes.ids} == {"r0", "r1"}

    printed = run(tmp_path, "relocalize_photo")
    really, found = (
        [float(number) for number in numbers]
        for numbers in re.findall(r"at ([+-][\d.]+) ([+-][\d.]+) m, ([+-][\d.]+) deg", printed)
    )
    assert "found" in printed and found[:2] == pytest.approx(really[:2], abs=0.02)
    assert found[2] == pytest.approx(really[2], abs=1.0)
    assert run(tmp_path, "drive_in_simulator").split() == [f"out/examples/r{k}.mapweave" for k in (0, 1)]

    printed = run(tmp_path, "rerun_log")
    assert "not in it: nothing" in printed and (out / "r0.rrd").stat().st_size > 100_000

    endpoint, keys = f"tcp/127.0.0.1:{free_port()}", Keys("demo")
    bus = opened(ZenohBus(BusSettings(mode="router", listen=(endpoint,))))
    robot = opened(ZenohBus(BusSettings(endpoints=(endpoint,))))
    with MapServer(bus, keys, tmp_path / "server" / "s0.sqlite", "s0") as server:
        program = [sys.executable, "-u", EXAMPLES / "watch_fleet.py", endpoint, 60]
        with (
            (tmp_path / "watch.txt").open("w") as log,
            going(*program, cwd=tmp_path, stdout=log, stderr=log),
        ):
            eventually(lambda: "map: 0 nodes" in (tmp_path / "watch.txt").read_text(), 60.0)
            for name in ("r0", "r1"):
                changes = mapweave.open(out / f"{name}.mapweave").content.changes
                journal = tmp_path / f"{name}.sqlite"
                assert send_map(changes, mapweave.MapId(name, 1), journal, robot, keys, "s0", 30.0)
            assert server.settle(60.0)
            eventually(lambda: "joined: " in (tmp_path / "watch.txt").read_text(), 60.0)
            eventually(lambda: (out / "fleet.png").exists(), 60.0)
