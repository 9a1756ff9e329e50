"""Pictures of the drives: desired against reached views (the paper's Figure 11), and the ways driven."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.navigate.drives import NavigationOutcome
from benchmarks.navigate.office import ROBOT, Mapped
from mapweave.drawing.map_picture import DrawnDrive, MapPicture, draw_map, outline_of
from mapweave.sim.floorplan import BuildingPlan

MOST = 6
"""Drives whose views are shown: failures first, then the first ones."""
GAIN = 3.0
"""By how much the difference of two views is exaggerated."""


def draw(
    outcomes: Sequence[NavigationOutcome], mapped: Mapped, plan: BuildingPlan, folder: Path
) -> tuple[Path, ...]:
    """Write fig11.png and drives.png into a folder that is there; returns their names."""
    views, ways = folder / "fig11.png", folder / "drives.png"
    _draw_views(outcomes, views)
    _draw_ways(outcomes, mapped, plan, ways)
    return views, ways


def _draw_views(outcomes: Sequence[NavigationOutcome], path: Path) -> None:
    """Figure 11: a drive a row: desired view, reached view, their difference."""
    # It takes long to import, which tests that draw nothing do not wait for.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    numbers = sorted(range(len(outcomes)), key=lambda k: (outcomes[k].success, k))[:MOST]
    figure = Figure(figsize=(10, 2.75 * len(numbers)), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    rows = figure.subplots(len(numbers), 3, squeeze=False)
    for row, number in zip(rows, numbers, strict=True):
        one = outcomes[number]
        pictures: list[tuple[str, NDArray[np.uint8]]] = [
            (f"drive {number + 1}: desired, node {one.plot.goal}", one.desired),
            (f"reached, {one.error_m * 1000:.0f} mm and {one.error_deg:.2f}° off", one.reached),
            (f"difference, times {GAIN:g}", _difference(one)),
        ]
        for axes, (title, picture) in zip(row, pictures, strict=True):
            axes.imshow(picture, cmap="gray", vmin=0, vmax=255)
            axes.set_title(title, fontsize=9, color="#222222" if one.success else "#c0392b")
            axes.set_axis_off()
    figure.suptitle("Desired and reached views (Figure 11)", fontsize=11)
    figure.savefig(path, format="png")


def _difference(one: NavigationOutcome) -> NDArray[np.uint8]:
    """Grey where the views are the same."""
    off = one.reached.astype(np.float64) - one.desired.astype(np.float64)
    return np.clip(128.0 + GAIN * off, 0, 255).astype(np.uint8)


def _draw_ways(outcomes: Sequence[NavigationOutcome], mapped: Mapped, plan: BuildingPlan, path: Path) -> None:
    drives = tuple(
        DrawnDrive(
            one.track,
            one.plot.world_from_robot,
            one.plot.world_from_goal,
            f"{k + 1}: {one.driven:.1f} m" + ("" if one.success else ", failed"),
            f"{k + 1}",
        )
        for k, one in enumerate(outcomes)
    )
    reached = sum(one.success for one in outcomes)
    draw_map(
        MapPicture(
            title=f"{reached} of {len(outcomes)} drives of {ROBOT} from unmapped poses end at their goals",
            poses=mapped.truth,
            edges=tuple(mapped.nodes.edges.values()),
            outline=outline_of(plan),
            drives=drives,
        ),
        path,
    )
