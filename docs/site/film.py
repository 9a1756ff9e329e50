"""Films of the tutorials, as GIF: maps of the recorded fleet as they grow, merged as robots' maps are."""

from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.collections import LineCollection

from mapweave.drawing.map_picture import colours_of
from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.manual_constraint import ManualConstraints
from mapweave.offline_merge import merge_parts
from mapweave.recorded_fleet.recording import recorded_maps

FRAMES = 36
LAST = 8
"""Frames for which the end stands still."""
EVERY_MS = 160


def draw_film(robots: tuple[str, ...], path: Path) -> None:
    """The maps of some robots node by node; links between them as soon as both ends are there."""
    changes = {map_id: kept for map_id, kept in recorded_maps().items() if map_id.agent in robots}
    merged = merge_parts({map_id: HybridMap(kept) for map_id, kept in changes.items()}, ManualConstraints())
    colours = colours_of(map_id.agent for map_id in changes)
    order = {
        body.node.id: (number + 1) / sum(isinstance(other, NodePut) for other in kept)
        for kept in changes.values()
        for number, body in enumerate(body for body in kept if isinstance(body, NodePut))
    }
    poses = {node: pose.mean for node, (_, pose) in merged.poses.items()}
    own = [body.edge for kept in changes.values() for body in kept if isinstance(body, EdgePut)]
    lines = [
        (max(order[edge.a], order[edge.b]), [(poses[end].x, poses[end].y) for end in (edge.a, edge.b)], edge)
        for edge in [*own, *merged.links]
        if edge.a in poses and edge.b in poses
    ]
    places = np.array([(pose.x, pose.y) for pose in poses.values()])
    least, most = places.min(axis=0) - 0.7, places.max(axis=0) + 0.7
    width, height = most - least
    figure, axes = plt.subplots(figsize=(5.6, 5.4 * height / width + 0.4), dpi=90)
    figure.subplots_adjust(0.01, 0.02, 0.99, 1.0 - 0.35 / figure.get_figheight())

    def frame(number: int) -> None:
        now = min(1.0, (number + 1) / FRAMES)
        axes.clear()
        axes.set_aspect("equal")
        axes.set_xlim(least[0], most[0])
        axes.set_ylim(least[1], most[1])
        axes.set_xticks([])
        axes.set_yticks([])
        for between, colour, width in ((False, "#b0b0b0", 0.9), (True, "magenta", 0.8)):
            shown = [
                line for when, line, edge in lines if when <= now and (edge.a.map != edge.b.map) is between
            ]
            axes.add_collection(LineCollection(shown, colors=colour, linewidths=width))
        for map_id in changes:
            seen = [node for node in poses if node.map == map_id and order[node] <= now]
            axes.scatter(
                [poses[n].x for n in seen], [poses[n].y for n in seen], s=9, color=colours[map_id.agent]
            )
            if seen and now < 1.0:
                last = poses[max(seen, key=lambda node: order[node])]
                ahead = 0.7 * np.array([np.cos(last.heading), np.sin(last.heading)])
                axes.annotate(
                    "", (last.x + ahead[0], last.y + ahead[1]), (last.x, last.y),
                    arrowprops={"arrowstyle": "-|>", "color": colours[map_id.agent], "lw": 2},
                )  # fmt: skip
        links = sum(when <= now and edge.a.map != edge.b.map for when, _, edge in lines)
        words = f"{sum(when <= now for when in order.values())} nodes"
        axes.set_title(words + (f", {links} links between the maps" if len(changes) > 1 else ""), fontsize=10)

    film = FuncAnimation(figure, frame, frames=FRAMES + LAST, init_func=lambda: None)
    film.save(path, PillowWriter(fps=round(1000 / EVERY_MS)))
    plt.close(figure)


if __name__ == "__main__":
    for name, robots in (("one-robot", ("ada",)), ("two-robots", ("ada", "bo"))):
        draw_film(robots, Path(__file__).with_name(f"{name}.gif"))
