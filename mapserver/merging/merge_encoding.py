"""A merge that the server that leads hands over to the others: all of a merged map but the maps themselves.

What comparing nodes has found is beside it, in parts (mapweave.mapserver.merging.stored_merges): most links
and refusals are named here by their nodes only. Poses, factors and covariances are the same bit by bit.

header (JSON), head (MessagePack), restart record, agents, reasons (JSON), nodes, components, factors, links,
refused, faded
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.explanation import ALIASED
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import EdgeId, MapId, NodeId
from mapweave.hybridmap.limits import Number
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.pin import Pin
from mapweave.hybridmap.pruned_node import PrunedNodes
from mapweave.mapserver.checksummed_file import checksummed, json_part, read_checksummed, read_json
from mapweave.mapserver.merging import restart_record_file
from mapweave.mapserver.merging.restart_record import RestartRecord
from mapweave.mapserver.merging.verification_cache import PRINT_BYTES
from mapweave.mapserver.merging.verification_cache_file import link_parts, read_links
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.component import Component
from mapweave.merge.pose_graph.factors import Factors
from mapweave.merge.pose_graph.links import Link, RefusedLink, refuse, refuse_edge
from mapweave.merge.pose_graph.merged_map import MergedMap, NodePoses, WrongGeometry
from mapweave.merge.pose_graph.verdicts import Verdict
from mapweave.wire.packing import Limit
from mapweave.wire.typed import decode, encode

MAGIC = b"mapweave merge\n"
FORMAT = 1
LIMIT = Limit("head of a merge", 2**30, 2**26)
AS_FOUND, ALIASED_TOO, WRITTEN_OUT, WORDS_ONLY, OWN_EDGE = range(5)
"""How a link or a refusal is written: as it was found when its nodes were compared, with its number of
aliased landmarks besides, whole, as nodes and a reason, as an edge of a robot."""


@dataclass(frozen=True)
class MergeHead:
    """What there is little of.

    Attributes:
        by: the server that has merged.
        maps: each with the last change of its log, and a digest of what it then was.
        mark: of what was pruned before (mapweave.mapserver.log.store.PRUNING_MARK); empty: nothing.
        parts: digests of the parts with what comparisons have found.
        made: manual constraints, in order.
        retired: nodes, with the numbers of the constraints that retire them.
        floors: see `ManualConstraints`.
        pins: see `MergedMap`; likewise the others.
        set_apart: maps.
        copies: those of them that are copies.
        implausible: maps.
        wrong: maps, with those that agree against them.
        contradicted: links by hand.
        refused_changes: maps.
        disbelieved: maps.
    """

    by: str
    maps: tuple[tuple[MapId, Number, bytes], ...]
    mark: bytes
    parts: tuple[bytes, ...]
    made: tuple[ManualConstraint, ...] = ()
    retired: tuple[tuple[NodeId, Number], ...] = ()
    floors: tuple[tuple[MapId, str], ...] = ()
    pins: tuple[Pin, ...] = ()
    set_apart: tuple[tuple[MapId, str], ...] = ()
    copies: tuple[MapId, ...] = ()
    implausible: tuple[tuple[MapId, str], ...] = ()
    wrong: tuple[tuple[MapId, tuple[MapId, ...]], ...] = ()
    contradicted: tuple[tuple[NodeId, NodeId, str], ...] = ()
    refused_changes: tuple[tuple[MapId, str], ...] = ()
    disbelieved: tuple[tuple[MapId, str], ...] = ()

    @staticmethod
    def of(
        by: str,
        maps: Mapping[MapId, tuple[int, bytes]],
        mark: bytes | None,
        parts: Sequence[bytes],
        merged: MergedMap,
    ) -> MergeHead:
        """The head of a merge."""
        constraints = merged.constraints
        number = {constraint: k for k, constraint in enumerate(constraints.made)}
        return MergeHead(
            by,
            tuple((which, *known) for which, known in sorted(maps.items())),
            mark or b"",
            tuple(parts),
            constraints.made,
            tuple((node, number[constraint]) for node, constraint in constraints.nodes.items()),
            tuple(constraints.floors.items()),
            merged.pins,
            tuple(merged.set_apart.items()),
            tuple(merged.copies),
            tuple(merged.implausible.items()),
            tuple((which, wrong.agreeing) for which, wrong in merged.wrong.items()),
            tuple((*pair, words) for pair, words in merged.contradicted.items()),
            tuple(merged.refused_changes.items()),
            tuple(merged.disbelieved.items()),
        )


def packed(
    head: MergeHead,
    record: RestartRecord,
    merged: MergedMap,
    verdict_of: Callable[[Pair], Verdict | None],
    made_by: str,
) -> bytes:
    """A merge as bytes.

    Args:
        head: of it.
        record: with the fingerprints of all nodes.
        merged: by it.
        verdict_of: what comparing two nodes has found, as it is in the parts.
        made_by: settings and version, in words.

    Raises:
        InvalidValue: it cannot be encoded.
    """
    return checksummed(MAGIC, _parts(head, record, merged, verdict_of, made_by))


@dataclass(frozen=True, eq=False)
class EncodedMerge:
    """A merge as it was handed over.

    Attributes:
        head: what there is little of.
        record: what is superseded, for a server that goes on from it.
        arrays: the rest, see `merged`.
    """

    head: MergeHead
    record: RestartRecord
    arrays: tuple[NDArray[Any], ...] = field(repr=False)

    @staticmethod
    def read(data: bytes, made_by: str) -> EncodedMerge:
        """Read the bytes of `packed`.

        Raises:
            InvalidFile: they are damaged, or of another version or other settings.
        """

        def read(parts: Iterator[NDArray[Any]]) -> EncodedMerge:
            head = decode(next(parts).tobytes(), MergeHead, LIMIT)
            record = restart_record_file.load(next(parts).tobytes(), made_by)
            return EncodedMerge(head, record, tuple(parts))

        return read_checksummed(data, MAGIC, _header(made_by), read, "is no merge of this version")

    def merged(
        self, maps: Mapping[MapId, HybridMap], verdicts: Mapping[Pair, Verdict], pruned: PrunedNodes
    ) -> MergedMap:
        """The merged map.

        Args:
            maps: just as they were merged, and those that are set apart.
            verdicts: what the parts say of pairs of their nodes.
            pruned: nodes that have left the maps.

        Raises:
            KeyError, IndexError, StopIteration, ValueError, TypeError: this and the arguments do not fit.
        """
        head, parts = self.head, iter(self.arrays)
        agents, reasons = read_json(next(parts)), read_json(next(parts))
        nodes = [NodeId(agents[a], epoch, number) for a, epoch, number in next(parts).tolist()]
        sizes, anchors, unsettled = (next(parts).tolist() for _ in range(3))
        seats, means = next(parts).tolist(), next(parts)
        counts, ends, link_of = next(parts).tolist(), next(parts), next(parts)
        explicit = next(parts), next(parts)
        links = _read_links(parts, nodes, verdicts)
        refused = _read_refused(parts, nodes, reasons, agents, verdicts, maps)
        faded_rows, lengths = next(parts).tolist(), next(parts).tolist()
        flags = np.unpackbits(next(parts), count=sum(lengths)).astype(np.bool_)
        starts = np.cumsum([0, *lengths]).tolist()
        factors = _factors(ends, link_of, explicit, links)
        graphs, first, at = [], 0, 0
        for size, anchor, loose, count in zip(sizes, anchors, unsettled, counts, strict=True):
            some = tuple(nodes[row] for row in seats[first : first + size])
            own = factors.take(np.arange(at, at + count))
            graphs.append(Component(nodes[anchor], some, means[first : first + size], own, loose))
            first, at = first + size, at + count
        apart = dict(head.set_apart)
        retired = {node: head.made[number] for node, number in head.retired}
        return MergedMap(
            {which: maps[which] for which in sorted(maps.keys() - apart.keys())},
            tuple(links),
            tuple(refused),
            tuple(frozenset(graph.nodes) for graph in graphs),
            NodePoses(graphs),
            tuple(graphs),
            ManualConstraints(head.made, retired, dict(head.floors)),
            dict(sorted(self.record.superseded.items())),
            {nodes[row]: flags[i:j] for row, (i, j) in zip(faded_rows, pairwise(starts), strict=True)},
            apart,
            {which: maps[which] for which in head.copies},
            dict(head.implausible),
            {which: WrongGeometry(which, agreeing) for which, agreeing in head.wrong},
            {(a, b): words for a, b, words in head.contradicted},
            head.pins,
            dict(head.refused_changes),
            dict(head.disbelieved),
            pruned,
        )


def map_print(hybrid_map: HybridMap, prints: Mapping[NodeId, bytes]) -> bytes:
    """A digest of what a merge sees of a map.

    Args:
        hybrid_map: the map.
        prints: fingerprints of its nodes.
    """
    digest = hashlib.blake2b(digest_size=PRINT_BYTES)
    nodes = sorted(hybrid_map.nodes)
    digest.update(np.array([node.number for node in nodes], np.int64).tobytes())
    digest.update(b"".join(prints[node] for node in nodes))
    edges = [hybrid_map.edges[edge] for edge in sorted(hybrid_map.edges)]
    ids = [(edge.id.number, edge.a.number, edge.b.number, len(edge.shared)) for edge in edges]
    digest.update(np.array(ids, np.int64).tobytes())
    means = [hybrid_map.nodes[node].map_from_robot.mean for node in nodes]
    means += [edge.a_from_b.mean for edge in edges]
    poses = [(mean.x, mean.y, mean.heading) for mean in means]
    digest.update(np.array(poses, np.float64).tobytes())
    return digest.digest()


def _header(made_by: str) -> dict[str, Any]:
    return {"format": FORMAT, "made_by": made_by}


def _parts(
    head: MergeHead,
    record: RestartRecord,
    merged: MergedMap,
    verdict_of: Callable[[Pair], Verdict | None],
    made_by: str,
) -> Iterator[NDArray[Any]]:
    mentioned = {node for graph in merged.graphs for node in graph.nodes} | merged.faded.keys()
    mentioned |= {node for link in merged.links for node in link.pair}
    mentioned |= {node for refusal in merged.refused for node in refusal.pair}
    nodes = sorted(mentioned)
    row = {node: k for k, node in enumerate(nodes)}
    edges = [refusal.edge for refusal in merged.refused if refusal.edge is not None]
    agents = sorted({end.agent for end in (*nodes, *edges)})
    number = {agent: k for k, agent in enumerate(agents)}
    reasons = {reason: k for k, reason in enumerate(sorted({refusal.reason for refusal in merged.refused}))}
    yield json_part(_header(made_by))
    yield np.frombuffer(encode(head, LIMIT), np.uint8)
    yield np.frombuffer(restart_record_file.packed(record, made_by), np.uint8)
    yield json_part(agents)
    yield json_part([*reasons])
    yield np.array([(number[n.agent], n.epoch, n.number) for n in nodes], np.int64).reshape(-1, 3)
    graphs = [graph for graph in merged.graphs if isinstance(graph, Component)]
    yield np.array([len(graph.nodes) for graph in graphs], np.int64)
    yield np.array([row[graph.anchor] for graph in graphs], np.int64)
    yield np.array([graph.unsettled for graph in graphs], np.int64)
    seats = [np.array([row[node] for node in graph.nodes], np.int32) for graph in graphs]
    yield np.concatenate([np.zeros(0, np.int32), *seats])
    yield np.concatenate([np.zeros((0, 3)), *(graph.means for graph in graphs)])
    yield from _factor_parts(graphs, seats, merged.links, row)
    yield from _link_parts(merged.links, row, verdict_of)
    yield from _refused_parts(merged.refused, row, reasons, number, verdict_of)
    yield np.array([row[node] for node in merged.faded], np.int32)
    yield np.array([len(flags) for flags in merged.faded.values()], np.int64)
    yield np.packbits(np.concatenate([np.zeros(0, np.bool_), *merged.faded.values()]))


def _factor_parts(
    graphs: Sequence[Component],
    seats: Sequence[NDArray[np.int32]],
    links: Sequence[Link],
    row: Mapping[NodeId, int],
) -> Iterator[NDArray[Any]]:
    """Factors by the links that they are of; only others are written out."""
    parts = [graph.factors for graph in graphs]
    yield np.array([len(part) for part in parts], np.int64)
    whole = Factors.together([Factors.of([], [], []), *parts])
    yield np.stack([whole.a, whole.b]).astype(np.int32)
    a, b = (
        np.concatenate([np.zeros(0, np.int64), *(seat[end] for seat, end in zip(seats, ends, strict=True))])
        for ends in ([part.a for part in parts], [part.b for part in parts])
    )
    of_links = Factors.of(
        [link.measurement for link in links], [row[link.a] for link in links], [row[link.b] for link in links]
    )
    keys, wanted = of_links.a * len(row) + of_links.b, a * len(row) + b
    order = np.argsort(keys, kind="stable")
    at = np.searchsorted(keys[order], wanted)
    link_of = np.full(len(whole), -1)
    if len(keys):
        near = order[np.minimum(at, len(keys) - 1)]
        same = (keys[near] == wanted) & (of_links.means[near] == whole.means).all(axis=1)
        same &= (of_links.weights[near] == whole.weights).all(axis=(1, 2))
        link_of[same] = near[same]
    yield link_of.astype(np.int32)
    yield whole.means[link_of < 0]
    yield whole.weights[link_of < 0]


def _factors(
    ends: NDArray[np.int32],
    link_of: NDArray[np.int32],
    explicit: tuple[NDArray[np.float64], NDArray[np.float64]],
    links: Sequence[Link],
) -> Factors:
    """All factors, of one component after the other."""
    means, weights = np.zeros((len(link_of), 3)), np.zeros((len(link_of), 3, 3))
    means[link_of < 0], weights[link_of < 0] = explicit
    some = np.flatnonzero(link_of >= 0)
    of_links = Factors.of(
        [links[k].measurement for k in link_of[some].tolist()], some.tolist(), some.tolist()
    )
    means[some], weights[some] = of_links.means, of_links.weights
    a, b = ends.astype(np.int64)
    return Factors(a, b, means, weights)


def _form(link: Link, found: Verdict | None) -> int:
    """How a link is written."""
    if not isinstance(found, Link):
        return WRITTEN_OUT
    found = found.canonical()
    if link is found or link.canonical() is found:
        return AS_FOUND
    link = link.canonical()
    same = link.a_from_b is found.a_from_b and link.shared is found.shared
    rest = {name: value for name, value in link.evidence.items() if name != ALIASED}
    return ALIASED_TOO if same and ALIASED in link.evidence and rest == found.evidence else WRITTEN_OUT


def _link_parts(
    links: Sequence[Link], row: Mapping[NodeId, int], verdict_of: Callable[[Pair], Verdict | None]
) -> Iterator[NDArray[Any]]:
    forms = [_form(link, verdict_of(link.key)) for link in links]
    yield np.array([(row[link.a], row[link.b]) for link in links], np.int32).reshape(-1, 2)
    yield np.array(forms, np.uint8)
    yield np.array([link.evidence.get(ALIASED, 0.0) for link in links], np.float64)
    yield from link_parts([link for link, form in zip(links, forms, strict=True) if form == WRITTEN_OUT])


def _read_links(
    parts: Iterator[NDArray[Any]], nodes: Sequence[NodeId], verdicts: Mapping[Pair, Verdict]
) -> list[Link]:
    pairs = [(nodes[a], nodes[b]) for a, b in next(parts).tolist()]
    forms, aliased = next(parts).tolist(), next(parts).tolist()
    whole = iter(read_links(parts, [p for p, form in zip(pairs, forms, strict=True) if form == WRITTEN_OUT]))
    return [
        next(whole) if form == WRITTEN_OUT else _found(verdicts[pair], form, count)
        for pair, form, count in zip(pairs, forms, aliased, strict=True)
    ]


def _found(verdict: Verdict, form: int, aliased: float) -> Link:
    if not isinstance(verdict, Link):
        raise TypeError(f"{verdict.a} and {verdict.b} are no link")
    link = verdict.canonical()
    return link if form == AS_FOUND else replace(link, evidence={**link.evidence, ALIASED: aliased})


def _refused_parts(
    refused: Sequence[RefusedLink],
    row: Mapping[NodeId, int],
    reasons: Mapping[str, int],
    agents: Mapping[str, int],
    verdict_of: Callable[[Pair], Verdict | None],
) -> Iterator[NDArray[Any]]:
    forms = []
    for refusal in refused:
        if refusal.edge is not None:
            forms.append(OWN_EDGE)
        elif refusal.link is None:
            forms.append(WORDS_ONLY)
        else:
            forms.append(_form(refusal.link, verdict_of(refusal.link.key)))
    yield np.array([(row[refusal.a], row[refusal.b]) for refusal in refused], np.int32).reshape(-1, 2)
    yield np.array(forms, np.uint8)
    yield np.array([reasons[refusal.reason] for refusal in refused], np.int32)
    some = [refusal.link for refusal in refused if refusal.link is not None and refusal.edge is None]
    yield np.array([link.evidence.get(ALIASED, 0.0) for link in some], np.float64)
    edges = [refusal.edge for refusal in refused if refusal.edge is not None]
    yield np.array([(agents[e.agent], e.epoch, e.number) for e in edges], np.int64).reshape(-1, 3)
    whole = [r.link for r, form in zip(refused, forms, strict=True) if form == WRITTEN_OUT and r.link]
    yield from link_parts([link.canonical() for link in whole])


def _read_refused(
    parts: Iterator[NDArray[Any]],
    nodes: Sequence[NodeId],
    reasons: Sequence[str],
    agents: Sequence[str],
    verdicts: Mapping[Pair, Verdict],
    maps: Mapping[MapId, HybridMap],
) -> list[RefusedLink]:
    pairs = [(nodes[a], nodes[b]) for a, b in next(parts).tolist()]
    forms, why = next(parts).tolist(), [reasons[k] for k in next(parts).tolist()]
    aliased = iter(next(parts).tolist())
    edges = iter([EdgeId(agents[a], epoch, number) for a, epoch, number in next(parts).tolist()])
    whole = iter(read_links(parts, [p for p, form in zip(pairs, forms, strict=True) if form == WRITTEN_OUT]))
    out = []
    for pair, form, reason in zip(pairs, forms, why, strict=True):
        if form == OWN_EDGE:
            edge = next(edges)
            out.append(refuse_edge(maps[edge.map].edges[edge], reason))
        elif form == WORDS_ONLY:
            out.append(RefusedLink(*pair, reason))
        else:
            count = next(aliased)
            link = next(whole) if form == WRITTEN_OUT else _found(verdicts[pair], form, count)
            out.append(refuse(link, reason))
    return out
