"""docs/scale.md: what 10 000 robots need, by formulas over what is measured of one robot, node and answer."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from benchmarks.figures.results import StoredResult
from mapweave.mapserver.server import MERGE_SHARE

STATUS_BYTES = 515
"""Of a robot that drives to a goal, encoded; `tests/benchmarks/test_scale.py` encodes one."""
EDGE_BYTES = 87
"""Of a driven edge, encoded; likewise."""
QUESTION_BYTES = 2722
"""Of a view of a lost robot, encoded; likewise."""
DISK_BYTES = 4588
"""Of a node with its edge in a store of SQLite; likewise."""
GOOD_ACK_MS = 500.0
"""A fleet whose 99th percentile is below is carried."""

ROBOTS, SITES = 10_000, 100
AREA = 10_000.0
"""Floor of a site, m^2."""
MAPPING = 0.05
"""Share of robots that map at a time, once a site is known."""
NODE_EVERY = 10.0
"""s, of a robot that maps."""
STATUSES = 2.0
"""A robot and second."""
QUESTION_EVERY = 60.0
"""s, of each robot: it asks where it is."""
FRAME_BYTES = 100
"""Of a message: key, Zenoh, TCP/IP and TLS."""


@dataclass(frozen=True)
class Costs:
    """What one of each costs.

    Attributes:
        node_bytes: on the wire.
        compare_s: processor, of comparing a new node with the map.
        answer_s: processor, of one answer to a lost robot.
        merge_s: processor, of a merge of 10 000 nodes behind five new ones.
        base_bytes: memory of a server without maps.
        kept_bytes: memory of a node, compared with its neighbours.
        index_bytes: of that, in the place index.
        nodes_per_m2: that a robot makes which explores.
        growth: active nodes after six drives, over those of the first.
        link_s: processor of the server a second and robot: changes, acknowledgements, statuses.
        agents: with which that was measured.
        carried: the largest fleet on one server whose acknowledgements are in time; 0 if none was.
    """

    node_bytes: float
    compare_s: float
    answer_s: float
    merge_s: float
    base_bytes: float
    kept_bytes: float
    index_bytes: float
    nodes_per_m2: float
    growth: float
    link_s: float
    agents: int
    carried: int

    @staticmethod
    def of(results: Mapping[str, StoredResult]) -> Costs:
        """The costs by stored results."""
        merge, answers = results["merge_scale"].figures["scale"], results["relocalize"].figures
        explored = results["explore"].figures
        floor = explored["area_per_minute_ours"]["1"] * explored["minutes"]
        base = merge["rss_before_mb"]["10000"] * 1e6
        rows = {int(robots): row for robots, row in results["fleet"].figures["agents"].items()}
        agents = max(rows)
        return Costs(
            node_bytes=results["landmarks"].figures["bytes_per_node"],
            compare_s=merge["cpu_ms_per_node"]["10000"] / 1e3,
            answer_s=answers["cpu_p50_ms"]["100000"] / 1e3,
            merge_s=merge["cpu_ms_per_merge"]["10000"] / 1e3,
            base_bytes=base,
            kept_bytes=(merge["rss_mb"]["10000"] * 1e6 - base) / 10_000,
            index_bytes=answers["index_bytes_per_node"]["100000"],
            nodes_per_m2=explored["nodes"]["ours"]["1"] / floor,
            growth=results["life"].figures["growth"],
            link_s=(rows[agents]["server_cpu"] + rows[agents]["router_cpu"]) / agents,
            agents=agents,
            carried=max((n for n, row in rows.items() if row["ack_p99_ms"] <= GOOD_ACK_MS), default=0),
        )


@dataclass(frozen=True)
class ScalePlan:
    """What the fleet needs; of one site unless it says otherwise.

    Attributes:
        node_rate: nodes a second, once the site is known.
        first_rate: on the first day, when all robots map.
        nodes: that stay active.
        memory: of its server, bytes.
        disk: of the nodes that stay, bytes.
        disk_day: that a day adds, until superseded nodes are removed, bytes.
        robot_bps: what a robot sends, bytes a second.
        first_bps: on the first day.
        link_cores: processor of changes, acknowledgements and statuses.
        compare_cores: of comparing new nodes.
        answer_cores: of answers.
        cores: all, and merging.
        merge_s: processor of one merge, by the number of nodes.
    """

    node_rate: float
    first_rate: float
    nodes: float
    memory: float
    disk: float
    disk_day: float
    robot_bps: float
    first_bps: float
    link_cores: float
    compare_cores: float
    answer_cores: float
    cores: float
    merge_s: float

    @staticmethod
    def of(costs: Costs) -> ScalePlan:
        """The plan by the costs."""
        robots = ROBOTS / SITES
        rate, first = robots * MAPPING / NODE_EVERY, robots / NODE_EVERY
        nodes = AREA * costs.nodes_per_m2 * costs.growth
        node_bytes = costs.node_bytes + EDGE_BYTES + 2 * FRAME_BYTES
        steady = STATUSES * (STATUS_BYTES + FRAME_BYTES) + (QUESTION_BYTES + FRAME_BYTES) / QUESTION_EVERY
        link, compare = robots * costs.link_s, rate * costs.compare_s
        answer = robots / QUESTION_EVERY * costs.answer_s
        return ScalePlan(
            node_rate=rate,
            first_rate=first,
            nodes=nodes,
            memory=costs.base_bytes + nodes * costs.kept_bytes,
            disk=nodes * DISK_BYTES,
            disk_day=86_400 * rate * DISK_BYTES,
            robot_bps=steady + MAPPING * node_bytes / NODE_EVERY,
            first_bps=steady + node_bytes / NODE_EVERY,
            link_cores=link,
            compare_cores=compare,
            answer_cores=answer,
            cores=link + compare + answer + MERGE_SHARE,
            merge_s=costs.merge_s * nodes / 10_000,
        )


MEASURED, EXTRAPOLATED, CHOSEN = "measured", "extrapolated", "chosen"
Row = tuple[str, str, str, str]


INTRODUCTION = """\
`python -m benchmarks.figures` writes this page from the results behind [figures](figures.md), which name
commands and dates. No one has run 10 000 robots: *measured* is a figure of one robot, node or answer,
*extrapolated* a formula over these, *chosen* an assumption that you replace by your own. That memory and
processor grow linearly beyond what was measured is itself an extrapolation."""
ALONE = """\
One server a site is the plan: sites share no floor, so no map, no link and no route crosses them. A site that
stands alone keeps working when the network between sites fails."""
TOGETHER = """\
Then one merged map has to be shared: several front servers on one record take changes and answer. The record
has what robots and people sent. One front server compares all new nodes and merges; the others take over its
merged map. Each needs the memory for the whole map: more front servers do not bring that down. Workers of a
[Ray cluster](cluster.md) compare what the one that leads does not compare itself."""
WATCH = """\
The [metrics](monitoring.md) show where the plan is wrong: `mapweave_ack_seconds` (fronts),
`mapweave_queue_length{queue="comparisons"}` and `mapweave_merge_seconds` (merging),
`process_resident_memory_bytes` over `mapweave_nodes` (memory of a node), `mapweave_file_bytes` over a day
(disk). A robot has six series: a site's Prometheus holds under a thousand."""


