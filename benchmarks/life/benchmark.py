"""The life of a map: a robot maps the same rooms again and again; how far does the fleet's map grow?

    python -m benchmarks.life [--drives N] [--seed N] [--stops N] [--moved SHARE] [--queries N]
                              [--keep-days DAYS] [--json]

Two rooms of random landmarks on their walls (nothing is rendered). On every drive, a new epoch of the map, a
robot goes through both: N stops at newly drawn places, with a full turn at each. Its changes go
through the server's own merger one by one, with a merge after every drive. Printed are the active
nodes after each drive; and how many of the views that are taken anywhere in the rooms, and of those that
are taken again where a drive stopped, are answered rightly (within 0.25 m and 8 degrees of the truth) from
the map after one drive and after ten, from the map in the end, and from that with its superseded nodes. The
same views are asked each time: `recall_change` is the share that is answered rightly in the end and was not
after ten drives, less the share that was and is not any more, with the two ends of its interval of 95 %. The
interval is that of the views; how much lives differ only several seeds tell.
Between two drives furniture may be moved: a share of the landmarks then is elsewhere for good, and queries
are taken of the rooms as they are at last. Times are of this process alone. Ten drives take about a minute
and a half.

Drives are 3.65 days apart, so a hundred are a year. After each the server prunes what has been superseded
for long, in memory and in a store, and the robot drops from its journal the maps of which nothing is left.
After 60 drives and more there are also what a drive adds in the long run: the means of memory, merge, store
and journal over the last five drives by those over the five about the fiftieth. Memory is that of the
process, less what it was before the first drive.
"""

import json
import math
import time
from collections.abc import Callable, Container, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.command_line import at_least, command_line
from benchmarks.life.house import TwoRooms
from benchmarks.process_usage import held_bytes
from mapweave.agent.replication.journal import Journal
from mapweave.hybridmap.change import Change, NodeRetired
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import Certainty, View
from mapweave.hybridmap.superseded import Superseded
from mapweave.mapserver.active_nodes import ActiveNodes
from mapweave.mapserver.log.entry import ReceivedChange
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.mapserver.log.store import Store
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.merging.pruning import DAY_NS, plan_of
from mapweave.mapserver.relocalization.relocalizer import Relocalizer
from mapweave.mapserver.retrieval.place_index import PlaceIndex
from mapweave.mapserver.routes import Router
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.wire.codec import encode_change
from synthetic.maps import changes_of, numbered
from synthetic.world import take_map, take_view

CLOSE, CLOSE_TURN = 0.25, math.radians(8.0)
ROUTES = 40
"""Pairs of active nodes between which a route is asked for."""
APART = 3.65
"""Days between two drives."""
FIFTIETH, SOME = 50, 5
"""The drives with which the last ones are compared are about this one; and how many they are."""
EARLY = (1, 10)
"""Drives after which the map is asked, too."""
TWO_SIDED = 1.96
"""Standard deviations on either side of the middle of an interval of 95 %."""
LEFT_OUT = Superseded(NodeId("none", 0, 0), 0, 0.0, 0.0)
"""Marks nodes that are left out of a comparison."""


@dataclass(frozen=True)
class MapAfterDrive:
    """What the map is after a drive.

    Attributes:
        nodes: active ones.
        superseded: the others.
        components: of the merged map.
        pruned: nodes that have left the map.
        node_ms: what it took to take in a node with its edges and to compare it, ms.
        merge_s: what the last merge took, s.
        memory: of the process, bytes.
        store: what the store takes, bytes.
        journal: what the robot's journal takes, bytes.
    """

    nodes: int
    superseded: int
    pruned: int
    components: int
    node_ms: float
    merge_s: float
    memory: int
    store: int
    journal: int


def main() -> None:
    """Drive, count, ask, print."""
    parser = command_line("life", __doc__, "of rooms, stops and noise")
    parser.add_argument("--drives", type=at_least(1), default=10, help="through the same rooms (default 10)")
    parser.add_argument("--stops", type=at_least(1), default=5, help="in a room on every drive (default 5)")
    parser.add_argument("--moved", type=float, default=0.0, help="share of landmarks moved after each drive")
    parser.add_argument(
        "--queries", type=at_least(1), default=200, help="views that are asked about (default 200)"
    )
    parser.add_argument("--keep-days", type=float, default=14.0, help="superseded nodes are kept")
    a = parser.parse_args()
    if not 0.0 <= a.moved <= 1.0:
        parser.error("--moved is a share of 0 to 1")
    console = Console(stderr=a.json)
    figures, drives = run(a.drives, a.seed, a.stops, a.moved, a.queries, a.keep_days, console)
    columns = "drive", "nodes", "superseded", "pruned", "components", "ms a new node", "last merge s"
    table = Table(*columns, title=f"seed {a.seed}")
    for number, one in enumerate(drives, start=1):
        counts = map(str, (number, one.nodes, one.superseded, one.pruned, one.components))
        table.add_row(*counts, f"{one.node_ms:.1f}", f"{one.merge_s:.2f}")
    console.print(table)
    totals = Table("figure", "value")
    for name, value in figures.items():
        if not isinstance(value, list):
            totals.add_row(name, f"{value:g}")
        elif name.endswith("_interval"):
            totals.add_row(name, " to ".join(f"{end:g}" for end in value))
    console.print(totals)
    if a.json:
        print(json.dumps({"seed": a.seed, "drives": a.drives, **figures}))


