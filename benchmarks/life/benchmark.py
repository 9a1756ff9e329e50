"""The life of a map: a robot maps the same rooms again and again; how far does the fleet's map grow?

    python -m benchmarks.life [--drives N] [--seed N] [--stops N] [--moved SHARE] [--queries N] [--json]

Two rooms of random landmarks on their walls (nothing is rendered). On every drive, a new epoch of the map, a
robot goes through both: N stops at newly drawn places, with a full turn at each. Its changes go
through the server's own merger one by one, with a merge after every drive. Printed are the active
nodes after each drive; and how many of the views that are taken anywhere in the rooms, and of those that
are taken again where a drive stopped, are answered rightly (within 0.25 m and 8 degrees of the truth) from
the first drive's map, from the whole map without superseded nodes, and from all nodes. Between two drives
furniture may be moved: a share of the landmarks then is elsewhere for good, and queries are taken of the
rooms as they are at last. Times are of this process alone. Ten drives take about a minute and a half.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.life.house import House
from mapweave.hybridmap.change import Change, ChangeBody, EdgePut, NodePut
from mapweave.hybridmap.node import MapId, NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import Certainty, View
from mapweave.hybridmap.superseded import Superseded
from mapweave.mapserver.active_nodes import ActiveNodes
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.relocalization.relocalizer import Relocalizer
from mapweave.mapserver.retrieval.place_index import PlaceIndex
from mapweave.mapserver.routes import Router
from mapweave.merge.pose_graph.merged_map import MergedMap
from synthetic.world import take_map, take_view

CLOSE, CLOSE_TURN = 0.25, math.radians(8.0)
ROUTES = 40
"""Pairs of active nodes between which a route is asked for."""
LEFT_OUT = Superseded(NodeId("none", 0, 0), 0, 0.0, 0.0)
"""Marks nodes that are left out of a comparison."""


@dataclass(frozen=True)
class Drive:
    """What the map is after a drive.

    Attributes:
        nodes: active ones.
        superseded: the others.
        components: of the merged map.
        node_ms: what it took to take in a node with its edges and to compare it, ms.
        merge_s: what the last merge took, s.
    """

    nodes: int
    superseded: int
    components: int
    node_ms: float
    merge_s: float


def main() -> None:
    """Drive, count, ask, print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.life", description=__doc__.splitlines()[0])
    parser.add_argument("--drives", type=int, default=10, help="through the same rooms (default 10)")
    parser.add_argument("--seed", type=int, default=0, help="of rooms, stops and noise (default 0)")
    parser.add_argument("--stops", type=int, default=5, help="in a room on every drive (default 5)")
    parser.add_argument("--moved", type=float, default=0.0, help="share of landmarks moved after each drive")
    parser.add_argument("--queries", type=int, default=200, help="views that are asked about (default 200)")
    parser.add_argument("--json", action="store_true", help="last line of output: one JSON object")
    a = parser.parse_args()
    if a.drives < 1 or a.stops < 1 or a.queries < 1 or a.seed < 0 or not 0.0 <= a.moved <= 1.0:
        print("life: at least one drive, stop and query; seed 0 or more; a share of 0 to 1", file=sys.stderr)
        raise SystemExit(2)
    console = Console(stderr=a.json)
    figures, drives = run(a.drives, a.seed, a.stops, a.moved, a.queries, console)
    columns = "drive", "nodes", "superseded", "components", "ms a new node", "last merge s"
    table = Table(*columns, title=f"seed {a.seed}")
    for number, one in enumerate(drives, start=1):
        counts = map(str, (number, one.nodes, one.superseded, one.components))
        table.add_row(*counts, f"{one.node_ms:.1f}", f"{one.merge_s:.2f}")
    console.print(table)
    totals = Table("figure", "value")
    for name, value in figures.items():
        if not isinstance(value, list):
            totals.add_row(name, f"{value:g}")
    console.print(totals)
    if a.json:
        print(json.dumps({"seed": a.seed, "drives": a.drives, **figures}))