def scale_page(results: Mapping[str, StoredResult]) -> str:
    """The whole page."""
    costs = Costs.of(results)
    plan, head = ScalePlan.of(costs), ("what", "formula", "figure", "basis")
    parts = [
        "# Plan for 10 000 robots", INTRODUCTION,
        "## What one of each costs", _table(("what", "cost", "from", "basis"), _costs(costs)),
        "## The fleet", _table(("what", "", "", "basis"), _fleet_rows()),
        "## One site", _table(head, _site(costs, plan)),
        "## All sites", _table(head, _all(plan)), ALONE,
        "## One building with all robots", TOGETHER, _table(head, _building(costs, plan)),
        "## What to watch", WATCH,
    ]  # fmt: skip
    return "\n\n".join(parts) + "\n"


def _table(head: Row, rows: list[Row]) -> str:
    lines = [f"| {' | '.join(head)} |", "|---|---|---|---|"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


def _costs(costs: Costs) -> list[Row]:
    here = "encoded"
    return [
        ("a node with 150 landmarks on the wire", f"{costs.node_bytes:.0f} bytes", "landmarks", MEASURED),
        ("its edge; a status; a lost robot's view", f"{EDGE_BYTES}; {STATUS_BYTES}; {QUESTION_BYTES} bytes",
         here, MEASURED),
        ("a node with its edge on the disk (SQLite)", _bytes(DISK_BYTES), "a store of 400 nodes", MEASURED),
        ("memory of a node among 10 000, with its links", _bytes(costs.kept_bytes), "merge_scale", MEASURED),
        ("of that, place index", _bytes(costs.index_bytes), "relocalize", MEASURED),
        ("memory of a server without maps", _bytes(costs.base_bytes), "merge_scale", MEASURED),
        ("processor: a new node among 10 000, compared", f"{1e3 * costs.compare_s:.0f} ms", "merge_scale",
         MEASURED),
        ("processor: a merge of 10 000 nodes after five new ones", f"{costs.merge_s:.1f} s", "merge_scale",
         MEASURED),
        ("processor: an answer to a lost robot among 100 000 places", f"{1e3 * costs.answer_s:.0f} ms",
         "relocalize", MEASURED),
        (f"processor: a mapping robot's link, server and router, of {costs.agents} robots",
         f"{1e3 * costs.link_s:.1f} ms/s", "fleet", MEASURED),
        ("nodes that an exploring robot makes", f"{costs.nodes_per_m2:.1f} per m²", "explore", MEASURED),
        ("active nodes after six drives, over the first", f"{costs.growth:.2f}", "life", MEASURED),
    ]  # fmt: skip


def _fleet_rows() -> list[Row]:
    return [
        ("robots, sites", f"{ROBOTS}, {SITES}", "", CHOSEN),
        ("floor of a site", f"{AREA:.0f} m²", "", CHOSEN),
        ("robots that map at a time, once a site is known", f"{MAPPING:.0%}", "", CHOSEN),
        ("a node of a robot that maps", f"every {NODE_EVERY:g} s", "", "chosen, as benchmarks.fleet"),
        ("statuses", f"{STATUSES:g} a second", "", "as built"),
        ("a robot asks where it is", f"every {QUESTION_EVERY:g} s", "", CHOSEN),
        ("key, Zenoh, TCP/IP and TLS of a message", f"{FRAME_BYTES} bytes", "", CHOSEN),
        ("share of a core that merging takes at most", f"{MERGE_SHARE:.0%}", "", "as built"),
    ]


def _site(costs: Costs, plan: ScalePlan) -> list[Row]:
    robots = ROBOTS // SITES
    return [
        ("nodes that stay", "floor × nodes per m² × growth", f"{plan.nodes:.0f}", EXTRAPOLATED),
        ("memory of the server", "empty + nodes × memory of a node", _bytes(plan.memory), EXTRAPOLATED),
        ("disk of the nodes that stay", "nodes × disk of a node", _bytes(plan.disk), EXTRAPOLATED),
        ("disk that a day adds", "nodes a day × disk of a node, until superseded nodes are removed",
         _bytes(plan.disk_day), EXTRAPOLATED),
        ("new nodes a second; on the first day",
         f"{robots} × share that maps / {NODE_EVERY:g} s; all map",
         f"{plan.node_rate:g}; {plan.first_rate:g}", EXTRAPOLATED),
        ("processor: links", "robots × link, as if all map", f"{plan.link_cores:.2f} cores",
         "extrapolated, at most"),
        ("processor: comparing", "new nodes × comparing", f"{plan.compare_cores:.2f} cores", EXTRAPOLATED),
        ("the same on the first day", "new nodes × comparing",
         f"{plan.first_rate * costs.compare_s:.2f} cores", EXTRAPOLATED),
        ("processor: answers", "robots × questions × answer", f"{plan.answer_cores:.2f} cores", EXTRAPOLATED),
        ("processor: merging", "its share", f"{MERGE_SHARE:g} cores", "as built, at most"),
        ("a merge is behind by", "a merge × nodes / 10 000, over its share",
         f"{plan.merge_s / MERGE_SHARE:.0f} s", EXTRAPOLATED),
        ("all", "sum", f"{plan.cores:.1f} cores", EXTRAPOLATED),
    ]  # fmt: skip


def _all(plan: ScalePlan) -> list[Row]:
    cores = SITES * math.ceil(plan.cores)
    return [
        ("map servers", "one a site", f"{SITES}", CHOSEN),
        ("cores", "sites × cores of a site, whole ones", f"{cores}", EXTRAPOLATED),
        ("memory", "sites × memory of a site", _bytes(SITES * plan.memory), EXTRAPOLATED),
        ("machines of 8 cores and 32 GB", "by cores and by memory",
         f"{math.ceil(max(cores / 8, SITES * plan.memory / 32e9))}, and one in ten spare", EXTRAPOLATED),
        ("a robot sends; on the first day", "statuses + nodes + questions",
         f"{plan.robot_bps / 1e3:.2f}; {plan.first_bps / 1e3:.2f} kB/s", EXTRAPOLATED),
        ("of that, statuses", "statuses × (status + frame)",
         f"{STATUSES * (STATUS_BYTES + FRAME_BYTES) / plan.robot_bps:.0%}", EXTRAPOLATED),
        ("a site's network; all", "robots × that",
         f"{8e-6 * plan.robot_bps * ROBOTS / SITES:.1f}; {8e-6 * plan.robot_bps * ROBOTS:.0f} Mbit/s",
         EXTRAPOLATED),
        ("disk that a day adds", "sites × that of a site", _bytes(SITES * plan.disk_day), EXTRAPOLATED),
    ]  # fmt: skip


def _building(costs: Costs, plan: ScalePlan) -> list[Row]:
    rate, first = SITES * plan.node_rate, SITES * plan.first_rate
    whole = costs.base_bytes + SITES * plan.nodes * costs.kept_bytes
    fronts = math.ceil(ROBOTS / costs.carried) if costs.carried else 0

    carried = (
        f"{costs.carried} robots" if costs.carried else f"none of {costs.agents} was in time on that machine"
    )
    return [
        (f"robots on one front server, acknowledged within {GOOD_ACK_MS:g} ms (99 %)",
         "the largest fleet in time in one run; on slower machines of two cores it was 200: measure yours",
         carried, MEASURED),
        ("front servers", "robots over that", f"{fronts}" if fronts else "not known", EXTRAPOLATED),
        ("cores for links", "robots × link, as if all map", f"{ROBOTS * costs.link_s:.0f}",
         "extrapolated, at most"),
        ("cores for answers", "robots × questions × answer",
         f"{ROBOTS / QUESTION_EVERY * costs.answer_s:.1f}", EXTRAPOLATED),
        ("cores for comparing, of the one that leads", "new nodes × comparing",
         f"{rate * costs.compare_s:.1f}", EXTRAPOLATED),
        ("the same on the first day", "new nodes × comparing", f"{first * costs.compare_s:.0f}",
         EXTRAPOLATED),
        ("cores for merging, of the one that leads", "share of a core", f"{MERGE_SHARE:.1f}",
         "as built, at most"),
        ("a merge is behind by", "a merge × nodes of all sites / 10 000, over its share",
         f"{SITES * plan.merge_s / MERGE_SHARE:.0f} s", EXTRAPOLATED),
        ("memory of one front server; of all",
         "empty + nodes of all sites × memory of a node; front servers × that",
         f"{_bytes(whole)}; {_bytes(fronts * whole) if fronts else 'not known'}", EXTRAPOLATED),
        ("changes that the record takes a second; on the first day", "two a node",
         f"{2 * rate:.0f}; {2 * first:.0f}", EXTRAPOLATED),
    ]  # fmt: skip


def _bytes(count: float) -> str:
    for unit, size in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count:.0f} bytes"
