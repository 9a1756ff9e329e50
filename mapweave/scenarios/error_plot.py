"""How far each robot's belief was from the truth, over time."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from mapweave.drawing.map_picture import colours_of
from mapweave.hybridmap.ids import MapId
from mapweave.scenarios.recording import Lost, TrialEvent
from mapweave.scenarios.trajectories import TrajectoryScore
from mapweave.storage.atomic_file import write_whole

NEAR = 0.02
"""Moments that are nearer than this share of the time of all share one label."""
PAUSE = 1.0
"""s; a longer time without a pose is a gap in the line."""
DASHES = ("-", "--", ":", "-.")
"""Of a robot's first map, second ..."""


def draw_errors(
    scores: Mapping[MapId, TrajectoryScore], moments: Sequence[TrialEvent], lost: Sequence[Lost], path: Path
) -> None:
    """Write a PNG: position error after the alignment of each map, with the events.

    Args:
        scores: of each map's trajectory.
        moments: numbered as in the report.
        lost: robots that were carried away.
        path: where.
    """
    # matplotlib is imported only for drawing.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    figure = Figure(figsize=(12, 4.5), dpi=110)
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    colours = colours_of(m.agent for m in scores)
    for when, numbers in _labels(moments):
        axes.axvline(when, color="#cccccc", linewidth=0.8, zorder=1)
        axes.annotate(
            numbers, (when, 1.0), (0, 2), xycoords=("data", "axes fraction"), textcoords="offset points",
            ha="center", fontsize=7, color="#888888",
        )  # fmt: skip
    for k, fall in enumerate(lost):
        label = "carried away" if k == 0 else None
        axes.axvline(
            fall.stamp_ns / 1e9, color="#c0392b", linewidth=1.2, linestyle=":", zorder=2, label=label
        )
    epochs: dict[str, int] = {}
    for map_id, score in sorted(scores.items()):
        number = epochs[map_id.agent] = epochs.get(map_id.agent, -1) + 1
        seconds = score.stamps_ns / 1e9
        # Where it did not map for a while, there is nothing to be drawn.
        pauses = np.flatnonzero(np.diff(seconds) > PAUSE) + 1
        axes.plot(
            np.insert(seconds, pauses, np.nan), np.insert(score.errors, pauses, np.nan),
            DASHES[number % len(DASHES)], color=colours[map_id.agent],
            linewidth=1.3, label=f"{map_id}: {score.ate_m:.3f} m", zorder=3,
        )  # fmt: skip
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("simulated time, s")
    axes.set_ylabel("position error, m")
    axes.grid(axis="y", color="#eeeeee")
    if axes.get_legend_handles_labels()[0]:
        figure.legend(loc="outside right upper", frameon=False, fontsize=9, title="map: ATE")
    # Else matplotlib draws all of it twice.
    ConstrainedLayoutEngine().execute(figure)
    image = io.BytesIO()
    figure.savefig(image, format="png")
    write_whole(path, image.getvalue())


def _labels(moments: Sequence[TrialEvent]) -> list[tuple[float, str]]:
    """Time in s and label of the moments: `3`, or `3-5` for some that would be written over one another."""
    near = NEAR * max((moment.stamp_ns for moment in moments), default=0)
    labels: list[tuple[int, int, int]] = []
    for number, moment in enumerate(moments, 1):
        if labels and moment.stamp_ns - labels[-1][0] <= near:
            labels[-1] = labels[-1][0], labels[-1][1], number
        else:
            labels.append((moment.stamp_ns, number, number))
    return [(ns / 1e9, str(first) if first == last else f"{first}-{last}") for ns, first, last in labels]
