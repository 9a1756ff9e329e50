"""Pictures of maps: nodes, edges and links over a floor plan."""

import io
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.drawing.names import Name, draw_names, plain_text
from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.ids import EdgeId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim.floorplan import BuildingPlan
from mapweave.storage.atomic_file import write_whole

WIDTH = 12.0
"""Of a picture, inches."""
MOST_ARROWS = 600
"""Nodes with arrows: where there are more they would hide each other."""
ARROW = 1.0 / 42.0
"""Length of an arrow as a share of the picture's width."""
ALONG = 16
"""Points along an edge that names keep clear of."""
LAYOUTS = 2
"""Passes of the layout: in the first one the axes have not yet the shape of the map, and a title of two lines
of a wide map was cut at the upper edge."""
MOST_NODES = 150
"""Nodes whose names are tried: more cannot be told apart in a picture of this width."""
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
class DrawnDrive:
    """A drive of a robot, to draw over a map.

    Attributes:
        positions: (N, 2) m.
        start: where it was put down.
        goal: where it shall end, if it was sent anywhere.
        label: for the legend.
        robot: its name, written where it was put down.
        begun: for the legend, what its start is.
    """

    positions: Array
    start: Pose2
    goal: Pose2 | None
    label: str
    robot: str = ""
    begun: str = "put down here"


@dataclass(frozen=True, eq=False)
class Backdrop:
    """An image under a map.

    Attributes:
        pixels: (H, W) grey or (H, W, 3) red, green, blue.
        lower_left: pose of its lower left corner, its x axis along the lower edge.
        metres_per_pixel: m.
        pairs: clicked places, drawn with their differences: x, y on the image and x, y on the map, m.
    """

    pixels: NDArray[np.uint8]
    lower_left: Pose2
    metres_per_pixel: float
    pairs: Sequence[tuple[tuple[float, float], tuple[float, float]]] = ()

    @property
    def corners(self) -> Array:
        """(4, 2) m."""
        height, width = self.pixels.shape[:2]
        size = self.metres_per_pixel * np.array([[0, 0], [width, 0], [width, height], [0, height]])
        return self.lower_left.apply(size)


@dataclass(frozen=True, eq=False)
class MapPicture:
    """What to draw; all in one frame.

    Attributes:
        title: above the picture.
        poses: of each node.
        edges: between nodes; those of kind MERGED are drawn as links between maps.
        outline: floor plan, may be empty.
        drives: of lost robots.
        landmarks: (N, 2) m, points that nodes see.
        starts: where each robot began.
        false: links that are known to be false; they are highlighted.
        places: positions of named places, m.
        backdrop: an image under all of it.
    """

    title: str
    poses: Mapping[NodeId, Pose2]
    edges: Sequence[Edge]
    outline: Outline = field(default_factory=Outline)
    drives: Sequence[DrawnDrive] = ()
    landmarks: Array = field(default_factory=lambda: np.zeros((0, 2)))
    starts: Mapping[str, Pose2] = field(default_factory=dict)
    false: frozenset[EdgeId] = frozenset()
    places: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    backdrop: Backdrop | None = None


def outline_of(plan: BuildingPlan) -> Outline:
    """The outline of a simulated building."""
    rooms = tuple((r.name if not r.name.startswith("door") else "", r.corners) for r in plan.rooms)
    return Outline(rooms, tuple(box.corners for box in (*plan.walls, *plan.furniture)))


