"""Pictures of maps: nodes, edges and links over a floor plan."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hybridmap.node import Edge, EdgeKind, NodeId
from hybridmap.pose import Array, Pose2
from sim.floorplan import FloorPlan

_PARTS = re.compile(r"[0-9]+|[^0-9]+")
COLOURS = (
    "#1f77b4", "#d95f02", "#2a9d4b", "#8e44ad", "#c0392b", "#16a0a0", "#b8860b", "#555555",
    "#7fb3d5", "#f5b041", "#82c99a", "#c39bd3", "#6e2c00", "#0b5345", "#1a237e", "#9aa7b0",
)  # fmt: skip


def colours_of(robots: Iterable[str]) -> dict[str, str]:
    """A colour like `#1f77b4` for each robot, the same in every picture and film: r2 comes before r10."""
    ordered = sorted(
        set(robots), key=lambda n: [(len(p), p) if p.isdigit() else (0, p) for p in _PARTS.findall(n)]
    )
    return {name: COLOURS[k % len(COLOURS)] for k, name in enumerate(ordered)}


@dataclass(frozen=True)
class Outline:
    """A floor plan to draw under a map.

    Attributes:
        rooms: name and (N, 2) m corners.
        solids: (N, 2) m corners of walls and furniture.
    """

    rooms: tuple[tuple[str, Array], ...] = ()
    solids: tuple[Array, ...] = ()


@dataclass(frozen=True, eq=False)
class Drive:
    """A drive to draw over a map.

    Attributes:
        positions: (N, 2) m.
        start: where it began.
        goal: where it shall end.
        label: for the legend.
    """

    positions: Array
    start: Pose2
    goal: Pose2
    label: str


@dataclass(frozen=True, eq=False)
class MapPicture:
    """What to draw; all in one frame.

    Attributes:
        title: above the picture.
        postures: of each node.
        edges: between nodes; those of kind MERGED are drawn as links between maps.
        outline: floor plan, may be empty.
        drive: of the lost robot, if there was one.
        landmarks: (N, 2) m, points that nodes see.
    """

    title: str
    postures: Mapping[NodeId, Pose2]
    edges: Sequence[Edge]
    outline: Outline = field(default_factory=Outline)
    drive: Drive | None = None
    landmarks: Array = field(default_factory=lambda: np.zeros((0, 2)))


def outline_of(plan: FloorPlan) -> Outline:
    """The outline of a simulated building."""
    rooms = tuple((r.name if not r.name.startswith("door") else "", r.corners) for r in plan.rooms)
    return Outline(rooms, tuple(box.corners for box in (*plan.walls, *plan.furniture)))


def draw_map(picture: MapPicture, path: Path) -> None:
    """Write a PNG.

    Args:
        picture: what to draw.
        path: where; its folder is made if need be.
    """
    # Matplotlib takes half a second to import and is an extra: only who draws pays for it.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 8), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    _draw_outline(axes, picture.outline)
    if len(picture.landmarks):
        axes.plot(*picture.landmarks.T, ".", color="#999999", markersize=1.2, zorder=1, alpha=0.6)
    colours = {
        agent: COLOURS[k % len(COLOURS)]
        for k, agent in enumerate(sorted({n.agent for n in picture.postures}))
    }
    _draw_edges(axes, picture, colours)
    _draw_nodes(axes, picture, colours)
    if picture.drive is not None:
        _draw_drive(axes, picture.drive)
    axes.set_aspect("equal")
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")
    axes.set_title(picture.title)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.07), ncols=6, frameon=False, fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, format="png")


def _draw_outline(axes: Any, outline: Outline) -> None:
    for name, corners in outline.rooms:
        axes.fill(*corners.T, color="#f6f3ec", zorder=0)
        middle = corners.mean(axis=0)
        axes.text(*middle, name, color="#b8b0a0", fontsize=13, ha="center", va="center", zorder=0.2)
    for corners in outline.solids:
        axes.fill(*corners.T, color="#cfc8ba", edgecolor="#a79f8f", linewidth=0.5, zorder=0.4)


def _draw_edges(axes: Any, picture: MapPicture, colours: Mapping[str, str]) -> None:
    labelled = set()
    for edge in picture.edges:
        if edge.a not in picture.postures or edge.b not in picture.postures:
            continue
        a, b = picture.postures[edge.a], picture.postures[edge.b]
        between = edge.a.map != edge.b.map
        loop = edge.kind is EdgeKind.LOOP
        colour = "#e6007e" if between else "#7a7a7a" if loop else colours[edge.a.agent]
        label = "link between maps" if between else "loop within a map" if loop else None
        axes.plot(
            [a.x, b.x], [a.y, b.y], "-", color=colour, linewidth=1.6 if between else 1.0,
            alpha=0.9 if between else 0.6, zorder=4 if between else 2,
            label=None if label in labelled else label,
        )  # fmt: skip
        labelled.add(label)


def _draw_nodes(axes: Any, picture: MapPicture, colours: Mapping[str, str]) -> None:
    for agent, colour in colours.items():
        own = np.array([p.vector for n, p in picture.postures.items() if n.agent == agent])
        axes.quiver(
            own[:, 0], own[:, 1], np.cos(own[:, 2]), np.sin(own[:, 2]), color=colour,
            angles=np.degrees(own[:, 2]), scale=42, width=0.0022, headwidth=4, zorder=3,
        )  # fmt: skip
        label = f"{agent}: {len(own)} nodes"
        axes.plot(own[:, 0], own[:, 1], "o", color=colour, markersize=4, zorder=3, label=label)


def _draw_drive(axes: Any, drive: Drive) -> None:
    axes.plot(*drive.positions.T, "--", color="black", linewidth=1.8, zorder=5, label=drive.label)
    for pose, mark, label in ((drive.start, "X", "put down here"), (drive.goal, "*", "goal")):
        axes.plot(
            pose.x, pose.y, mark, color="black", markersize=14, markerfacecolor="gold", zorder=6, label=label
        )