def run(
    drives: int, seed: int, stops: int, moved: float, queries: int, keep_days: float, console: Console
) -> tuple[dict[str, float | list[float]], list[MapAfterDrive]]:
    """All drives, then the questions; see the module."""
    rng = np.random.default_rng([seed, 0x11FE])
    house = TwoRooms.built(rng)
    merger, merged, curve = Merger(), MergedMap.empty(), list[MapAfterDrive]()
    truth: dict[NodeId, Pose2] = {}
    folder = TemporaryDirectory()
    path, early = Path(folder.name) / "store.db", SqliteStore(Path(folder.name) / "early.db")
    at_first = held_bytes()
    for epoch in track(range(1, drives + 1), "driving", console=console):
        if epoch > 1 and moved:
            house = house.refurnished(moved, rng)
        tour = house.tour(stops, rng)
        nodes, edges = take_map(house, MapId("r0", epoch), tour, rng)
        now_ns = round(epoch * APART * DAY_NS)
        nodes = [replace(node, stamp_ns=now_ns + node.stamp_ns) for node in nodes]
        truth |= {node.id: pose for node, pose in zip(nodes, tour, strict=True)}
        map_id = MapId("r0", epoch)
        changes = numbered(map_id, changes_of(nodes, edges), stamp_ns=now_ns)
        entries = [ReceivedChange.read(map_id, one.sequence, encode_change(one)) for one in changes]
        began = time.process_time()
        for change in changes:
            merger.on_change(change)
        taken = time.process_time()
        merged = merger.merged()
        spent, old = time.process_time() - taken, len(merged.superseded)
        node_ms = 1e3 * (taken - began) / len(nodes)
        plan = plan_of(merged, merger.maps.values(), merger.pruning, now_ns, keep_days)
        # A store that is closed is one file.
        with closing(SqliteStore(path)) as store:
            store.apply(map_id, 1, entries)
            if plan is not None:
                store.prune(plan.nodes, plan.edges, merger.pruning.records(plan))
                merger.prune(plan)
        journal = journal_of(Path(folder.name) / "r0.sqlite", map_id, changes, merger.pruning.pruned)
        counts = len(merged.poses) - old, old, len(merged.pruned), len(merged.components)
        curve.append(
            MapAfterDrive(*counts, node_ms, spent, held_bytes() - at_first, path.stat().st_size, journal)
        )
        if epoch <= EARLY[-1]:
            early.apply(map_id, 1, entries)
        console.print(
            f"drive {epoch}: {curve[-1].nodes} nodes, {old} superseded, merged in {spent:.1f} s, "
            f"{curve[-1].memory / 1e6:.0f} MB, store {curve[-1].store / 1e6:.2f} MB, "
            f"{len(merger.pruning.marginals)} marginal links"
        )
    merged = merger.merged()
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
        "memory_mb": [round(one.memory / 1e6, 1) for one in curve],
        "store_mb": [round(one.store / 1e6, 2) for one in curve],
        "journal_mb": [round(one.journal / 1e6, 2) for one in curve],
        **in_the_long_run(curve),
        "components": curve[-1].components,
        "routes_found": routes_found(merged, rng),
    }
    earlier = {f"after_{count}": driven_through(early, count, keep_days) for count in EARLY if count < drives}
    for name, mapped in earlier.items():
        figures[f"nodes_{name}"] = len(mapped.merged().poses) - len(mapped.merged().superseded)
    early.close()
    folder.cleanup()
    answers: dict[str, NDArray[np.bool_]] = {}
    for name, mapped, hide in (
        *((name, mapped, True) for name, mapped in earlier.items()),
        ("after", merger, True),
        ("all_nodes", merger, False),
    ):
        hidden = frozenset(mapped.merged().superseded) if hide else frozenset[NodeId]()
        for where, asked in (("", views), ("_visited", again)):
            right, wrong = answered(mapped, mapped.merged(), hidden, asked, truth)
            answers[f"{where}_{name}"] = right
            shares = round(float(right.mean()), 4), round(float(wrong.mean()), 4)
            figures |= dict(zip((f"recall{where}_{name}", f"wrong{where}_{name}"), shares, strict=True))
    for where in ("", "_visited"):
        if (before := answers.get(f"{where}_after_{EARLY[-1]}")) is not None:
            difference, least, most = change_of(before, answers[f"{where}_after"])
            figures[f"recall{where}_change"] = difference
            figures[f"recall{where}_change_interval"] = [least, most]
    return figures, curve