def draw_map(picture: MapPicture, path: Path) -> None:
    """Write a PNG.

    Args:
        picture: what to draw.
        path: where; its folder is made if need be.
    """
    # Matplotlib takes half a second to import and is an extra: so it is imported here.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    figure = Figure(figsize=(WIDTH, _height(picture)), dpi=110)
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    draw_on(axes, picture)
    if axes.get_legend_handles_labels()[0]:
        # Below the plan, wherever that ends: the layout makes room for it.
        figure.legend(loc="outside lower center", ncols=6, frameon=False, fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    image = io.BytesIO()
    plain_text(figure)
    # Laid out here: matplotlib would do it again, and draw all of it once more, for each file.
    layout = ConstrainedLayoutEngine()
    for _ in range(LAYOUTS):
        layout.execute(figure)
    axes.apply_aspect()
    draw_names(axes, _names(picture), _marks(picture))
    plain_text(figure)
    figure.savefig(image, format="png")
    write_whole(path, image.getvalue())


def draw_on(axes: Any, picture: MapPicture) -> None:
    """Draw into a picture of one's own."""
    _draw_outline(axes, picture.outline)
    if picture.backdrop is not None:
        _draw_backdrop(axes, picture.backdrop)
    if len(picture.landmarks):
        axes.plot(*picture.landmarks.T, ".", color="#999999", markersize=1.2, zorder=1, alpha=0.6)
    colours = colours_of([*(n.agent for n in picture.poses), *picture.starts])
    _draw_edges(axes, picture, colours)
    _draw_nodes(axes, picture, colours)
    _draw_starts(axes, picture.starts, colours)
    _draw_drives(axes, picture.drives)
    for x, y in picture.places.values():
        axes.plot(x, y, "D", color="#222222", markersize=6, markeredgecolor="white", zorder=6)
    axes.set_aspect("equal")
    left, right, bottom, top = bounds_of(picture)
    axes.set(xlim=(left, right), ylim=(bottom, top))
    _draw_scale(axes)
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")
    axes.set_title(picture.title)


def bounds_of(picture: MapPicture) -> tuple[float, float, float, float]:
    """Left, right, bottom and top, m: all but landmarks that lie far from the others.

    Depths of some landmarks are wrong by far. Those beyond the middle nine tenths by more than a quarter of
    these do not widen the picture: landmarks that are evenly spread all stay in.
    """
    shown = [corners for _, corners in picture.outline.rooms] + list(picture.outline.solids)
    shown += [drive.positions for drive in picture.drives]
    poses = [*picture.poses.values(), *picture.starts.values()]
    shown.append(np.array([[pose.x, pose.y] for pose in poses]).reshape(-1, 2))
    shown.append(np.array([*picture.places.values()]).reshape(-1, 2))
    if picture.backdrop is not None:
        shown.append(picture.backdrop.corners)
    if len(picture.landmarks):
        low, high = np.percentile(picture.landmarks, [5, 95], axis=0)
        more = 0.25 * (high - low)
        shown.append(np.clip([low - more, high + more], picture.landmarks.min(0), picture.landmarks.max(0)))
    points = np.concatenate(shown)
    if not len(points):
        return -1.0, 1.0, -1.0, 1.0
    low, high = points.min(axis=0), points.max(axis=0)
    margin = max(0.04 * float((high - low).max()), 0.3)
    (left, bottom), (right, top) = (low - margin).tolist(), (high + margin).tolist()
    return left, right, bottom, top


def _names(picture: MapPicture) -> list[Name]:
    """What is written, most important first: places, robots, then nodes, evenly spread."""
    names = [Name(name, x, y, "#222222", 11, True) for name, (x, y) in picture.places.items()]
    colours = colours_of([*(n.agent for n in picture.poses), *picture.starts])
    nodes = sorted(picture.poses)
    begun = {node.agent: picture.poses[node] for node in reversed(nodes)} | dict(picture.starts)
    for robot, pose in sorted(begun.items()):
        names.append(Name(robot, pose.x, pose.y, colours[robot], 11, True))
    # Every second node, then those half-way between, and so on: wherever it ends, it is even.
    digits = max(len(nodes) - 1, 1).bit_length()
    order = sorted(range(len(nodes)), key=lambda k: f"{k:0{digits}b}"[::-1])
    for node in (nodes[k] for k in order[:MOST_NODES]):
        pose = picture.poses[node]
        names.append(Name(str(node), pose.x, pose.y, colours[node.agent], 6.5))
    return names


def _marks(picture: MapPicture) -> Array:
    """Points that names keep clear of: nodes, where they look, and along edges; (N, 2) m."""
    left, right, _, _ = bounds_of(picture)
    points = np.array([pose.vector for pose in picture.poses.values()]).reshape(-1, 3)
    ahead = (right - left) * ARROW * np.stack([np.cos(points[:, 2]), np.sin(points[:, 2])], axis=1)
    known = [edge for edge in picture.edges if edge.a in picture.poses and edge.b in picture.poses]
    ends = np.array(
        [[(pose.x, pose.y) for pose in (picture.poses[e.a], picture.poses[e.b])] for e in known]
    ).reshape(-1, 2, 2)
    along = np.linspace(0.0, 1.0, ALONG)[:, None, None]
    return np.concatenate(
        [
            points[:, :2],
            *(points[:, :2] + share * ahead for share in (0.5, 1.0) if not _crowded(picture)),
            ((1.0 - along) * ends[:, 0] + along * ends[:, 1]).reshape(-1, 2),
        ]
    )


def _height(picture: MapPicture) -> float:
    """The height of the figure, inches: as the map needs it, within reason."""
    left, right, bottom, top = bounds_of(picture)
    width, height = right - left, top - bottom
    legend = 0.25 * math.ceil((len(picture.starts) + 6) / 6)
    return float(np.clip(0.92 * WIDTH * height / max(width, 1e-6), 4.5, 12.0) + 1.0 + legend)


def _draw_outline(axes: Any, outline: Outline) -> None:
    for name, corners in outline.rooms:
        axes.fill(*corners.T, color="#f6f3ec", zorder=0)
        middle = corners.mean(axis=0)
        axes.text(*middle, name, color="#b8b0a0", fontsize=13, ha="center", va="center", zorder=0.2)
    for corners in outline.solids:
        axes.fill(*corners.T, color="#cfc8ba", edgecolor="#a79f8f", linewidth=0.5, zorder=0.4)


def _draw_backdrop(axes: Any, backdrop: Backdrop) -> None:
    from matplotlib.image import AxesImage
    from matplotlib.transforms import Affine2D

    height, width = backdrop.pixels.shape[:2]
    pose, scale = backdrop.lower_left, backdrop.metres_per_pixel
    # Not by `imshow`, which takes the limits of the axes from pixels before the transform.
    image = AxesImage(axes, cmap="gray", norm=None, extent=(0, width, 0, height), interpolation="antialiased")
    image.set_data(backdrop.pixels)
    image.set_clim(0, 255)
    image.set(alpha=0.75, zorder=0.5)
    image.set_transform(
        Affine2D().scale(scale).rotate(pose.heading).translate(pose.x, pose.y) + axes.transData
    )
    axes.add_artist(image)
    for number, (on_plan, on_map) in enumerate(backdrop.pairs, 1):
        first = number == 1
        axes.plot(*zip(on_plan, on_map, strict=True), "-", color="#c0392b", linewidth=2.0, zorder=6)
        axes.plot(
            *on_plan, "o", color="none", markeredgecolor="#c0392b", markersize=11, markeredgewidth=1.8,
            zorder=6, label="clicked pair" if first else None,
        )  # fmt: skip
        axes.annotate(
            str(number), on_plan, (9, 9), textcoords="offset points", fontsize=10, fontweight="bold",
            color="#c0392b", zorder=7,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 1},
        )  # fmt: skip


