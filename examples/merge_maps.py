"""Merge maps of robots: `python examples/merge_maps.py [MAP.mapweave MAP.mapweave ...]`.

Without maps it takes those of two robots in the simulator, which have mapped the same room.
"""

import sys
from pathlib import Path

import mapweave.extras

mapweave.extras.exit_without("sim", "server")
from drive_in_simulator import FOLDER, drive

paths = [Path(word) for word in sys.argv[1:]] or [drive("r0"), drive("r1")]
office = mapweave.FileMap(mapweave.merge_map_files(paths))
print(office)
for pair in office.explain_maps():
    print(f"{pair.first} and {pair.second}: {'one map' if pair.joined else 'apart'}: {pair.reason}")
for a, b, link in office.graph().edges(data=True):
    if link["kind"] == "merged":
        print(f"{a} and {b}: {link['inliers']:.0f} landmarks agree, p = {link['probability']:.3f}")

first, *_, last = office.nodes.ids
route = office.route(first, last)
print(f"from {first} to {last}: {route.reason}")
for hop in route.hops:
    print(f"  {hop.a} -> {hop.b}: {hop.distance:.2f} m, {hop.words}")

office.save(FOLDER / "office.mapweave")
print(FOLDER / "office.mapweave", office.hash[:12])
