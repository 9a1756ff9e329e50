"""The benchmark of wrong geometry on a short rendered drive: its figures."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.geometry.benchmark import drawn_wheels, main
from mapweave.agent.drive_geometry import DriveGeometry
from mapweave.agent.drivers.replay import Replay
from mapweave.evaluation.truth import Truth
from tests.agent.calibration.room_drive import CAMERA, drive, write


@pytest.mark.slow
def test_the_benchmark_says_what_a_wrong_geometry_costs(tmp_path, monkeypatch, capfd):
    camera = replace(CAMERA, width=160, height=120, fx=138.5, fy=138.5, cx=79.5, cy=59.5)
    true = DriveGeometry(forward=0.1, height=0.25)
    write(drive(np.random.default_rng(0), true, 12.0, camera=camera), tmp_path)
    only = ["--only", "heading 2 deg", "--seed", "1", "--json"]
    monkeypatch.setattr(sys, "argv", ["geometry", "--recording", str(tmp_path), *only])
    main()
    figures = json.loads(capfd.readouterr().out.splitlines()[-1])
    assert set(figures["ratios"]) == set(figures["named"]) == {"heading 2 deg"}
    assert figures["error_ratio"] == figures["ratios"]["heading 2 deg"] > 0.0
    assert figures["wheels_ratio"] > 0.0
    assert figures["frames_used"] >= 0.95
    assert figures["diagnosed"] is figures["named"]["heading 2 deg"]
    assert 0.0 < figures["right_m"] < 1.0
    # Drawn wheels are the truth with a little noise, and the same for the same seed.
    recording, truth = Replay(tmp_path).recording, Truth.read(tmp_path / "truth.csv")
    one, same, other = (drawn_wheels(recording, truth, seed).increments for seed in (1, 1, 2))
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)
    assert one[:, 0].sum() == pytest.approx(recording.increments[:, 0].sum(), rel=0.05)
    assert np.abs(one - recording.increments).max() < 0.02
