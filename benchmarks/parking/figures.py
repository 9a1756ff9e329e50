"""The paper's Figures 12 to 14 of one parking: feature pixels, bearing angles, errors over time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.parking.run import LEAST_VISIBLE, ParkingOutcome, Record
from benchmarks.parking.scene import ParkingScene
from mapweave.agent.navigation.route_follower import RouteProgress

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TICK = 0.1
"""s between two rows of a record."""
LEFT_OUT = 3
"""A landmark that was tracked for fewer ticks is not drawn."""


def draw_figures(scene: ParkingScene, outcome: ParkingOutcome, folder: Path) -> list[Path]:
    """Write fig12.png, fig13.png and fig14.png of one parking.

    Args:
        scene: where it took place.
        outcome: with its record.
        folder: where to; it is there.

    Returns:
        The files.
    """
    # Only who draws pays for matplotlib.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    paths = []
    for name, draw, size, rows in (
        ("fig12", _pixels, (8.0, 7.0), 1),
        ("fig13", _bearings, (9.0, 6.0), 2),
        ("fig14", _errors, (9.0, 8.0), 3),
    ):
        figure = Figure(figsize=size, dpi=110, layout="constrained")
        FigureCanvasAgg(figure)
        axes = np.atleast_1d(figure.subplots(rows, 1, sharex=rows > 1))
        draw(scene, outcome, axes)
        paths.append(folder / f"{name}.png")
        figure.savefig(paths[-1], format="png")
    return paths


def _pixels(scene: ParkingScene, outcome: ParkingOutcome, axes: Any) -> None:
    """Figure 12: the way of each landmark in the image, from where it is first tracked to the end."""
    ax: Axes = axes[0]
    camera, pixels = scene.goal.camera, np.array(outcome.record.pixels)
    for track in _drawn(pixels):
        way = pixels[:, track]
        seen = np.flatnonzero(np.isfinite(way[:, 0]))
        (line,) = ax.plot(way[:, 0], way[:, 1], linewidth=0.7)
        ax.plot(*way[seen[0]], "o", markersize=3, color=line.get_color(), fillstyle="none")
        ax.plot(*way[seen[-1]], "o", markersize=3.5, color=line.get_color())
    wanted = scene.goal.landmarks.pixels
    ax.plot(wanted[:, 0], wanted[:, 1], "k+", markersize=5, label="in the goal's view")
    ax.plot([], [], "o", color="gray", fillstyle="none", markersize=4, label="first tracked")
    ax.plot([], [], "o", color="gray", markersize=4, label="at the end")
    ax.set(xlim=(0, camera.width), ylim=(camera.height, 0), xlabel="x, px", ylabel="y, px", aspect="equal")
    ax.set_title("Feature pixels over the parking")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3, fontsize=8, frameon=False)


def _bearings(scene: ParkingScene, outcome: ParkingOutcome, axes: Any) -> None:
    """Figure 13: bearings of the tracked landmarks with the limit, and how many there are."""
    camera, record = scene.goal.camera, outcome.record
    pixels, times = np.array(record.pixels), _times(record)
    gammas = camera.bearings(pixels.reshape(-1, 2)).reshape(pixels.shape[:2])
    for track in _drawn(pixels):
        axes[0].plot(times, gammas[:, track], linewidth=0.6)
    for side, label in ((1.0, "limit"), (-1.0, None)):
        axes[0].axhline(side * camera.semi_aperture, color="k", linestyle="--", linewidth=1.0, label=label)
    axes[0].set_ylabel("bearing, rad")
    axes[0].set_title("Bearing angles of the goal's landmarks")
    axes[0].legend(loc="upper right", fontsize=8, framealpha=0.9)
    axes[1].plot(times, np.isfinite(gammas).sum(axis=1), label="tracked", linewidth=1.2)
    axes[1].plot(times, record.seen, label="in the image by the truth", linewidth=1.0)
    axes[1].axhline(LEAST_VISIBLE, color="k", linestyle="--", linewidth=1.0, label="least while servoing")
    axes[1].set(xlabel="time, s", ylabel="landmarks", ylim=(0, None), xlim=(0, times[-1]))
    axes[1].legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, fontsize=8, frameon=False)
    for ax in axes:
        _shade(ax, record)


def _errors(scene: ParkingScene, outcome: ParkingOutcome, axes: Any) -> None:
    """Figure 14: position and heading relative to the goal, true and believed; the last part enlarged."""
    record = outcome.record
    true, believed, times = np.array(record.true), np.array(record.believed), _times(record)
    # Before the robot knows itself by the goal it may look any way: only what follows is drawn for scale.
    for k, (label, colour) in enumerate((("x", "C0"), ("y", "C1"))):
        axes[0].plot(times, true[:, k], color=colour, linewidth=1.2, label=f"{label}, true")
        axes[0].plot(times, believed[:, k], "--", color=colour, linewidth=1.0, label=f"{label}, believed")
        axes[1].plot(times, 1e3 * true[:, k], color=colour, linewidth=1.2)
        axes[1].plot(times, 1e3 * believed[:, k], "--", color=colour, linewidth=1.0)
    axes[0].set_ylabel("position, m")
    axes[0].set_title("Errors relative to the goal")
    axes[0].legend(loc="upper right", fontsize=8, ncols=2, framealpha=0.9)
    axes[1].set(ylabel="position, mm (enlarged)", ylim=(-40.0, 40.0))
    axes[2].plot(times, np.degrees(true[:, 2]), color="C2", linewidth=1.2, label="true")
    axes[2].plot(times, np.degrees(believed[:, 2]), "--", color="C2", linewidth=1.0, label="believed")
    axes[2].set(ylabel="heading, deg", xlabel="time, s", xlim=(0, times[-1]))
    axes[2].legend(loc="upper right", fontsize=8, framealpha=0.9)
    for ax in axes:
        ax.axhline(0.0, color="#999999", linewidth=0.6)
        ax.grid(axis="y", color="#eeeeee")
        _shade(ax, record)


def _times(record: Record) -> Any:
    return TICK * np.arange(len(record.true))


def _drawn(pixels: Any) -> list[int]:
    """Landmarks that were tracked for a while."""
    ticks = np.isfinite(pixels[..., 0]).sum(axis=0)
    return [int(track) for track in np.flatnonzero(ticks >= LEFT_OUT)]


def _shade(ax: Axes, record: Record) -> None:
    """Grey where the robot does not servo yet: it finds itself, or drives to where it sees the goal."""
    servoing = np.array(
        [doing.startswith((RouteProgress.PARKING, RouteProgress.ARRIVED)) for doing in record.doing]
    )
    edges = np.flatnonzero(np.diff(np.concatenate([[True], servoing, [True]]).astype(int)))
    for begin, end in edges.reshape(-1, 2):
        ax.axvspan(TICK * begin, TICK * end, color="#f0f0f0", zorder=0)
