"""Pictures of the pages are drawn by the programs that the pages' build runs, and say what the pages say."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from docs import floor_plan
from docs.site import calibration_picture, demo_picture, hooks, page_picture
from mapweave.vision.calibration.target import CalibrationTarget
from mapweave.vision.calibration.views import BoardDetector

DOCS = Path(__file__).parents[1] / "docs"


def test_every_picture_has_a_program_that_draws_it():
    """The build runs it, or the page says that a person does."""
    drawn = [name for names in (hooks.PICTURES | hooks.BY_HAND).values() for name in names]
    pictures = [path for path in DOCS.rglob("*") if path.suffix in {".png", ".gif", ".svg"}]
    assert sorted(drawn) == sorted(path.relative_to(DOCS).as_posix() for path in pictures)
    for program in hooks.PICTURES | hooks.BY_HAND:
        assert (DOCS.parent / program).is_file()
    pages = "\n".join(path.read_text(encoding="utf-8") for path in DOCS.glob("*.md"))
    for program in hooks.BY_HAND:
        assert f"python -m {program.removesuffix('.py').replace('/', '.')}" in pages


def test_the_build_runs_each_of_these_programs(monkeypatch):
    ran = []
    monkeypatch.setattr(hooks.subprocess, "run", lambda command, **_: ran.append(command[-1]))
    hooks.on_pre_build(None)
    assert ran == list(hooks.PICTURES)


def test_independent_support_counts_as_its_page_says(tmp_path):
    # Not by all that collect tests: it imports matplotlib.
    from docs import independent_support

    page = " ".join((DOCS / "independent-support.md").read_text(encoding="utf-8").split())
    one, three = independent_support.main(tmp_path / "drawn.svg")
    assert f"expected to occur falsely {one:.2g} times" in page
    assert f"are expected {three:.2g} times" in page
    assert (tmp_path / "drawn.svg").stat().st_size > 10_000


def test_the_guidance_that_is_drawn_is_of_a_target_that_is_seen(tmp_path):
    assert calibration_picture.main(tmp_path / "drawn.png").startswith("hold the board nearer")
    drawn = cv2.imread(str(tmp_path / "drawn.png"), cv2.IMREAD_GRAYSCALE)
    paper = drawn[:, : drawn.shape[1] - 800]
    assert BoardDetector(CalibrationTarget()).find(paper) is not None, "what is printed can be read"


def test_a_picture_that_looks_the_same_stays(tmp_path):
    grey = np.full((4, 5, 3), 100, np.uint8)
    kept, drawn = tmp_path / "kept.png", tmp_path / "drawn.png"
    cv2.imwrite(str(drawn), grey + 2)
    assert not floor_plan.looks_the_same(drawn, kept)
    for levels, same in ((0, True), (40, False)):
        cv2.imwrite(str(kept), grey + levels)
        assert floor_plan.looks_the_same(drawn, kept) is same


class DrawnPage:
    """A page that shows some words and is drawn in some grey, as a browser would."""

    def __init__(self, words: str, grey: int) -> None:
        self.words, self.grey = words, grey

    def run(self, script: str) -> dict[str, str]:
        assert script == page_picture.SHOWN
        return {"words": self.words}

    def screenshot(self, path: Path) -> None:
        cv2.imwrite(str(path), np.full((4, 5, 3), self.grey, np.uint8))


def test_a_picture_of_the_page_is_drawn_when_the_page_shows_something_else(tmp_path):
    """Another browser with other fonts draws the same a little differently: that is no new picture."""
    path = tmp_path / "page.png"
    cv2.imwrite(str(path), np.full((4, 5, 3), 100, np.uint8))
    for words, grey, expected in (
        ("live", 100, 100), ("live", 140, 100), ("87 nodes", 101, 100), ("87 nodes", 140, 140),
        ("live", 140, 140), ("live", 100, 100),
    ):  # fmt: skip
        page_picture.keep(DrawnPage(words, grey), path)
        assert cv2.imread(str(path))[0, 0, 0] == expected, (words, grey)
        assert list(tmp_path.iterdir()) == [path]
    assert page_picture.content_of(path)


def test_without_a_browser_the_pictures_of_the_page_stay(monkeypatch, capsys):
    monkeypatch.setattr(page_picture, "there_is_none", lambda: True)
    page_picture.main()
    reason = "page.png and edit.png stay as they are: drawing needs chromium and chromedriver\n"
    assert capsys.readouterr().err == reason


@pytest.mark.parametrize("reached", [True, False])
def test_the_demo_gives_its_picture_if_the_lost_robot_arrived(reached: bool, tmp_path):
    (tmp_path / "report.json").write_text(json.dumps({"goal": {"reached": reached}}))
    (tmp_path / "map.png").write_bytes(b"new")
    (tmp_path / "kept.png").write_bytes(b"old")
    if reached:
        demo_picture.keep(tmp_path, tmp_path / "kept.png")
    else:
        with pytest.raises(ValueError, match="has not arrived"):
            demo_picture.keep(tmp_path, tmp_path / "kept.png")
    assert (tmp_path / "kept.png").read_bytes() == (b"new" if reached else b"old")
