"""A trial's folder: whole, readable by others' programs, and nothing beside it."""

import io
import json
import os
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapweave import HybridMap, read_map_file
from mapweave.hybridmap.errors import InvalidFile
from mapweave.scenarios.error_plot import _labels
from mapweave.scenarios.expectations import check, parse_expectations
from mapweave.scenarios.recording import TrialEvent
from mapweave.scenarios.report_folder import write_folder
from mapweave.scenarios.score import TrialResult, score
from tests.mapweave.scenarios.conftest import stage, stage_events
from tests.programs import python

SCENARIO = 'name = "staged"\n[expect]\ncomponents = 2\nlink_recall = 0.99\n'
WANTED = parse_expectations({"components": 2, "link_recall": 0.99})
FILES = {
    "figures.json", "report.md", "map.png", "errors.png", "scenario.toml", "merged.mapweave",
    *(f"r{k}.{what}.tum" for k in range(3) for what in ("truth", "nodes", "map-1")),
}  # fmt: skip


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    """Folder, recording and figures of a trial. No test may change them."""
    recording = stage_events(stage()).recording()
    figures = score(recording)
    out = tmp_path_factory.mktemp("reported") / "made for" / "it"
    write_folder(out, TrialResult(recording, figures, tuple(check(figures, WANTED))), SCENARIO)
    return out, recording, figures


@pytest.fixture
def written(reported, tmp_path):
    """The same with a folder of one's own."""
    out = tmp_path / "made for" / "it"
    shutil.copytree(reported[0], out)
    return out, *reported[1:]


def evo(program: str, *arguments: str, report_folder: Path, home: Path) -> float:
    """The root mean square error that one of evo's programs prints."""
    home.mkdir()
    code, at_home = (
        f"from evo.cli.entry_points import {program}; {program}()",
        os.environ | {"HOME": str(home)},
    )
    done = python("-c", code, *arguments, cwd=report_folder, env=at_home, check=True)
    return float(re.search(r"rmse\s+([0-9.e-]+)", done.stdout)[1])


def test_everything_is_there_and_nothing_half_written(written):
    out, recording, figures = written
    assert {path.name for path in out.iterdir()} == FILES
    content = json.loads((out / "figures.json").read_text())
    assert (content["scenario"], content["seed"], content["passed"]) == ("staged", 3, False)
    assert content["figures"] == figures.as_dict()
    assert [(v["name"], v["good"]) for v in content["verdicts"]] == [
        ("components", True),
        ("link_recall", False),
    ]
    assert (out / "scenario.toml").read_text() == SCENARIO
    merged = HybridMap(read_map_file(out / "merged.mapweave", "merged").changes)
    assert set(merged.nodes) == set(HybridMap(recording.merged.changes).nodes)


@pytest.mark.slow
def test_evo_reads_the_trajectories_and_finds_the_same_errors(written, tmp_path):
    out, _, figures = written
    files = ("r1.truth.tum", "r1.map-1.tum")
    ate = evo("ape", "tum", *files, "--align", report_folder=out, home=tmp_path / "home")
    assert ate == pytest.approx(figures.robots["r1"].trajectory_ate_m, abs=2e-6)
    page = (out / "report.md").read_text()
    assert f"evo_ape tum {files[0]} {files[1]} --align" in page
    commands = re.findall(r"evo_rpe (tum r1.*)", page)
    rpe_m, rpe_deg = (
        evo("rpe", *command.split(), report_folder=out, home=tmp_path / str(k))
        for k, command in enumerate(commands)
    )
    assert rpe_m == pytest.approx(figures.robots["r1"].rpe_m, abs=5e-6)
    assert rpe_deg == pytest.approx(figures.robots["r1"].rpe_deg, abs=1e-3)


def test_places_are_aligned_with_the_world(written, eventful):
    out, _, _ = written
    rows = np.loadtxt(out / "r2.nodes.tum")
    true = np.array([eventful.true_pose(n).vector for n in eventful.nodes if n.agent == "r2"])
    assert np.hypot(*(rows[:, 1:3] - true[:, :2]).T).max() < 0.05
    heading = 2 * np.arctan2(rows[:, 6], rows[:, 7])
    assert np.abs(np.sin(heading - true[:, 2])).max() < 0.1
    assert (np.diff(rows[:, 0]) > 0).all()


