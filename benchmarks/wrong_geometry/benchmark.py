"""Fleets with one robot whose map has wrong geometry and true views: answers to lost robots then.

    python -m benchmarks.wrong_geometry --seeds 0 1 2 --kinds slip carried long turns

Nothing is rendered (see benchmarks.synthetic). Three sound robots map a house; a fourth maps the same house
with one of four faults of its odometry. Lost robots then ask where they are, with and without the fourth
robot's map. The house may have two rooms that look the same: answers there must not become more certain.
"""

from __future__ import annotations

import argparse
import json
from itertools import product

from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import View
from synthetic.wrong_geometry import ODD, SCENES, Fault, draw_fleet, lost_views, outcome


def main() -> None:
    """Print a line of JSON for each fleet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--kinds", nargs="+", default=[str(one) for one in Fault if one is not Fault.NONE])
    parser.add_argument("--scenes", nargs="+", default=["room", "house"], choices=SCENES)
    parser.add_argument("--queries", type=int, default=24)
    args = parser.parse_args()
    for name, seed in product(args.scenes, args.seeds):
        scene, views, row = SCENES[name], list[tuple[View, Pose2]](), {"scene": name, "seed": seed}
        for kind in args.kinds:
            fleet = draw_fleet(seed, scene, Fault(kind))
            if not views:
                # Whatever is wrong with the fourth map, the others are the same.
                views = lost_views(fleet, scene, args.queries, seed)
                print(json.dumps({**row, "without": outcome(fleet, views, frozenset({ODD}))}), flush=True)
            print(json.dumps({**row, "fault": kind, "with": outcome(fleet, views)}), flush=True)
