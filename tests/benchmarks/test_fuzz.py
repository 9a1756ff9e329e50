"""The fuzzer finds what is there to be found, and its command prints what it found."""

import importlib
import json
import math
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks.fuzz import benchmark, http_application, process, server_files, targets
from benchmarks.fuzz.http_application import HttpApplication
from benchmarks.fuzz.recordings import RECORDINGS
from benchmarks.fuzz.samples import Samples
from benchmarks.fuzz.targets import TARGETS, AcceptedInvalid, check_again, check_finite
from mapweave.hybridmap import jit
from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.pose import Pose2


@pytest.fixture(scope="module")
def samples() -> Samples:
    return Samples(1)


@pytest.fixture
def application() -> Iterator[HttpApplication]:
    """The one that targets ask."""
    made = targets.application()
    yield made
    made.close()
    targets.application.cache_clear()


class TwoLines(InvalidMessage):
    """An error that does not keep to one line."""

    def __str__(self) -> str:
        return "one\ntwo"


def test_what_is_wrong_is_found_and_sorted(tmp_path, monkeypatch):
    monkeypatch.setattr(process, "SLOW", 0.05)

    def decode(data: bytes, _: Path) -> None:
        if data == b"refuse":
            raise InvalidMessage("one line")
        if data == b"two lines":
            raise TwoLines
        if data == b"crash":
            raise KeyError("x")
        if data == b"invalid":
            raise AcceptedInvalid("inf")
        while data == b"hang":
            pass

    fuzzing = process.Fuzzing(SimpleNamespace(run=decode), tmp_path)
    for data in (b"fine", b"refuse", b"crash", b"crash", b"two lines", b"invalid", b"hang"):
        fuzzing.one(data)
    fuzzing.write()
    counts = json.loads((tmp_path / "counts.json").read_text())
    assert counts.pop("peak_rss_mb") > 0
    assert counts == {"inputs": 7, "accepted": 1, "crashes": 2, "hangs": 1, "accepted_invalid": 1}
    assert {path.read_bytes() for path in tmp_path.glob("crashes-????????????")} == {b"crash", b"two lines"}


def test_a_finding_is_counted_at_once(tmp_path):
    """LibFuzzer ends the process without coming back: before, findings of its last 0.2 s were not counted."""

    def decode(data: bytes, _: Path) -> None:
        if data == b"invalid":
            raise AcceptedInvalid("inf")

    fuzzing = process.Fuzzing(SimpleNamespace(run=decode), tmp_path)
    for data in (b"fine", b"invalid"):
        fuzzing.one(data)
    assert json.loads((tmp_path / "counts.json").read_text())["accepted_invalid"] == 1


NEW = [*RECORDINGS, "cluster", "plans", "live", "nav2_map", "world", "fleet_file", "tokens"]
NEW += ["messages", "checksummed", "shown", "learned", "views"]


@pytest.mark.parametrize("name", NEW)
@pytest.mark.usefixtures("application")
def test_good_samples_are_taken(name: str, samples: Samples, tmp_path):
    """What is refused at its beginning hides all that lies behind it from the fuzzer."""
    good = TARGETS[name].samples(samples)
    assert len(good) >= 1 and max(map(len, good)) <= TARGETS[name].most
    for sample in good:
        TARGETS[name].run(sample, tmp_path)


def test_every_kind_of_message_and_of_checksummed_file_has_a_good_sample(samples: Samples):
    """The last kinds had none: what they were mutated of was refused at its first byte."""
    kinds = {sample[0] for sample in TARGETS["messages"].samples(samples)}
    assert kinds == {*range(len(targets.DECODERS))}
    assert {"KeptPruned", "KeptPruning", "MissionReport", "PlanPiece", "refusal"} <= targets.DECODERS.keys()
    assert len(TARGETS["checksummed"].samples(samples)) == len(server_files.CHECKSUMMED)
    magics = {line.partition(b"\n")[0] for line in server_files.CHECKSUMMED}
    assert magics == {b"mapweave superseded", b"mapweave verdicts", b"mapweave merge"}


