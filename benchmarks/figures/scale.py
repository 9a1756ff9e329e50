"""docs/scale.md: what 10 000 robots need, by formulas over what is measured of one robot, node and answer.

`scale.md` beside this file is the template, see `benchmarks.figures.page`.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.figures.page import filled
from benchmarks.figures.results import StoredResult
from mapweave.mapserver.server import MERGE_SHARE

TEMPLATE = Path(__file__).with_name("scale.md")
STATUS_BYTES = 521
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


Figures = dict[str, Any]


def scale_page(results: Mapping[str, StoredResult]) -> str:
    """The whole page."""
    costs = costs_of(results)
    figures = {
        "chosen": chosen(), "cost": costs, "site": site(costs), "all": all_sites(costs),
        "building": building(costs),
    }  # fmt: skip
    return filled(TEMPLATE.read_text(encoding="utf-8"), figures)


def chosen() -> Figures:
    """What is assumed, and how the program is built."""
    return {
        "robots": ROBOTS, "sites": SITES, "robots_a_site": ROBOTS // SITES, "area": AREA, "mapping": MAPPING,
        "node_every": NODE_EVERY, "statuses": STATUSES, "question_every": QUESTION_EVERY,
        "frame_bytes": FRAME_BYTES, "merge_share": MERGE_SHARE, "good_ack_ms": GOOD_ACK_MS,
    }  # fmt: skip


def costs_of(results: Mapping[str, StoredResult]) -> Figures:
    """What one of each costs, by stored results.

    Returns:
        Bytes: of a node on the wire, of a server's memory without maps (`base`), of a node in it (`kept`),
        and of that in the place index. Processor, s: of a new node compared, of an answer, of a merge of
        10 000 nodes behind five new ones, and of the server a second and robot (`link`). Nodes per m^2 that
        an exploring robot makes; `growth`, active nodes after six drives over those of the first. `agents`
        with which the link was measured; `carried`, the largest fleet that is in time, 0 if none is.
    """
    merge, answers = results["merge_scale"].figures["scale"], results["relocalize"].figures
    explored = results["explore"].figures
    floor = explored["area_per_minute_ours"]["1"] * explored["minutes"]
    base = merge["rss_before_mb"]["10000"] * 1e6
    rows = {int(robots): row for robots, row in results["fleet"].figures["agents"].items()}
    agents = max(rows)
    carried = max((n for n, row in rows.items() if row["ack_p99_ms"] <= GOOD_ACK_MS), default=0)
    return {
        "edge_bytes": EDGE_BYTES, "status_bytes": STATUS_BYTES, "question_bytes": QUESTION_BYTES,
        "disk_bytes": DISK_BYTES,
        "node_bytes": results["landmarks"].figures["bytes_per_node"],
        "compare_s": merge["cpu_ms_per_node"]["10000"] / 1e3,
        "answer_s": answers["cpu_p50_ms"]["100000"] / 1e3,
        "merge_s": merge["cpu_ms_per_merge"]["10000"] / 1e3,
        "base_bytes": base,
        "kept_bytes": (merge["rss_mb"]["10000"] * 1e6 - base) / 10_000,
        "index_bytes": answers["index_bytes_per_node"]["100000"],
        "nodes_per_m2": explored["nodes"]["ours"]["1"] / floor,
        "growth": results["life"].figures["growth"],
        "link_s": (rows[agents]["server_cpu"] + rows[agents]["router_cpu"]) / agents,
        "agents": agents,
        "carried": carried,
        "in_time": f"{carried} robots" if carried else f"none of {agents} was in time on that machine",
    }  # fmt: skip


def site(costs: Figures) -> Figures:
    """What one site needs; rates are a second, `first` is the first day, when all robots map."""
    robots = ROBOTS / SITES
    rate, first = robots * MAPPING / NODE_EVERY, robots / NODE_EVERY
    nodes = AREA * costs["nodes_per_m2"] * costs["growth"]
    node_bytes = costs["node_bytes"] + EDGE_BYTES + 2 * FRAME_BYTES
    statuses = STATUSES * (STATUS_BYTES + FRAME_BYTES)
    steady = statuses + (QUESTION_BYTES + FRAME_BYTES) / QUESTION_EVERY
    robot_bps = steady + MAPPING * node_bytes / NODE_EVERY
    link, compare = robots * costs["link_s"], rate * costs["compare_s"]
    answer, merge_s = robots / QUESTION_EVERY * costs["answer_s"], costs["merge_s"] * nodes / 10_000
    return {
        "node_rate": rate, "first_rate": first, "nodes": nodes,
        "memory": costs["base_bytes"] + nodes * costs["kept_bytes"],
        "disk": nodes * DISK_BYTES, "disk_day": 86_400 * rate * DISK_BYTES,
        "robot_bps": robot_bps, "first_bps": steady + node_bytes / NODE_EVERY,
        "status_share": statuses / robot_bps, "mbps": 8e-6 * robot_bps * robots,
        "link_cores": link, "compare_cores": compare, "first_compare_cores": first * costs["compare_s"],
        "answer_cores": answer, "cores": link + compare + answer + MERGE_SHARE,
        "merge_s": merge_s, "behind_s": merge_s / MERGE_SHARE,
    }  # fmt: skip


def all_sites(costs: Figures) -> Figures:
    """What all sites need."""
    one = site(costs)
    cores, memory = SITES * math.ceil(one["cores"]), SITES * one["memory"]
    return {
        "cores": cores, "memory": memory, "machines": math.ceil(max(cores / 8, memory / 32e9)),
        "mbps": SITES * one["mbps"], "disk_day": SITES * one["disk_day"],
    }  # fmt: skip


def building(costs: Figures) -> Figures:
    """What one building with all robots needs."""
    one = site(costs)
    whole = costs["base_bytes"] + SITES * one["nodes"] * costs["kept_bytes"]
    fronts = math.ceil(ROBOTS / costs["carried"]) if costs["carried"] else None
    return {
        "fronts": fronts or "not known", "link_cores": ROBOTS * costs["link_s"],
        "answer_cores": SITES * one["answer_cores"], "compare_cores": SITES * one["compare_cores"],
        "first_compare_cores": SITES * one["first_compare_cores"], "behind_s": SITES * one["behind_s"],
        "memory": whole, "all_memory": fronts * whole if fronts else "not known",
        "changes": 2 * SITES * one["node_rate"], "first_changes": 2 * SITES * one["first_rate"],
    }  # fmt: skip
