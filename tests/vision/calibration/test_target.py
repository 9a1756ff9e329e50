"""The printed target: sizes in the PDF, rulers, and OpenCV's own picture of the board."""

import cv2
import numpy as np
import pytest

from mapweave.hybridmap.errors import InvalidValue
from mapweave.vision.calibration.target import CalibrationTarget, Pattern
from mapweave.vision.calibration.target_pdf import PAPERS, target_pdf
from mapweave.vision.calibration.views import BoardDetector
from tests.vision.calibration.boards import bitmap, read_page

BOARDS = [
    CalibrationTarget(),
    CalibrationTarget(Pattern.CHESSBOARD, 7, 10),
    CalibrationTarget(Pattern.CHARUCO, 5, 4, 0.03, 0.02, "5X5_100"),
]


@pytest.mark.parametrize("paper", PAPERS)
@pytest.mark.parametrize("target", BOARDS, ids=str)
def test_sizes_are_true_and_everything_is_on_the_paper(target: CalibrationTarget, paper: str):
    page = read_page(target_pdf(target, paper))
    assert page.size == pytest.approx(PAPERS[paper], abs=0.01)
    squares = page.rectangles[np.isclose(page.rectangles[:, 2], 1e3 * target.square, atol=1e-3)]
    assert len(squares) == (target.columns * target.rows + 1) // 2
    assert np.allclose(squares[:, 3], 1e3 * target.square, atol=1e-3)
    low, high = page.rectangles[:, :2], page.rectangles[:, :2] + page.rectangles[:, 2:]
    assert high.max(axis=0) - low.min(axis=0) == pytest.approx([1e3 * s for s in target.size], abs=1e-3)
    ends = page.lines.reshape(-1, 2)
    for corner in (low, high, ends):
        assert (corner >= 5.0).all() and (corner <= np.array(page.size) - 5.0).all()
    # A line each millimetre, from 0 to the last whole centimetre, along both edges of the board.
    across = page.lines[:, 1] == page.lines[:, 3]
    flat, upright = page.lines[across], page.lines[~across]
    for ruler, axis, side in ((upright, 0, 0), (flat, 1, 1)):
        at = np.sort(ruler[:, axis])
        assert len(at) == int(1e2 * target.size[side] + 1e-9) * 10 + 1
        assert np.allclose(np.diff(at), 1.0, atol=1e-3)
        assert at[0] == pytest.approx(low[:, axis].min(), abs=1e-3)
    assert any("100 %" in text for text in page.texts)


@pytest.mark.parametrize("target", BOARDS, ids=str)
def test_the_print_is_opencvs_board(target: CalibrationTarget):
    picture, target_from_bitmap = bitmap(read_page(target_pdf(target, "a3")), per_mm=4.0)
    view = BoardDetector(target).find(picture)
    assert view is not None and len(view.ids) == (target.columns - 1) * (target.rows - 1)
    on_target = np.column_stack([view.pixels, np.ones(len(view.pixels))]) @ target_from_bitmap.T
    off = on_target[:, :2] - view.points[:, :2]
    if target.pattern is Pattern.CHESSBOARD and np.abs(off).max() > 0.01:
        off = on_target[:, :2] - view.points[::-1, :2]  # OpenCV may count from the other end
    assert np.abs(off).max() < 0.0002
    if target.pattern is Pattern.CHARUCO:
        side = round(4e3 * target.square)
        theirs = target.board.generateImage((side * target.columns, side * target.rows))
        left, top = np.linalg.inv(target_from_bitmap)[:2, 2] + 0.5
        ours = picture[round(top) :, round(left) :][: theirs.shape[0], : theirs.shape[1]]
        assert np.mean(cv2.absdiff(ours, theirs) > 128) < 0.01


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"columns": 2}, "2x10 squares"),
        ({"square": float("nan")}, "nan mm"),
        ({"marker": 0.024}, "0.3 to 0.95 of a square"),
        ({"dictionary": "9X9"}, "no dictionary '9X9'"),
        ({"columns": 12, "rows": 12}, "50 markers, too few"),
        ({"pattern": Pattern.CHESSBOARD, "columns": 8}, "looks the same upside down"),
    ],
)
def test_targets_that_are_none(values: dict[str, object], words: str):
    with pytest.raises(InvalidValue, match=words):
        CalibrationTarget(**values)  # type: ignore[arg-type]


def test_a_target_that_is_too_large_for_the_paper():
    with pytest.raises(InvalidValue, match="280 x 400 mm do not fit on a4, which has 184 x 261 mm"):
        target_pdf(CalibrationTarget(square=0.04, marker=0.03), "a4")
