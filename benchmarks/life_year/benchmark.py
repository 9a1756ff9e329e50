"""A year of drives: one robot through the same hall every day; what does a merge take on the hundredth?

    python -m benchmarks.life_year [--drives N] [--seed N] [--false SHARE] [--nodes N] [--alone] [--json]

Only poses are drawn and links, true and false (`synthetic.drives`); a merge follows every drive.
Side by side: what was decided stands, as on the map server, and everything is decided with every drive.
Printed are seconds of the processor a merge, links that the two do not have in common, false links that are
believed, and the error of active nodes. With `--alone` only the first is run.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from dataclasses import dataclass, field

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from mapweave.evaluation.map_score import align
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.manual_constraint import ManualConstraints
from mapweave.hybridmap.node import MapId, NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.merge.islands import Islands
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.verdicts import Verdicts
from synthetic.drives import Drive, DriveSettings, drives
from synthetic.fleet import FleetSettings

LAST = 10
"""Drives over which the last merges are averaged."""


@dataclass
class Merging:
    """One way of merging day after day.

    Attributes:
        stands: whether what was decided stands.
        seconds: of the processor, of each merge.
        merged: the newest map.
    """

    stands: bool
    seconds: list[float] = field(default_factory=list)
    merged: MergedMap = field(default_factory=MergedMap.empty)
    _verdicts: Verdicts = field(default_factory=Verdicts)
    _maps: dict[MapId, HybridMap] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Nothing is merged yet."""
        self._islands = Islands() if self.stands else Islands(exact=10**9)

    def take(self, today: Drive) -> None:
        """One more drive."""
        self._maps[today.map_id] = today.map
        touched = {today.map_id}
        for link in today.links:
            self._verdicts.put(link.pair, link)
            touched |= {link.a.map, link.b.map}
        began = time.process_time()
        self.merged = self._islands.merge(self._maps, self._verdicts, touched, ManualConstraints())
        self.seconds.append(time.process_time() - began)


def main() -> None:
    """Drive, merge, print."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.life_year", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--drives", type=int, default=40, help="through the same hall (default 40)")
    parser.add_argument("--seed", type=int, default=0, help="of ways, noise and links (default 0)")
    parser.add_argument("--false", type=float, default=0.3, help="share of false links (default 0.3)")
    parser.add_argument("--nodes", type=int, default=48, help="of a drive (default 48)")
    parser.add_argument(
        "--alone", action="store_true", help="without deciding everything with every drive beside it"
    )
    parser.add_argument("--json", action="store_true", help="last line of output: one JSON object")
    a = parser.parse_args()
    if a.drives < 1 or a.nodes < 20 or a.seed < 0 or not 0.0 <= a.false < 0.95:
        print(
            "life_year: a drive at least, of 20 nodes or more; seed 0 or more; a share below 0.95",
            file=sys.stderr,
        )
        raise SystemExit(2)
    console = Console(stderr=a.json)
    figures = run(a.drives, a.seed, a.false, a.nodes, a.alone, console)
    table = Table("figure", "value", title=f"seed {a.seed}, {a.drives} drives")
    for name, value in figures.items():
        table.add_row(name, f"{value:g}")
    console.print(table)
    if a.json:
        print(json.dumps({"seed": a.seed, "drives": a.drives, "false": a.false, **figures}))


def run(
    count: int, seed: int, false_share: float, nodes: int, alone: bool, console: Console
) -> dict[str, float]:
    """All drives; see the module."""
    floor = FleetSettings(nodes=nodes, side=8.0)
    days = drives(np.random.default_rng([seed, 0xDA1]), DriveSettings(floor, false_share=false_share))
    ways = [Merging(True)] if alone else [Merging(True), Merging(False)]
    true: set[tuple[NodeId, NodeId]] = set()
    truth: dict[NodeId, Pose2] = {}
    for _ in track(range(count), "driving", console=console):
        today = next(days)
        true |= today.true
        truth |= today.truth
        for way in ways:
            way.take(today)
    figures: dict[str, float] = {"nodes": len(truth), "active": len(truth) - len(today.past)}
    for way, name in zip(ways, ("", "fresh_"), strict=False):
        links = {link.pair for link in way.merged.links}
        figures |= {
            f"{name}merge_s": round(statistics.median(way.seconds[-LAST:]), 3),
            f"{name}merge_s_most": round(max(way.seconds), 3),
            f"{name}merge_s_all": round(sum(way.seconds), 3),
            f"{name}components": len(way.merged.components),
            f"{name}links": len(links),
            f"{name}links_false": len(links - true),
            f"{name}links_missed": len(true - links),
            f"{name}active_error_m": round(error(way.merged, truth, today.past), 4),
        }
    if not alone:
        one, two = ({link.pair for link in way.merged.links} for way in ways)
        figures["links_apart"] = len(one ^ two)
    return figures


def error(merged: MergedMap, truth: dict[NodeId, Pose2], past: frozenset[NodeId]) -> float:
    """Root mean square error, m, of the active nodes, each component aligned with the truth."""
    squares: list[float] = []
    for component in merged.components:
        active = sorted(component - past)
        if len(active) > 2:
            found, real = (
                np.array([(pose.x, pose.y) for pose in poses])
                for poses in ([merged.pose(n) for n in active], [truth[n] for n in active])
            )
            squares += np.square(align(found, real).apply(found) - real).sum(axis=1).tolist()
    return float(np.sqrt(np.mean(squares))) if squares else 0.0
