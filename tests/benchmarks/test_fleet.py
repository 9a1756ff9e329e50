"""The benchmark of fleets: what it says of agents that disturb, and its report by made-up figures."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.fleet import agents_process, benchmark
from benchmarks.fleet.agents_process import INTERVAL, Orders, Reporter, first_stops, run_schedule
from benchmarks.fleet.benchmark import (
    BEHIND_AFTER,
    Figures,
    StatusAsker,
    main,
    milliseconds,
    trouble_of,
    when_behind,
)
from mapweave.hybridmap import jit
from mapweave.hybridmap.agent_status import FleetStatus, RobotEntry
from mapweave.wire.bus import Reply
from mapweave.wire.messages import encode
from tests.programs import python
from tests.waiting import eventually

FIGURES: Figures = {
    "ack_p99_ms": 200.0, "burst_p99_ms": None, "burst_s": None, "unacked": 0, "relocalize_p95_ms": 100.0,
}  # fmt: skip
SAID = {"slow": "2 changes missing for 0.9 s", "frozen": "gone", "flooding": "over its quota: 9 changes"}


class Answering:
    """A bus on which each question has the next answers, and the last ones again and again."""

    def __init__(self, *answers: Sequence[Reply]) -> None:
        self.answers = list(answers)

    def ask(self, key: str, payload: bytes, timeout: float) -> Sequence[Reply]:
        return self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]


def status(*entries: RobotEntry) -> list[Reply]:
    return [Reply(encode(FleetStatus(entries)))]


def asked(monkeypatch: pytest.MonkeyPatch, *answers: Sequence[Reply]) -> dict[str, str]:
    monkeypatch.setattr(benchmark, "THAW_BEFORE", 0.0)
    names, now = {"r8": "slow", "r9": "flooding"}, time.monotonic()
    bus: Any = Answering(*answers)
    return StatusAsker(bus, names, [now, now + 0.02, now + 0.04], now + 0.1).result()


def test_what_was_said_while_they_disturbed_is_kept(monkeypatch):
    slow = RobotEntry("r8", True, 0.1, missing=2, lag=0.91)
    flooding = RobotEntry("r9", True, 0.1, over_quota="over its quota: 3 changes")
    more = replace(flooding, over_quota="over its quota: 7 changes")
    other = RobotEntry("r0", False, 99.0)
    said = asked(
        monkeypatch, status(other), status(slow, flooding), status(replace(slow, missing=0), more),
        status(replace(slow, missing=9)),
    )  # fmt: skip
    # The third question of four is not asked: it is said of the slow one that it is behind.
    assert said == {"slow": "2 changes missing for 0.9 s", "flooding": "over its quota: 7 changes"}


def test_a_server_that_never_answers_ends_the_benchmark(monkeypatch):
    for none in ([], [Reply(error="too busy")]):
        with pytest.raises(SystemExit, match="does not answer"):
            asked(monkeypatch, none)


def test_trouble_in_words():
    entry = RobotEntry("r8", True, 4.9)
    assert trouble_of(entry) == ""
    assert trouble_of(replace(entry, age=5.14)) == "silent for 5.1 s"
    assert trouble_of(replace(entry, alive=False)) == "gone"
    both = replace(entry, missing=3, lag=1.5, over_quota="over its quota: 1 beacon")
    assert trouble_of(both) == "3 changes missing for 1.5 s, over its quota: 1 beacon"


def test_agents_stay_until_the_end_of_mapping():
    """One that floods would else end with its last node."""
    begin = time.monotonic()
    run_schedule([], Orders("", "", 0, 0, 1, 0.3, 0, 1), begin, Reporter())
    assert time.monotonic() >= begin + 0.3


def test_agents_stay_connected_until_the_others_are_acknowledged(monkeypatch, capsys):
    """Those that have no change in the burst would else leave at its beginning: half of a thousand."""
    printed: list[str] = []

    class Pipe:
        def readline(self) -> str:
            return f"{time.monotonic()}\n"

        def read(self) -> str:
            printed.append(capsys.readouterr().out)
            return ""

    orders = Orders("", "", 0, 0, 1, 0.0, 0, 1)
    monkeypatch.setattr("sys.argv", ["agents_process", json.dumps(asdict(orders))])
    monkeypatch.setattr("sys.stdin", Pipe())
    monkeypatch.setattr("os._exit", sys.exit)
    monkeypatch.setattr(jit, "load", lambda: None)
    with pytest.raises(SystemExit):
        agents_process.main()
    assert [json.loads(out.splitlines()[-1])["burst"] for out in printed] == [[]]


def test_a_frozen_agent_ends_with_a_benchmark_that_is_killed(tmp_path):
    """It stayed for ever, and those that are not frozen drove on."""
    with socket.create_server(("127.0.0.1", 0)) as router:
        router.settimeout(60.0)
        orders = Orders(f"tcp/127.0.0.1:{router.getsockname()[1]}", str(tmp_path), 0, 1, 1, 10.0, 0, 1)
        program = (
            "import time\n"
            "from benchmarks.fleet.agents_process import Orders\n"
            "from benchmarks.fleet.benchmark import Generator\n"
            f"print(Generator({orders!r}).pid, flush=True)\n"
            "time.sleep(60)\n"
        )
        parent = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
        try:
            assert parent.stdout is not None
            child = Path("/proc", parent.stdout.readline().strip())
            connection, _ = router.accept()  # and it waits for an answer
            os.kill(int(child.name), signal.SIGSTOP)
        finally:
            parent.kill()
            parent.communicate()
        with connection:
            try:
                eventually(lambda: not running(child), 5.0)
            finally:
                with suppress(ProcessLookupError):
                    os.kill(int(child.name), signal.SIGKILL)


def running(process: Path) -> bool:
    """Whether a process of `/proc` has not ended."""
    try:
        return "\nState:\tZ" not in (process / "status").read_text()
    except FileNotFoundError:
        return False


def test_a_slow_agent_is_asked_about_behind_each_of_its_nodes():
    slow = Orders("", "", 9, 1, 9, 30.0, 0, 1)
    (first,) = first_stops(slow, 100.0)
    assert 100.0 <= first < 110.0
    assert when_behind(slow, 100.0) == pytest.approx([first + k * INTERVAL + BEHIND_AFTER for k in range(3)])


def test_a_percentile_of_nothing_is_none():
    assert milliseconds(np.array([]), 99) is None
    assert milliseconds(np.array([0.001, 0.002, np.inf]), 50) == 2.0


@pytest.mark.parametrize(("change", "said", "status"), [
    ({}, SAID, 0),
    ({}, {}, 0),
    ({}, {**SAID, "flooding": ""}, 1),
    ({"unacked": 1}, {}, 1),
    ({"disturbers_unacked": 1}, SAID, 1),
    ({"ack_p99_ms": 500.1}, {}, 1),
    ({"relocalize_p95_ms": None}, {}, 1),
])  # fmt: skip
def test_it_ends_with_1_unless_it_is_good_and_prints_json(
    change: Figures, said: dict[str, str], status: int, monkeypatch, capsys
):
    monkeypatch.setattr(benchmark, "measure_floor", lambda folder: {"floor_p50_ms": 1.0})
    monkeypatch.setattr(benchmark, "measure_fleet", lambda *_: ({**FIGURES, **change}, said))
    monkeypatch.setattr("sys.argv", ["fleet", "--agents", "9", "--burst", "0", "--json"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == status

    def no_json(word: str) -> None:
        raise AssertionError(word)

    report = json.loads(capsys.readouterr().out, parse_constant=no_json)
    assert report["good"] is (status == 0)
    assert report["agents"]["9"]["burst_p99_ms"] is None


@pytest.mark.slow
@pytest.mark.waits
@pytest.mark.timeout(400)
def test_a_small_fleet_is_measured_as_a_whole():
    """Not how fast it is: that is a matter of the machine and of what else it does."""
    arguments = "--agents 4 --seconds 12 --burst 40 --disturb --seed 5 --json"
    ran = python("-m", "benchmarks.fleet", *arguments.split(), timeout=380)
    assert ran.stdout, ran.stderr[-2000:]
    report = json.loads(ran.stdout.splitlines()[-1])
    assert ran.returncode == (not report["good"])
    row = report["agents"]["4"]
    assert 0.0 < report["floor_p50_ms"] <= report["floor_p99_ms"]
    assert report["floor_cpu_ms"] > 0.0
    # All that was sent is acknowledged: a node and its edge every 10 s of each, and the burst.
    assert row["unacked"] == row["disturbers_unacked"] == 0
    assert row["burst"] == 40 and row["burst_s"] > 0.0
    assert 4 <= row["acked_per_s"] * 12 <= 4 * 2 * 2
    assert 0.0 < row["ack_p50_ms"] <= row["ack_p99_ms"] and row["relocalize_p95_ms"] > 0.0
    for name in (
        "connected_s", "server_cpu", "router_cpu", "generator_cpu", "server_rss_mb", "burst_generator_ms",
    ):  # fmt: skip
        assert row[name] > 0.0, name
    # Of 40 changes these may take less than the 10 ms in which a process's time is counted.
    assert row["burst_server_ms"] >= 0.0 <= row["burst_router_ms"]
    said = report["said"]["4"]
    assert {*said} == {"slow", "frozen", "flooding"}
    assert "changes" in said["flooding"] and "questions" in said["flooding"], said
