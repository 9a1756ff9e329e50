"""The merge at scale: what a new node and a merge cost while the fleet's map grows.

A fleet maps one building at once (`synthetic.building`). All but the newest nodes are read as a
server reads its store at the start, with the overlaps and links of theirs drawn instead of looked for: to
compare all of them would take hours and is not what is asked. Then some robots go on mapping: their changes
are fed one by one through the real Merger, candidates from the place index and verification included, and
after every few nodes the merged map is made.
"""

import statistics
import time
from collections.abc import Sequence

import numpy as np
from rich.progress import Progress, TaskID

from benchmarks.process_usage import resident_mb
from mapweave.evaluation.map_score import align
from mapweave.hybridmap.change import Change, ChangeBody, EdgePut, NodePut
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.mapserver.merging.merger import Merger
from mapweave.merge.pose_graph.merged_map import MergedMap
from synthetic.building import Building

NODES_A_MAP = 100
ACTIVE = 5
"""Robots that go on mapping at the end."""
MEASURED = 100
"""Nodes that they add while the clock runs."""
EVERY = 5
"""Nodes from merge to merge: as many robots make a node each in a second or two."""
TRUE = 0.5
"""A link that is off by less than this is true, m."""
SAMPLE = 2000
"""Nodes whose error is measured."""

Figures = dict[str, float]


def scale(sizes: Sequence[int], seed: int, progress: Progress) -> dict[str, dict[str, float]]:
    """Figures by name, then by the number of nodes. See `at_size`.

    Raises:
        InvalidValue: a size that cannot be drawn.
    """
    if any(size < 2 * NODES_A_MAP or size % NODES_A_MAP for size in sizes):
        raise InvalidValue(f"--scale: fleets have {2 * NODES_A_MAP} nodes or more, in hundreds")
    found: dict[str, dict[str, float]] = {}
    for size in sizes:
        for figure, value in at_size(size, seed, progress).items():
            found.setdefault(figure, {})[str(size)] = value
    return found


def at_size(nodes: int, seed: int, progress: Progress, measured: int = MEASURED) -> Figures:
    """Figures for a fleet of so many nodes.

    Args:
        nodes: of all maps together, a multiple of NODES_A_MAP.
        seed: of the building.
        progress: called with the progress.
        measured: nodes that come while the clock runs.
    """
    robots = nodes // NODES_A_MAP
    task = progress.add_task(f"{nodes} nodes, {robots} maps", total=nodes + measured)
    building = Building.draw(robots, NODES_A_MAP, seed)
    active = min(ACTIVE, robots)
    first_new = NODES_A_MAP - measured // active
    active_nodes = np.ones(building.rooms.shape, np.bool_)
    active_nodes[:active, first_new:] = False
    read: list[tuple[MapId, ChangeBody]] = []
    coming: dict[int, list[list[tuple[MapId, ChangeBody]]]] = {}
    for robot in range(robots):
        for map_id, body in building.log(robot):
            number = _node(body).number // 2
            if active_nodes[robot, number]:
                read.append((map_id, body))
            elif isinstance(body, NodePut):
                coming.setdefault(number, []).append([(map_id, body)])
            else:
                coming[number][-1].append((map_id, body))
        progress.advance(task, NODES_A_MAP)
    before = resident_mb()
    merger = Merger()
    began = time.perf_counter()
    merger.read(read, *building.knowledge(active_nodes))
    read_s = time.perf_counter() - began
    del read
    began = time.perf_counter()
    merger.merged()
    first_s = time.perf_counter() - began
    by_node, by_merge, cpu = _feed(
        merger, [part for k in sorted(coming) for part in coming[k]], progress, task
    )
    merged = merger.merged()
    false = sum(_off(building, merged, *link.pair) > TRUE for link in merged.links)
    took = sum(by_node) + sum(by_merge)
    return {
        "ms_per_node_median": round(statistics.median(by_node), 2),
        "ms_per_node_p95": round(float(np.percentile(by_node, 95)), 2),
        "ms_per_merge_median": round(statistics.median(by_merge), 2),
        "ms_per_merge_p95": round(float(np.percentile(by_merge, 95)), 2),
        "ms_per_node_with_merges": round(took / len(by_node), 2),
        "cpu_ms_per_node": round(cpu[0] / len(by_node), 2),
        "cpu_ms_per_merge": round(cpu[1] / max(len(by_merge), 1), 2),
        "verified_per_node": round(merger.counters.verified / len(by_node), 2),
        "read_s": round(read_s, 2),
        "first_merge_s": round(first_s, 2),
        "rss_mb": round(resident_mb(), 1),
        "rss_before_mb": round(before, 1),
        "components": float(len(merged.components)),
        "links": float(len(merged.links)),
        "false_links": float(false),
        "error_m_median": round(_error(building, merged), 4),
    }


def _feed(
    merger: Merger, parts: Sequence[list[tuple[MapId, ChangeBody]]], progress: Progress, task: TaskID
) -> tuple[list[float], list[float], tuple[float, float]]:
    """Milliseconds of each node and of each merge by the clock, and of the processor in all."""
    cpu = [0.0, 0.0]
    by_node: list[float] = []
    by_merge: list[float] = []
    sequence = 0
    for k, part in enumerate(parts, 1):
        began, spent = time.perf_counter(), time.process_time()
        for map_id, body in part:
            sequence += 1
            merger.on_change(Change(map_id, sequence, 0, body))
        by_node.append(1e3 * (time.perf_counter() - began))
        cpu[0] += 1e3 * (time.process_time() - spent)
        if k % EVERY == 0:
            began, spent = time.perf_counter(), time.process_time()
            merger.merged()
            by_merge.append(1e3 * (time.perf_counter() - began))
            cpu[1] += 1e3 * (time.process_time() - spent)
        progress.advance(task)
    return by_node, by_merge, (cpu[0], cpu[1])


def _node(body: ChangeBody) -> NodeId:
    """The node that a change brings, or that an edge leads to."""
    if isinstance(body, NodePut):
        return body.node.id
    assert isinstance(body, EdgePut)
    return body.edge.b


def _off(building: Building, merged: MergedMap, a: NodeId, b: NodeId) -> float:
    """How far two nodes are from how they truly stand to each other, m."""
    found = merged.pose(a).inverse() @ merged.pose(b)
    return found.distance(building.world_from(a).inverse() @ building.world_from(b))


def _error(building: Building, merged: MergedMap) -> float:
    """Median position error in the largest component after a rigid alignment to the truth, m."""
    nodes = sorted(merged.components[0])
    nodes = nodes[:: max(len(nodes) // SAMPLE, 1)]
    found = np.array([[merged.pose(node).x, merged.pose(node).y] for node in nodes])
    true = np.array([[building.world_from(node).x, building.world_from(node).y] for node in nodes])
    return float(np.median(np.hypot(*(align(found, true).apply(found) - true).T)))
