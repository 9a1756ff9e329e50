"""The fuzzer finds what is there to be found, and its command prints what it found."""

from __future__ import annotations

import importlib
import json
import math
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks.fuzz import benchmark, process
from benchmarks.fuzz.targets import AcceptedInvalid, check_again, check_finite
from mapweave.hybridmap import jit
from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.pose import Pose2


class TwoLines(InvalidMessage):
    """An error that does not keep to one line."""

    def __str__(self) -> str:
        return "one\ntwo"


def test_what_is_wrong_is_found_and_sorted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_an_invalid_value_is_noticed() -> None:
    check_finite((Pose2(1.0, 2.0, 3.0), {"a": [1.0]}))
    with pytest.raises(AcceptedInvalid):
        check_finite({"a": [Pose2(1.0, math.inf, 3.0)]})
    with pytest.raises(AcceptedInvalid):
        check_again(3, lambda value: bytes([value]), lambda data: data[0] + 1)


@pytest.mark.slow
def test_the_command_prints_its_counts(capsys: pytest.CaptureFixture[str]) -> None:
    status = benchmark.main(["--seconds", "1", "--targets", "lines", "poses", "--json"])
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert result["inputs"] > 20
    # It goes on looking: what it finds one day is no fault of the command.
    found = sum(result[name] for name in ("crashes", "hangs", "accepted_invalid"))
    assert status == (1 if found else 0)
    assert result["peak_rss_mb"] > 10


def test_no_kernel_counts_its_branches() -> None:
    """Numba cannot compile it then; a kernel of whole numbers is compiled after some hundred calls."""
    for module in ("wire.landmark_codec", "agent.runner", "mapserver.server"):
        importlib.import_module(f"mapweave.{module}")
    kernels = {kernel.__module__ for kernel in jit.KERNELS}
    counted = {module for module in kernels if any(module.startswith(name) for name in process.DECODERS)}
    assert counted and counted <= {*process.COMPILED}
