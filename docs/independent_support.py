"""Draws the picture of `independent-support.md`; its numbers are what the merge makes of what is drawn.

`make docs` runs it; by itself: `python docs/independent_support.py`.
"""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.outlier_rejection.independent_support import ChanceSupport
from mapweave.merge.outlier_rejection.pairwise_consistency import CHANCE, sort_links
from mapweave.merge.pose_graph.component import solve_graph
from mapweave.merge.pose_graph.factors import RelativePose
from mapweave.merge.pose_graph.fragments import Fragment
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.settings import ConsistencySettings

A, B, FALSE, TRUE = "#1f4e79", "#8a4b08", "#c0392b", "#1e8449"
HEARD = ChanceSupport(40.0, np.array([30.0, 8.0, 4.0, 2.0]))
"""What all other pairs of maps have shown: 40 places that look alike and are the same, 44 that are not. Of
these 30 bring one link, 8 two, 4 three and 2 four."""
STEP = PoseGaussian(Pose2(0.8, 0.0, 0.0), np.diag([0.02**2, 0.02**2, 0.01**2]))
PATH = Path(__file__).with_name("independent-support.svg")
LINK = np.diag([0.03**2, 0.03**2, 0.01**2])


def chain(agent: str, count: int, beside: float) -> Fragment:
    """A robot that drives straight on, with a node every 0.8 m."""
    ids = [NodeId(agent, 1, k) for k in range(count)]
    way = [RelativePose(a, b, STEP) for a, b in pairwise(ids)]
    return Fragment(ids[0], solve_graph(ids[0], Pose2(0.0, beside, 0.0), way), tuple(way))


def links(pairs: Sequence[tuple[int, int]], offset: int) -> list[Link]:
    """Each says that B's node number `offset` is where A begins: they agree with each other."""
    return [
        Link(
            NodeId("a", 1, i),
            NodeId("b", 1, j),
            PoseGaussian(Pose2(0.8 * (j - i - offset), 0.0, 0.0), LINK),
            evidence={"inliers": 20.0, "share": 0.6},
        )
        for i, j in pairs
    ]


def panel(axes: Axes, title: str, pairs: Sequence[tuple[int, int]], offset: int, colour: str) -> float:
    """Two maps, the links between them, and what the merge makes of these: how many false sets to expect."""
    first, second = chain("a", 14, 0.0), chain("b", 14, -2.6)
    found = sort_links(links(pairs, offset), first, second, ConsistencySettings())
    support = found.supports[0]
    expected = support.by_chance(HEARD)
    for piece, colour_of_map, name in ((first, A, "map A"), (second, B, "map B")):
        x, y = piece.graph.means[:, 0], piece.graph.means[:, 1]
        axes.plot(x, y, "-o", color=colour_of_map, markersize=4, linewidth=1.5)
        axes.text(-0.9, y[0], name, color=colour_of_map, ha="right", va="center", fontsize=9)
    for i, j in pairs:
        a, b = first.graph.means[i], second.graph.means[j]
        axes.plot([a[0], b[0]], [a[1], b[1]], color=colour, linewidth=1.3)
    # Links whose ends are neighbours at both ends are one place.
    places: list[list[tuple[int, int]]] = []
    for pair in pairs:
        near = [some for some in places if abs(some[0][0] - pair[0]) < 3 and abs(some[0][1] - pair[1]) < 3]
        if near:
            near[0].append(pair)
        else:
            places.append([pair])
    for some in places:
        for piece, ends in ((first, [i for i, _ in some]), (second, [j for _, j in some])):
            x, y = piece.graph.means[ends].mean(axis=0)[:2]
            width = 0.8 * (max(ends) - min(ends)) + 1.2
            axes.add_patch(Ellipse((x, y), width, 0.9, fill=False, color=colour, linestyle=":"))
    verdict = "joins" if expected < CHANCE else "does not join"
    axes.set_title(title, fontsize=10, loc="left")
    axes.text(
        0.0,
        -3.3,
        f"{len(pairs)} links agree, {support.places:.0f} independent\n"
        f"false sets as good, expected: {expected:.2g}  →  {verdict}",
        fontsize=9,
        va="top",
    )
    axes.set_xlim(-3.2, 11.0)
    axes.set_ylim(-4.8, 0.6)
    axes.set_aspect("equal")
    axes.axis("off")
    return expected


def main(path: Path = PATH) -> tuple[float, float]:
    """Draw; returns what false sets are expected on the left and on the right."""
    plt.rcParams["svg.hashsalt"] = "mapweave"
    figure, (left, right) = plt.subplots(1, 2, figsize=(10.0, 2.6), layout="constrained")
    one = panel(left, "One place of A looks like one of B", [(2, 9), (3, 9), (3, 10), (4, 11)], 7, FALSE)
    three = panel(right, "Three places agree on how the maps lie", [(1, 1), (6, 6), (12, 12)], 0, TRUE)
    figure.savefig(path, metadata={"Date": None})
    return one, three


if __name__ == "__main__":
    main()