def test_uploads_of_good_samples_are_kept(samples: Samples, application: HttpApplication):
    """A target of HTTP takes refusals as well."""
    kept = [
        application.answer(b"POST /plans multipart/form-data; boundary=b\n" + form)
        for form in TARGETS["plans"].samples(samples)
    ]
    assert kept == [200] * len(kept)


def test_a_viewer_is_let_in(samples: Samples, application: HttpApplication, monkeypatch):
    """By the heads of all samples; so the frames behind them are read."""
    sent: list[bytes] = []
    monkeypatch.setattr(http_application.Transport, "write", lambda self, data: sent.append(bytes(data)))
    for number, sample in enumerate(samples.viewers()):
        sent.clear()
        application.watch(sample)
        assert sent[0].startswith(b"HTTP/1.1 101 "), number
        compressed = b"permessage-deflate" in sent[0]
        assert compressed == (number == 1) and (compressed or b'"hello"' in b"".join(sent))


def test_an_invalid_value_is_noticed():
    check_finite((Pose2(1.0, 2.0, 3.0), {"a": [1.0]}))
    with pytest.raises(AcceptedInvalid):
        check_finite({"a": [Pose2(1.0, math.inf, 3.0)]})
    with pytest.raises(AcceptedInvalid):
        check_again(3, lambda value: bytes([value]), lambda data: data[0] + 1)


@pytest.mark.parametrize(("begins", "ends", "hangs"), [(0.5, 0.0, 0), (0.0, 9.0, 1), (9.0, 0.0, 1)])
def test_a_process_that_begins_late_is_no_hang_and_one_that_never_ends_is(
    tmp_path, monkeypatch, begins: float, ends: float, hangs: int
):
    process = tmp_path / "process"
    counts = '{"inputs": 1, "hangs": 0, "crashes": 0}'
    process.write_text(f"#!/bin/sh\nsleep {begins}\necho '{counts}' > $4/counts.json\nexec sleep {ends}\n")
    process.chmod(0o700)
    monkeypatch.setattr(benchmark.sys, "executable", str(process))
    monkeypatch.setattr(benchmark, "START", 2.0)
    monkeypatch.setattr(benchmark, "GRACE", 0.2)
    row = benchmark.fuzz_one("lines", tmp_path, 0.0, 1)
    assert row["hangs"] == hangs and not row["crashes"]


@pytest.mark.slow
def test_the_command_prints_its_counts(capsys):
    status = benchmark.main(["--seconds", "1", "--targets", "lines", "poses", "--json"])
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert result["inputs"] > 20
    # It goes on looking: what it finds one day is no fault of the command.
    found = sum(result[name] for name in ("crashes", "hangs", "accepted_invalid"))
    assert status == (1 if found else 0)
    assert result["peak_rss_mb"] > 10


def test_no_kernel_counts_its_branches():
    """Numba cannot compile it then; a kernel of whole numbers is compiled after some hundred calls."""
    for module in ("wire.landmark_codec", "agent.runner", "mapserver.server"):
        importlib.import_module(f"mapweave.{module}")
    kernels = {kernel.__module__ for kernel in jit.KERNELS}
    counted = {module for module in kernels if any(module.startswith(name) for name in process.DECODERS)}
    assert counted and counted <= {*process.COMPILED}


@pytest.mark.slow
def test_nothing_is_left_in_the_folder_of_temporary_files(tmp_path):
    """A run left a hundred folders there: libFuzzer ends its processes before they remove theirs."""
    command = [sys.executable, "-m", "benchmarks.fuzz", "--seconds", "1", "--targets", "kitti", "http"]
    subprocess.run(command, env={**os.environ, "TMPDIR": str(tmp_path)}, check=True, capture_output=True)
    assert not [path.name for path in tmp_path.iterdir() if path.name.startswith("fuzz-")]
