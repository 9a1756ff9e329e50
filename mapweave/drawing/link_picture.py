"""Pictures of two nodes side by side: their landmarks, and which of them are the same."""

import io
import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from mapweave.drawing.names import plain_text
from mapweave.hybridmap.explanation import PairExplanation
from mapweave.hybridmap.node import Node
from mapweave.storage.atomic_file import write_whole

WIDTH = 12.0
"""Of a picture, inches."""
GAP = 0.06
"""Between the two images, as a share of their width."""
LINE = 0.2
"""Of a line of words, inches."""
BAD_PX = 10.0
"""Residual from which on a line has the last colour, px: depths are known to a few per cent."""


def draw_link(explanation: PairExplanation, path: Path) -> None:
    """Draw the landmarks of two nodes in their images' places; images themselves are not kept.

    Matches are joined by a thin line, those that agree on one pose by a line whose colour is their residual
    under that pose.

    Args:
        explanation: the explanation of the two.
        path: of the PNG; its folder is made if need be.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    left, right = explanation.a.camera, explanation.b.camera
    shift = left.width * (1.0 + GAP)
    across, down = shift + right.width, max(left.height, right.height)
    reason = textwrap.wrap(explanation.reason, 110)
    height = 0.84 * WIDTH * down / across + 1.7 + LINE * len(reason)
    figure = Figure(figsize=(WIDTH, height), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for node, offset in ((explanation.a, 0.0), (explanation.b, shift)):
        _draw_image(axes, node, offset)
    agree = {tuple(pair) for pair in explanation.shared.tolist()}
    rest = np.array([pair for pair in explanation.matches.tolist() if tuple(pair) not in agree], np.int64)
    ends = _ends(explanation, rest.reshape(-1, 2), shift)
    for k, (start, end) in enumerate(ends):
        label = f"{len(rest)} match and do not agree" if k == 0 else None
        axes.plot(*zip(start, end, strict=True), "-", color="#9a9a9a", linewidth=0.6, alpha=0.7, label=label)
    if len(explanation.shared):
        _draw_shared(figure, axes, explanation, shift)
    axes.set(xlim=(-4, across + 4), ylim=(down + 4, -22), aspect="equal")
    axes.set_axis_off()
    title = f"{explanation.a.id} and {explanation.b.id}: {explanation.standing}"
    if explanation.probability is not None:
        sure = explanation.probability > 0.9999
        title += ", probability over 0.9999" if sure else f", probability {explanation.probability:.4f}"
    axes.set_title("\n".join([title, *reason]), fontsize=10)
    if axes.get_legend_handles_labels()[0]:
        figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    image = io.BytesIO()
    plain_text(figure)
    # An axis that is off does not keep room for its title.
    figure.savefig(image, format="png", bbox_inches="tight", pad_inches=0.1)
    write_whole(path, image.getvalue())


def _draw_image(axes: Any, node: Node, offset: float) -> None:
    from matplotlib.patches import Rectangle

    camera, marks = node.camera, node.landmarks
    frame = Rectangle(
        (offset, 0), camera.width, camera.height, fill=True, facecolor="#f7f5f0", edgecolor="#555555"
    )
    axes.add_patch(frame)
    with_depth, without_depth = marks.has_depth, ~marks.has_depth
    first = offset == 0.0
    for chosen, face, label in (
        (with_depth, "#333333", "landmark"),
        (without_depth, "none", "landmark without a depth"),
    ):
        axes.scatter(
            marks.pixels[chosen, 0] + offset, marks.pixels[chosen, 1], s=12, facecolors=face,
            edgecolors="#333333", linewidths=0.6, zorder=3, label=label if first else None,
        )  # fmt: skip
    words = f"{node.id}, {len(marks)} landmarks"
    axes.text(offset, -6, words, fontsize=10, ha="left", va="bottom")


def _draw_shared(figure: Any, axes: Any, explanation: PairExplanation, shift: float) -> None:
    from matplotlib.collections import LineCollection
    from matplotlib.colors import Normalize

    # Landmarks behind the image have an infinite residual.
    residuals = np.nan_to_num(explanation.residuals_px, nan=np.inf)
    lines = LineCollection(
        _ends(explanation, explanation.shared, shift), cmap="viridis", norm=Normalize(0.0, BAD_PX),
        linewidths=1.3, zorder=2,
    )  # fmt: skip
    lines.set_array(np.minimum(residuals, BAD_PX))
    axes.add_collection(lines)
    # The colours are the scale's; the legend has that of no residual.
    label = f"{len(explanation.shared)} agree on one pose"
    axes.plot([], [], "-", color=lines.get_cmap()(0.0), linewidth=1.3, label=label)
    bar = figure.colorbar(lines, ax=axes, shrink=0.7, pad=0.01, extend="max")
    bar.set_label("off by, px")


def _ends(explanation: PairExplanation, pairs: Any, shift: float) -> list[tuple[Any, Any]]:
    """Ends of lines from a's landmarks to b's."""
    starts = explanation.a.landmarks.pixels[pairs[:, 0]].astype(float)
    ends = explanation.b.landmarks.pixels[pairs[:, 1]].astype(float) + np.array([shift, 0.0])
    return list(zip(starts, ends, strict=True))
