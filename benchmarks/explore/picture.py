"""Floor mapped over time, a panel for each number of robots."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.explore.area import MappedFloor

COLOURS = {"random": "#999999", "ours": "#1f77b4", "fleet": "#d35400"}


def draw(mapped: Mapping[str, Mapping[int, MappedFloor]], minutes: float, seed: int, out: Path) -> Path:
    """Write a PNG into a folder, which is made; returns its path.

    Args:
        mapped: what each strategy's fleets mapped, by the number of robots.
        minutes: how long they explored.
        seed: for the name and the title.
        out: the folder.
    """
    counts = sorted({count for floors in mapped.values() for count in floors})
    figure = Figure(figsize=(4.2 * len(counts) + 0.6, 4.0), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(counts), sharey=True, squeeze=False)[0]
    times = np.linspace(0.0, minutes * 60.0, 600)
    for axes, count in zip(panels, counts, strict=True):
        for name, floors in mapped.items():
            if count not in floors:
                continue
            floor = floors[count]
            axes.plot(times / 60.0, [floor.area(t) for t in times], color=COLOURS[name], label=name)
            whole = floor.whole
        axes.axhline(whole, color="#cccccc", linewidth=1.0, linestyle="--")
        axes.annotate(
            "all of it", (0.0, whole), (3, -10), textcoords="offset points", color="#888888", fontsize=8
        )
        axes.set_title(f"{count} {'robots' if count > 1 else 'robot'}")
        axes.set_xlabel("minutes")
        axes.set_xlim(0.0, minutes)
        axes.set_ylim(0.0, 1.05 * whole)
        axes.legend(loc="upper left", bbox_to_anchor=(0.0, 0.93), frameon=False)
    panels[0].set_ylabel("floor that nodes show, m²")
    figure.suptitle(f"office, seed {seed}")
    out.mkdir(parents=True, exist_ok=True)
    path = out / f"explore-{seed}.png"
    figure.savefig(path)
    return path