def test_the_page_shows_the_result(written):
    page = (written[0] / "report.md").read_text()
    assert page.startswith("# staged, seed 3: FAILED\n")
    assert "| link_recall | at least 0.99 |" in page
    assert "| 1 | 20.0 | the network of r2 is cut \\| for a while |" in page
    assert "mapweave sim run scenario.toml --seed 3" in page
    assert "film.webm" not in page
    for name in re.findall(r"\]\((.*?)\)", page):
        assert (written[0] / name).is_file()


def test_pictures_show_their_content(written):
    out, _, _ = written
    image = cv2.cvtColor(cv2.imread(str(out / "map.png")), cv2.COLOR_BGR2RGB).astype(int)
    for colour in ((0x1F, 0x77, 0xB4), (0xD9, 0x5F, 0x02), (0x2A, 0x9D, 0x4B), (0xFF, 0xD7, 0x00)):
        assert (np.abs(image - colour).max(axis=2) < 12).sum() > 100
    errors = cv2.imread(str(out / "errors.png"))
    assert errors.shape[1] > 1000
    assert (errors.min(axis=2) < 100).mean() > 0.01


def test_moments_that_are_near_share_a_label():
    moments = [TrialEvent(int(s * 1e9), "") for s in (0.0, 50.0, 50.1, 51.9, 60.0, 100.0)]
    assert _labels(moments) == [(0.0, "1"), (50.0, "2-4"), (60.0, "5"), (100.0, "6")]
    assert _labels([]) == []


def test_files_of_an_earlier_trial_are_removed_and_others_are_kept(written):
    out, recording, figures = written
    (out / "r9.truth.tum").write_text("old")
    (out / "notes.txt").write_text("mine")
    (out / "film.webm").write_bytes(b"a film")
    write_folder(out, TrialResult(recording, figures, ()), SCENARIO)
    assert {path.name for path in out.iterdir()} == FILES | {"notes.txt", "film.webm"}
    page = (out / "report.md").read_text()
    assert "[Film](film.webm)" in page
    assert "expects nothing" in page
    assert json.loads((out / "figures.json").read_text())["passed"] is True


def test_a_crash_leaves_no_figures_and_no_halves(written, monkeypatch):
    out, recording, figures = written

    def crash(figure: object, file: io.BytesIO | Path, **options: object) -> None:
        if figure.get_size_inches()[1] != 4.5:  # the map is drawn
            return
        (file.write if isinstance(file, io.BytesIO) else file.write_bytes)(b"half a picture")
        raise RuntimeError("crashed")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", crash)
    with pytest.raises(RuntimeError, match="crashed"):
        write_folder(out, TrialResult(recording, figures, ()), SCENARIO)
    left = {path.name for path in out.iterdir()}
    assert left < FILES
    assert not left & {"figures.json", "errors.png", "report.md"}


def test_an_unwritable_place_is_reported_in_one_line(eventful, tmp_path):
    recording = eventful.recording()
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InvalidFile, match="cannot be written"):
        write_folder(tmp_path / "file", TrialResult(recording, score(recording), ()), SCENARIO)


def test_an_empty_trial_has_a_folder(staged, tmp_path):
    staged.nodes.clear()
    staged.edges.clear()
    staged.truth = {"r0": staged.truth["r0"]}
    recording = staged.recording()
    recording.robots["r0"].estimates.clear()
    write_folder(tmp_path, TrialResult(recording, score(recording), ()), SCENARIO)
    names = {path.name for path in tmp_path.iterdir()}
    assert "r0.truth.tum" in names
    assert not any("map-1" in name or "nodes" in name for name in names)


def test_scoring_writes_no_file_at_home_and_prints_nothing(tmp_path):
    """The programs of evo keep settings in the home directory and print; its core does not."""
    program = (
        "import logging, sys\n"
        "import numpy as np\n"
        "from mapweave.scenarios.recording import TrialTrajectory\n"
        "from mapweave.scenarios.trajectories import score_trajectory\n"
        "t = np.arange(50) * 10**8\n"
        "way = TrialTrajectory(t, np.stack([t / 1e9, np.sin(t / 1e9), t * 0.0], axis=1))\n"
        "assert score_trajectory(way, way).ate_m < 1e-9\n"
        "assert not logging.getLogger().handlers\n"
        "assert not {'matplotlib', 'seaborn', 'pandas', 'evo.tools'} & set(sys.modules)\n"
    )
    done = python("-W", "error", "-c", program, env=os.environ | {"HOME": str(tmp_path)})
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert list(tmp_path.iterdir()) == []