def journal_of(path: Path, map_id: MapId, changes: Sequence[Change], pruned: Container[NodeId]) -> int:
    """What a robot's journal takes after a drive that the server has taken in, bytes; see LeftMaps."""
    with closing(Journal(path, map_id.agent)) as journal:
        journal.open_map(map_id.epoch)
        journal.append(map_id, [change.body for change in changes], changes[-1].stamp_ns)
        journal.acknowledge("s0", map_id, journal.head(map_id))
        for left in journal.maps()[:-1]:
            nodes = journal.nodes(left)
            if nodes and all(node in pruned for node in nodes):
                journal.append(left, map(NodeRetired, nodes), changes[-1].stamp_ns)
                journal.acknowledge("s0", left, journal.head(left))
                journal.prune(left, ["s0"])
    return path.stat().st_size


def driven_through(store: Store, drives: int, keep_days: float) -> Merger:
    """The first drives again, as a map of their own that is pruned as on the way."""
    merger = Merger()
    for map_id in sorted(store.maps())[:drives]:
        for change in store.replay(map_id):
            merger.on_change(change)
        now_ns = round(map_id.epoch * APART * DAY_NS)
        plan = plan_of(merger.merged(), merger.maps.values(), merger.pruning, now_ns, keep_days)
        if plan is not None:
            merger.prune(plan)
    return merger


def in_the_long_run(curve: Sequence[MapAfterDrive]) -> dict[str, float | list[float]]:
    """What the last drives cost by those about the fiftieth."""
    if len(curve) < FIFTIETH + 2 * SOME:
        return {}
    about, last = curve[FIFTIETH - 1 - SOME // 2 :][:SOME], curve[-SOME:]

    def ratio(cost: Callable[[MapAfterDrive], float]) -> float:
        return round(sum(map(cost, last)) / sum(map(cost, about)), 3)

    return {
        "memory_ratio": ratio(lambda drive: drive.memory),
        "merge_ratio": ratio(lambda drive: drive.merge_s),
        "store_ratio": ratio(lambda drive: drive.store),
        "journal_ratio": ratio(lambda drive: drive.journal),
    }


def answered(
    merger: Merger,
    merged: MergedMap,
    hidden: frozenset[NodeId],
    views: Sequence[tuple[View, Pose2]],
    truth: Mapping[NodeId, Pose2],
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(N,) which views are answered rightly, and (N,) which wrongly; the others are not answered."""
    shown = replace(merged, superseded=dict.fromkeys(hidden, LEFT_OUT))
    index = PlaceIndex()
    index.extend(node for one in merger.maps.values() for node in one.nodes.values() if node.id not in hidden)
    places = ActiveNodes(index, merger.node, shown)
    relocalizer = Relocalizer(places, places.node, merged)
    right, wrong = np.zeros(len(views), np.bool_), np.zeros(len(views), np.bool_)
    for k, (view, world_from_robot) in enumerate(views):
        answer = relocalizer.answer(view)
        if answer.certainty is Certainty.FOUND:
            best = answer.candidates[0]
            off = (truth[best.node] @ best.node_from_robot.mean).inverse() @ world_from_robot
            good = off.distance(Pose2()) <= CLOSE and abs(off.heading) <= CLOSE_TURN
            right[k], wrong[k] = good, not good
    return right, wrong


def change_of(before: NDArray[np.bool_], after: NDArray[np.bool_]) -> tuple[float, float, float]:
    """What has come to be answered less what is answered no longer, and its interval of 95 %, as shares.

    The interval is that of Agresti and Min (Simple improved confidence intervals for comparing matched
    proportions, Statistics in Medicine 24, 2005): half a view is added to each of the four counts.

    Args:
        before: (N,) whether each view was answered rightly.
        after: (N,) the same views later.
    """
    won, lost, count = int((after & ~before).sum()), int((before & ~after).sum()), len(before)
    middle = (won - lost) / (count + 2)
    sigma = math.sqrt((won + lost + 1) / (count + 2) - middle**2) / math.sqrt(count + 2)
    ends = middle - TWO_SIDED * sigma, middle + TWO_SIDED * sigma
    return round((won - lost) / count, 4), round(ends[0], 4), round(ends[1], 4)


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