def run(
    drives: int, seed: int, stops: int, moved: float, queries: int, console: Console
) -> tuple[dict[str, float | list[float]], list[Drive]]:
    """All drives, then the questions; see the module."""
    rng = np.random.default_rng([seed, 0x11FE])
    house = House.built(rng)
    merger, merged, curve = Merger(), MergedMap.empty(), list[Drive]()
    truth: dict[NodeId, Pose2] = {}
    first_nodes: frozenset[NodeId] = frozenset()
    for epoch in track(range(1, drives + 1), "driving", console=console):
        if epoch > 1 and moved:
            house = house.refurnished(moved, rng)
        tour = house.tour(stops, rng)
        nodes, edges = take_map(house, MapId("r0", epoch), tour, rng)
        truth |= {node.id: pose for node, pose in zip(nodes, tour, strict=True)}
        bodies: list[ChangeBody] = [*map(NodePut, nodes), *map(EdgePut, edges)]
        began = time.process_time()
        for number, body in enumerate(bodies, start=1):
            merger.on_change(Change(MapId("r0", epoch), number, 0, body))
        taken = time.process_time()
        merged = merger.merged()
        spent, old = time.process_time() - taken, len(merged.superseded)
        node_ms = 1e3 * (taken - began) / len(nodes)
        curve.append(Drive(len(merged.poses) - old, old, len(merged.components), node_ms, spent))
        first_nodes = first_nodes or frozenset(merged.poses)
        console.print(f"drive {epoch}: {curve[-1].nodes} nodes, {old} superseded, merged in {spent:.1f} s")
    views = [house.look(rng) for _ in range(queries)]
    stood = [truth[sorted(truth)[int(k)]] for k in rng.choice(len(truth), queries)]
    again = [(take_view(house, here, rng)[0], here) for here in stood]
    figures: dict[str, float | list[float]] = {
        "nodes_first": curve[0].nodes,
        "nodes_after": curve[-1].nodes,
        "nodes_in_all": len(merged.poses),
        "growth": round(curve[-1].nodes / curve[0].nodes, 3),
        "curve": [one.nodes for one in curve],
        "node_ms": [round(one.node_ms, 2) for one in curve],
        "merge_s": [round(one.merge_s, 2) for one in curve],
        "components": curve[-1].components,
        "routes_found": routes_found(merged, rng),
    }
    for name, hidden in (
        ("first", frozenset(truth) - first_nodes),
        ("after", frozenset(merged.superseded)),
        ("all_nodes", frozenset[NodeId]()),
    ):
        for where, asked in (("", views), ("_visited", again)):
            right, wrong = answered(merger, merged, hidden, asked, truth)
            figures |= {f"recall{where}_{name}": right, f"wrong{where}_{name}": wrong}
    return figures, curve


def answered(
    merger: Merger,
    merged: MergedMap,
    hidden: frozenset[NodeId],
    views: Sequence[tuple[View, Pose2]],
    truth: Mapping[NodeId, Pose2],
) -> tuple[float, float]:
    """Shares of views that are answered rightly and wrongly; the others are not answered."""
    shown = replace(merged, superseded=dict.fromkeys(hidden, LEFT_OUT))
    index = PlaceIndex()
    index.extend(node for one in merger.maps.values() for node in one.nodes.values() if node.id not in hidden)
    places = ActiveNodes(index, merger.node, shown)
    relocalizer = Relocalizer(places, places.node, merged)
    right = wrong = 0
    for view, world_from_robot in views:
        answer = relocalizer.answer(view)
        if answer.certainty is Certainty.FOUND:
            best = answer.candidates[0]
            off = (truth[best.node] @ best.node_from_robot.mean).inverse() @ world_from_robot
            good = off.distance(Pose2()) <= CLOSE and abs(off.heading) <= CLOSE_TURN
            right, wrong = right + good, wrong + (not good)
    return round(right / len(views), 4), round(wrong / len(views), 4)


def routes_found(merged: MergedMap, rng: np.random.Generator) -> float:
    """Share of pairs of active nodes of one component between which there is a way over active nodes."""
    router = Router(merged)
    active = [node for node in sorted(merged.poses) if node not in merged.superseded]
    found = tried = 0
    for _ in range(ROUTES):
        start, goal = (active[int(k)] for k in rng.choice(len(active), 2))
        if merged.component_of(start) == merged.component_of(goal):
            legs = router.route(start, goal).legs
            tried, found = tried + 1, found + bool(legs and {leg.node.id for leg in legs} <= set(active))
    return round(found / max(tried, 1), 4)