def _draw_scale(axes: Any) -> None:
    """A bar of a round length at the lower right, within the picture."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    length = max((m for m in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50) if m < (right - left) / 6), default=0.1)
    end, height = right - 0.02 * (right - left), bottom + 0.02 * (top - bottom)
    # The bar must not make the picture larger.
    axes.set(xlim=(left, right), ylim=(bottom, top))
    axes.plot([end - length, end], [height, height], "-", color="#222222", linewidth=4, solid_capstyle="butt")
    axes.annotate(
        f"{length:g} m", (end - length, height), (-4, 0), textcoords="offset points", ha="right", va="center",
        fontsize=9, color="#222222",
    )  # fmt: skip


def _draw_edges(axes: Any, picture: MapPicture, colours: Mapping[str, str]) -> None:
    from matplotlib.collections import LineCollection

    segments: dict[tuple[str, str, float, float, float, str], list[tuple[tuple[float, float], ...]]] = {}
    for edge in picture.edges:
        if edge.a not in picture.poses or edge.b not in picture.poses:
            continue
        a, b = picture.poses[edge.a], picture.poses[edge.b]
        if edge.id in picture.false:
            style = "false link", "#000000", 2.2, 1.0, 4.5, ":"
        elif edge.kind is EdgeKind.MERGED:
            style = "link between maps", "#e6007e", 1.6, 0.9, 4.0, "-"
        elif edge.kind is EdgeKind.LOOP:
            style = "loop within a map", "#7a7a7a", 1.0, 0.6, 2.0, "-"
        else:
            style = "", colours[edge.a.agent], 1.0, 0.6, 2.0, "-"
        segments.setdefault(style, []).append(((a.x, a.y), (b.x, b.y)))
    for (label, colour, width, alpha, order, dashes), lines in segments.items():
        axes.add_collection(
            LineCollection(
                lines, colors=colour, linewidths=width, alpha=alpha, zorder=order, linestyles=dashes,
                label=label or None,
            )
        )  # fmt: skip


def _crowded(picture: MapPicture) -> bool:
    return len(picture.poses) > MOST_ARROWS


def _draw_nodes(axes: Any, picture: MapPicture, colours: Mapping[str, str]) -> None:
    crowded = _crowded(picture)
    for agent, colour in colours.items():
        own = np.array([p.vector for n, p in picture.poses.items() if n.agent == agent])
        if not len(own):
            continue
        if not crowded:
            axes.quiver(
                own[:, 0], own[:, 1], np.cos(own[:, 2]), np.sin(own[:, 2]), color=colour,
                angles=np.degrees(own[:, 2]), scale=1.0 / ARROW, width=0.0022, headwidth=4, zorder=3,
            )  # fmt: skip
        label = f"{agent}: {counted(len(own), 'node')}"
        size = 2 if crowded else 4
        axes.plot(own[:, 0], own[:, 1], "o", color=colour, markersize=size, zorder=3, label=label)


def _draw_starts(axes: Any, starts: Mapping[str, Pose2], colours: Mapping[str, str]) -> None:
    for k, (robot, pose) in enumerate(starts.items()):
        axes.plot(
            pose.x, pose.y, "s", color=colours[robot], markersize=9, markeredgecolor="white", zorder=5,
            label="start" if k == 0 else None,
        )  # fmt: skip


def _draw_drives(axes: Any, drives: Sequence[DrawnDrive]) -> None:
    labelled = set()
    for drive in drives:
        axes.plot(*drive.positions.T, "--", color="black", linewidth=1.8, zorder=5, label=drive.label)
        for pose, mark, label in ((drive.start, "X", drive.begun), (drive.goal, "*", "goal")):
            if pose is None:
                continue
            axes.plot(
                pose.x, pose.y, mark, color="black", markersize=14, markerfacecolor="gold", zorder=6,
                label=None if label in labelled else label,
            )  # fmt: skip
            labelled.add(label)
        if drive.robot:
            axes.annotate(
                drive.robot, (drive.start.x, drive.start.y), (9, 6), textcoords="offset points", fontsize=10,
                fontweight="bold", zorder=7,
                bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 1},
            )  # fmt: skip
