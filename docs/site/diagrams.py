"""Diagrams of the tutorials: a robot as its settings file describes it, and what is sent in a fleet."""

import re
import tomllib
from collections.abc import Iterable, Sequence
from math import cos, degrees, sin
from pathlib import Path

from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import Circle, FancyBboxPatch, Polygon, Rectangle, Wedge

from mapweave.agent.drivers.arduino import ArduinoBase
from mapweave.settings import Settings
from mapweave.storage.settings_file import build

FOLDER = Path(__file__).parent


def draw_robot(path: Path) -> None:
    """The robot of the settings in docs/robot.md from above, to scale."""
    (table,) = re.findall(
        r"```toml\n(.*?)```", (FOLDER.parent / "robot.md").read_text(encoding="utf-8"), re.S
    )
    described = build(Settings, tomllib.loads(table), "robot.md").robot.describe(ArduinoBase.geometry)
    camera, axle, radius = described.camera, described.axle, described.radius
    _, axes = plt.subplots(figsize=(5.6, 3.6), dpi=90)
    axes.add_patch(Circle((0, 0), radius, fill=False, color="#333333"))
    for side in (-1, 1):
        axes.add_patch(Rectangle((-0.033, side * axle / 2 - 0.01), 0.066, 0.02, color="#333333"))
    half = degrees(camera.semi_aperture)
    lens = (camera.mount_forward, 0.0)
    axes.add_patch(Wedge(lens, 0.5, -half, half, color="#1f77b4", alpha=0.15))
    axes.add_patch(Polygon([(lens[0] + 0.02, 0), (lens[0], 0.012), (lens[0], -0.012)], color="#1f77b4"))
    axes.text(0.33, -0.12, f"camera\n{2 * half:.0f} deg wide", color="#1f77b4", ha="center", fontsize=9)
    for bearing in described.ranger_bearings:
        x, y = radius * cos(bearing), radius * sin(bearing)
        axes.annotate(
            "", (x + 0.3 * cos(bearing), y + 0.3 * sin(bearing)), (x, y), arrowprops={"arrowstyle": "->"}
        )
        axes.text(
            x + 0.32 * cos(bearing),
            y + 0.32 * sin(bearing) - 0.01,
            f"{degrees(bearing):+.0f} deg",
            fontsize=9,
        )
    for x, reach, words in ((-0.2, axle, "axle"), (-0.4, 2 * radius, "2 radius")):
        axes.annotate("", (x, -reach / 2), (x, reach / 2), arrowprops={"arrowstyle": "<->"})
        axes.text(x, reach / 2 + 0.03, f"{words} {reach:.2f} m", ha="center", fontsize=9)
    axes.set_xlim(-0.55, 0.68)
    axes.set_ylim(-0.42, 0.42)
    finish(axes, path)


def draw_fleet(path: Path) -> None:
    """What is sent in a fleet."""
    boxes = (
        (0.0, 2.0, "agent r0\nits own disk"), (0.0, 0.0, "agent r1\nits own disk"),
        (4.0, 1.0, "mapweave server\nrouter, port 7447\nlogs, merge, history"),
        (8.0, 2.0, "page\nHTTP, port 8080"), (8.0, 0.0, "mapweave status, go\nPython"),
    )  # fmt: skip
    arrows = (
        ((2.3, 2.6), (3.9, 1.9), "changes,\nquestions", (3.4, 2.6)),
        ((3.9, 1.65), (2.3, 2.3), "answers,\nmerged poses", (2.75, 1.6)),
        ((2.3, 0.5), (3.9, 1.2), "the same", (3.4, 0.6)),
        ((6.3, 1.8), (7.95, 2.4), "map, robots", (6.9, 2.4)),
        ((7.95, 0.5), (6.3, 1.2), "missions,\ncorrections", (6.8, 0.5)),
    )
    draw_boxes(path, boxes, arrows)


def draw_cluster(path: Path) -> None:
    """Which process of a cluster has what."""
    boxes = (
        (0.0, 1.0, "mapweave server\nlogs, merge, answers"), (4.0, 1.0, "gateway\nchild of the server"),
        (8.0, 2.2, "shards\nplace index, in parts"), (8.0, 1.0, "workers\ncompare nodes"),
        (8.0, -0.2, "head of the cluster\nwho is where"),
    )  # fmt: skip
    arrows = (
        ((2.3, 1.65), (3.95, 1.65), "nodes, questions", (3.1, 1.9)),
        ((3.95, 1.35), (2.3, 1.35), "similar places,\nlinks", (3.1, 0.95)),
        ((6.3, 1.8), (7.95, 2.6), "a map whole\nto one shard", (6.7, 2.75)),
        ((6.3, 1.5), (7.95, 1.5), "pairs", (7.1, 1.68)),
        ((6.3, 1.2), (7.95, 0.4), "", (7.1, 0.6)),
    )
    draw_boxes(path, boxes, arrows)


Point = tuple[float, float]


def draw_boxes(
    path: Path, boxes: Sequence[tuple[float, float, str]], arrows: Iterable[tuple[Point, Point, str, Point]]
) -> None:
    """Processes, by their lower left corners, and what is sent: from, to, words and where they stand."""
    _, axes = plt.subplots(figsize=(8.4, 3.0), dpi=90)
    for x, y, words in boxes:
        axes.add_patch(
            FancyBboxPatch((x, y), 2.2, 1.0, "round,pad=0.05", facecolor="#eef5f3", edgecolor="#2a7a6f")
        )
        axes.text(x + 1.1, y + 0.5, words, ha="center", va="center", fontsize=8)
    for begin, end, words, at in arrows:
        axes.annotate("", end, begin, arrowprops={"arrowstyle": "-|>", "color": "#333333"})
        axes.text(*at, words, ha="center", va="center", fontsize=8, color="#333333")
    axes.set_xlim(-0.2, 10.4)
    axes.set_ylim(min(y for _, y, _ in boxes) - 0.2, max(y for _, y, _ in boxes) + 1.2)
    finish(axes, path)


def finish(axes: Axes, path: Path) -> None:
    """Without axes, to scale, into a file."""
    axes.set_aspect("equal")
    axes.axis("off")
    axes.figure.savefig(path, bbox_inches="tight")
    plt.close(axes.figure)


def draw_diagrams() -> None:
    """All of them."""
    draw_robot(FOLDER / "robot.png")
    draw_fleet(FOLDER / "fleet-server.png")
    draw_cluster(FOLDER / "cluster.png")


if __name__ == "__main__":
    draw_diagrams()
