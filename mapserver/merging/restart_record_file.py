"""The restart record as a file (see mapweave.mapserver.checksummed_file), so that a restarted server
supersedes the nodes that it had superseded.

header (JSON), agents (JSON), nodes, prints, what is known of each, superseded, links, overlaps, unsure maps,
log: its nodes, what superseded them before, judged, linked, maps that are joined, cut, maps that have parted
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId, check_name
from mapweave.hybridmap.limits import MAX_LANDMARKS, MAX_NUMBER, MAX_POSITION
from mapweave.hybridmap.superseded import Superseded
from mapweave.mapserver.checksummed_file import FileKind, json_part, read_json
from mapweave.mapserver.merging.restart_record import RestartRecord
from mapweave.mapserver.merging.verification_cache import PRINT_BYTES, RecentComparisons
from mapweave.merge.map_maintenance.superseding_log import MOST, Changes, SupersedingLog
from mapweave.merge.pose_graph.candidates import Pair

MAGIC = b"mapweave superseded\n"
FORMAT = 2
JUDGED, COMPARED = 1, 2
"""What is known of a node: bits."""


def _parts(record: RestartRecord) -> Iterator[NDArray[Any]]:
    recent = record.recent
    nodes = sorted(recent.prints)
    row = {node: k for k, node in enumerate(nodes)}
    logged = _nodes_of(record.log)
    parted = (part for step in record.log.steps for part in step.parted)
    joined = {map_id for part in (*record.log.joined, *parted) for map_id in part}
    agents = sorted({n.agent for n in (*nodes, *logged)} | {m.agent for m in (*record.unsure, *joined)})
    number = {agent: k for k, agent in enumerate(agents)}
    yield json_part(agents)
    yield _ids(nodes, number)
    yield np.frombuffer(b"".join(recent.prints[n] for n in nodes), np.uint8).reshape(-1, PRINT_BYTES)
    yield np.array(
        [JUDGED * (n in record.judged) + COMPARED * (n in recent.compared) for n in nodes], np.uint8
    )
    table = sorted(record.superseded.items())
    yield np.array([(row[n], row[s.by], s.found) for n, s in table], np.int64).reshape(-1, 3)
    yield np.array([(s.distance, s.turn) for _, s in table], np.float64).reshape(-1, 2)
    yield _rows(record.linked, row)
    overlaps = {pair: v for pair, v in recent.overlaps.items() if pair[0] in row and pair[1] in row}
    yield _rows(overlaps, row)
    yield np.fromiter(overlaps.values(), np.float64)
    yield np.array([(number[m.agent], m.epoch) for m in sorted(record.unsure)], np.int64).reshape(-1, 2)
    yield from _log_parts(record.log, logged, number)


def _log_parts(
    log: SupersedingLog, nodes: Sequence[NodeId], number: Mapping[str, int]
) -> Iterator[NDArray[Any]]:
    """The log of superseding; each row but the first kind begins with a step, or a component."""
    row = {node: k for k, node in enumerate(nodes)}
    changed = [(k, n, was) for k, step in enumerate(log.steps) for n, was in sorted(step.before.items())]
    yield _ids(nodes, number)
    yield np.array(
        [(k, row[n], *((-1, 0) if was is None else (row[was.by], was.found))) for k, n, was in changed],
        np.int64,
    ).reshape(-1, 4)
    yield np.array(
        [(0.0, 0.0) if was is None else (was.distance, was.turn) for _, _, was in changed], np.float64
    ).reshape(-1, 2)
    yield np.array(
        [(k, row[n]) for k, step in enumerate(log.steps) for n in sorted(step.judged)], np.int64
    ).reshape(-1, 2)
    yield _stepped([step.linked for step in log.steps], row)
    yield np.array(
        [
            (k, number[m.agent], m.epoch, step)
            for k, part in enumerate(log.joined)
            for m, step in part.items()
        ],
        np.int64,
    ).reshape(-1, 4)
    yield _stepped([step.cut for step in log.steps], row)
    yield np.array(
        [
            (k, group, number[m.agent], m.epoch, since)
            for k, step in enumerate(log.steps)
            for group, part in enumerate(step.parted)
            for m, since in part.items()
        ],
        np.int64,
    ).reshape(-1, 5)


def _stepped(steps: Sequence[Iterable[Pair]], row: Mapping[NodeId, int]) -> NDArray[np.int64]:
    """Pairs of each step."""
    rows = [(k, row[a], row[b]) for k, pairs in enumerate(steps) for a, b in sorted(pairs)]
    return np.array(rows, np.int64).reshape(-1, 3)


def _nodes_of(log: SupersedingLog) -> list[NodeId]:
    """All nodes that a log names."""
    nodes: set[NodeId] = set()
    for step in log.steps:
        nodes |= {*step.before, *step.judged, *(node for pair in (*step.linked, *step.cut) for node in pair)}
        nodes |= {was.by for was in step.before.values() if was is not None}
    return sorted(nodes)


def _read(parts: Iterator[NDArray[Any]]) -> RestartRecord:
    agents = [check_name(name) for name in read_json(next(parts))]
    nodes = _nodes(next(parts), agents)
    prints = {n: one.tobytes() for n, one in zip(nodes, _of(next(parts), np.uint8, PRINT_BYTES), strict=True)}
    known = dict(zip(nodes, _of(next(parts), np.uint8).tolist(), strict=True))
    judged = frozenset(node for node, bits in known.items() if bits & JUDGED)
    compared = frozenset(node for node, bits in known.items() if bits & COMPARED)
    rows, poses = _whole(next(parts), 3), _poses(next(parts))
    _in_range(rows, (len(nodes), len(nodes), MAX_LANDMARKS + 1))
    superseded = {
        nodes[a]: Superseded(nodes[by], found, *pose)
        for (a, by, found), pose in zip(rows.tolist(), poses.tolist(), strict=True)
    }
    if any(s.by in superseded or n not in judged or s.by not in judged for n, s in superseded.items()):
        raise InvalidValue("a node is superseded by one that is not active")
    linked = frozenset(_pairs(next(parts), nodes))
    pairs, values = _pairs(next(parts), nodes), _of(next(parts), np.float64)
    if not ((values > 0.0) & np.isfinite(values)).all():
        raise InvalidValue("an overlap is out of range")
    overlaps = dict(zip(pairs, values.tolist(), strict=True))
    maps = _whole(next(parts), 2)
    _in_range(maps, (len(agents), MAX_NUMBER + 1))
    unsure = frozenset(MapId(agents[a], epoch) for a, epoch in maps.tolist())
    recent = RecentComparisons(prints, compared, overlaps)
    return RestartRecord(recent, judged, superseded, linked, unsure, _read_log(parts, agents))


def _read_log(parts: Iterator[NDArray[Any]], agents: Sequence[str]) -> SupersedingLog:
    nodes = _nodes(next(parts), agents)
    rows, poses = _whole(next(parts), 4), _poses(next(parts))
    judged, linked, joined = _whole(next(parts), 2), _whole(next(parts), 3), _whole(next(parts), 4)
    cut, apart = _whole(next(parts), 3), _whole(next(parts), 5)
    # No step is empty.
    stepped = [part[:, 0] for part in (rows, judged, linked, cut, apart) if len(part)]
    count = 1 + max((int(steps.max()) for steps in stepped), default=-1)
    _in_range(rows, (MOST, len(nodes), len(nodes), MAX_LANDMARKS + 1), (0, 0, -1, 0))
    _in_range(judged, (MOST, len(nodes)))
    _in_range(joined, (len(joined), len(agents), MAX_NUMBER + 1, count + 1), (0, 0, 0, -1))
    _in_range(apart, (MOST, len(apart), len(agents), MAX_NUMBER + 1, count + 1), (0, 0, 0, 0, -1))
    before: list[dict[NodeId, Superseded | None]] = [{} for _ in range(count)]
    for (k, node, by, found), pose in zip(rows.tolist(), poses.tolist(), strict=True):
        before[k][nodes[node]] = None if by < 0 else Superseded(nodes[by], found, *pose)
    come: list[set[NodeId]] = [set() for _ in range(count)]
    for k, node in judged.tolist():
        come[k].add(nodes[node])
    together: dict[int, dict[MapId, int]] = {}
    for part, agent, epoch, step in joined.tolist():
        together.setdefault(part, {})[MapId(agents[agent], epoch)] = step
    parted: list[dict[int, dict[MapId, int]]] = [{} for _ in range(count)]
    for k, group, agent, epoch, since in apart.tolist():
        parted[k].setdefault(group, {})[MapId(agents[agent], epoch)] = since
    pairs = _pairs_of_steps(linked, nodes, count), _pairs_of_steps(cut, nodes, count)
    groups = (tuple(each.values()) for each in parted)
    steps = (Changes(*each) for each in zip(before, map(frozenset, come), *pairs, groups, strict=True))
    return SupersedingLog(tuple(steps), tuple(together.values()))


def _pairs_of_steps(rows: NDArray[Any], nodes: Sequence[NodeId], count: int) -> list[Set[Pair]]:
    _in_range(rows, (MOST, len(nodes), len(nodes)))
    if not (rows[:, 1] < rows[:, 2]).all():
        raise InvalidValue("a pair is not in the order of ids")
    pairs: list[set[Pair]] = [set() for _ in range(count)]
    for k, a, b in rows.tolist():
        pairs[k].add((nodes[a], nodes[b]))
    return [frozenset(each) for each in pairs]


def _ids(nodes: Sequence[NodeId], number: Mapping[str, int]) -> NDArray[np.int64]:
    """Nodes as rows."""
    return np.array([(number[n.agent], n.epoch, n.number) for n in nodes], np.int64).reshape(-1, 3)


def _nodes(part: NDArray[Any], agents: Sequence[str]) -> list[NodeId]:
    """Nodes of rows, in the order of ids."""
    ids = _whole(part, 3)
    _in_range(ids, (len(agents), MAX_NUMBER + 1, MAX_NUMBER + 1))
    nodes = [NodeId(agents[a], epoch, number) for a, epoch, number in ids.tolist()]
    if not all(a < b for a, b in pairwise(nodes)):
        raise InvalidValue("nodes are not in the order of ids")
    return nodes


def _poses(part: NDArray[Any]) -> NDArray[Any]:
    """Distances and turns, m and rad."""
    poses = _of(part, np.float64, 2)
    # Written so that NaN fails.
    if not ((poses >= 0.0) & (poses <= (4.0 * MAX_POSITION, math.pi))).all():
        raise InvalidValue("a distance or a turn is out of range")
    return poses


def _rows(pairs: Iterable[Pair], row: Mapping[NodeId, int]) -> NDArray[np.int32]:
    return np.fromiter((row[node] for pair in pairs for node in pair), np.int32).reshape(-1, 2)


def _pairs(part: NDArray[Any], nodes: Sequence[NodeId]) -> list[Pair]:
    """Pairs of nodes, the smaller id first: nodes are in the order of ids."""
    rows = _of(part, np.int32, 2)
    _in_range(rows, (len(nodes), len(nodes)))
    if not (rows[:, 0] < rows[:, 1]).all():
        raise InvalidValue("a pair is not in the order of ids")
    return [(nodes[a], nodes[b]) for a, b in rows.tolist()]


def _whole(part: NDArray[Any], columns: int) -> NDArray[Any]:
    return _of(part, np.int64, columns)


def _of(part: NDArray[Any], kind: type[np.generic], columns: int | None = None) -> NDArray[Any]:
    """A part, if it is of this kind and shape."""
    if part.dtype != kind or part.shape[1:] != (() if columns is None else (columns,)) or not part.ndim:
        raise InvalidValue(f"an array of {part.shape} {part.dtype}")
    return part


def _in_range(rows: NDArray[Any], ends: Sequence[int], least: Sequence[int] | int = 0) -> None:
    if not ((rows >= least) & (rows < ends)).all():
        raise InvalidValue("a number is out of range")


FILE = FileKind(MAGIC, {"format": FORMAT}, _parts, _read, "is no record of this version")
save, packed, load = FILE.save, FILE.packed, FILE.load
