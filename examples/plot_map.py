"""Load a map, or drive a simulated robot, and plot it: `python examples/plot_map.py [MAP.mapweave]`."""

import sys
from pathlib import Path

import mapweave.extras

mapweave.extras.exit_without("sim", "server", "viz")
import matplotlib as mpl
import networkx as nx
from drive_in_simulator import FOLDER, drive

mpl.use("agg")  # a picture in a file; leave this out in a notebook

office = mapweave.open(Path(sys.argv[1]) if sys.argv[1:] else drive("r0"))
print(office, office.hash[:12])

nodes, graph = office.nodes, office.graph()  # columns, which are NumPy arrays; a graph of networkx
for name, x, y, sigma in zip(nodes.ids, nodes.x, nodes.y, nodes.sigma, strict=True):
    print(f"{name}: {x:+.2f} {y:+.2f} m, +- {1000 * max(sigma[:2]):.0f} mm")

print(f"{graph.number_of_edges()} edges, {nx.number_connected_components(graph)} component")
first, *_, last = nodes.ids
print(" -> ".join(nx.shortest_path(graph, first, last, weight="length")))
print(office.route(first, last).reason)  # what a robot would drive, and why

axes = office.plot()
axes.set_title("An office, by one robot")
axes.figure.savefig(FOLDER / "map.png", dpi=110)
print(FOLDER / "map.png")
