"""The verification cache as a file (see mapweave.mapserver.checksummed_file), so that a restarted server need
not compare again.

header (JSON), agents (JSON), nodes, prints, overlaps, verdicts, reasons (JSON), links ...
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.landmark_tables import VERSION as TABLES
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.mapserver.checksummed_file import FileKind, json_part, read_json
from mapweave.mapserver.merging.verification_cache import PRINT_BYTES, VerificationCache
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.links import Link, RefusedLink
from mapweave.merge.pose_graph.verdicts import Verdict

MAGIC = b"mapweave verdicts\n"
FORMAT = 1


def _parts(findings: VerificationCache) -> Iterator[NDArray[Any]]:
    nodes = sorted(findings.prints)
    row = {node: k for k, node in enumerate(nodes)}
    agents = sorted({node.agent for node in nodes})
    number = {agent: k for k, agent in enumerate(agents)}
    yield json_part(agents)
    yield np.array([(number[n.agent], n.epoch, n.number) for n in nodes], np.int64).reshape(-1, 3)
    yield np.frombuffer(b"".join(findings.prints[n] for n in nodes), np.uint8).reshape(-1, PRINT_BYTES)
    overlaps = _with_rows(findings.overlaps.items(), row)
    yield _rows([pair for pair, _ in overlaps], row)
    yield np.array([value for _, value in overlaps], np.float64)
    verdicts = _with_rows(findings.verdicts.items(), row)
    refused = [(pair, v.reason) for pair, v in verdicts if isinstance(v, RefusedLink)]
    links = [(pair, v) for pair, v in verdicts if isinstance(v, Link)]
    reasons = {reason: k for k, reason in enumerate(sorted({reason for _, reason in refused}))}
    yield json_part(list(reasons))
    yield _rows([pair for pair, _ in refused], row)
    yield np.array([reasons[reason] for _, reason in refused], np.int64)
    yield _rows([pair for pair, _ in links], row)
    yield from link_parts([link for _, link in links])


def link_parts(links: Sequence[Link]) -> Iterator[NDArray[Any]]:
    """What links say of their two nodes."""
    yield np.array([link.a_from_b.mean.vector for link in links], np.float64).reshape(-1, 3)
    yield np.array([link.a_from_b.covariance for link in links], np.float64).reshape(-1, 3, 3)
    yield np.cumsum([0, *(len(link.shared) for link in links)])
    yield np.concatenate([np.zeros((0, 2), np.int64), *(link.shared for link in links)])
    kinds = {kind: k for k, kind in enumerate(sorted({tuple(link.evidence) for link in links}))}
    yield json_part([list(kind) for kind in kinds])
    yield np.array([kinds[tuple(link.evidence)] for link in links], np.int64)
    yield np.cumsum([0, *(len(link.evidence) for link in links)])
    yield np.array([value for link in links for value in link.evidence.values()], np.float64)


def _read(parts: Iterator[NDArray[Any]]) -> VerificationCache:
    agents = read_json(next(parts))
    nodes = [NodeId(agents[a], epoch, number) for a, epoch, number in next(parts).tolist()]
    prints = {node: checksum.tobytes() for node, checksum in zip(nodes, next(parts), strict=True)}
    overlaps = dict(zip(_pairs(next(parts), nodes), next(parts).tolist(), strict=True))
    reasons = read_json(next(parts))
    refused = zip(_pairs(next(parts), nodes), next(parts).tolist(), strict=True)
    verdicts: dict[Pair, Verdict] = {pair: RefusedLink(*pair, reasons[k]) for pair, k in refused}
    links = read_links(parts, _pairs(next(parts), nodes))
    return VerificationCache(prints, overlaps, verdicts | {link.pair: link for link in links})


def read_links(parts: Iterator[NDArray[Any]], pairs: Sequence[Pair]) -> list[Link]:
    """Links of these nodes, of what `link_parts` yields."""
    means, covariances = next(parts).tolist(), next(parts)
    shared_at, shared = next(parts).tolist(), next(parts)
    kinds, kind = read_json(next(parts)), next(parts).tolist()
    evidence_at, evidence = next(parts).tolist(), next(parts).tolist()
    return [
        Link(
            *pair,
            PoseGaussian(Pose2(*means[k]), covariances[k]),
            shared[i:j],
            dict(zip(kinds[kind[k]], evidence[m:n], strict=True)),
        )
        for k, (pair, (i, j), (m, n)) in enumerate(
            zip(pairs, pairwise(shared_at), pairwise(evidence_at), strict=True)
        )
    ]


def _with_rows(results: Iterable[tuple[Pair, Any]], row: dict[NodeId, int]) -> list[tuple[Pair, Any]]:
    """The rows of pairs of which both nodes are among those that are kept, in the order of ids."""
    return sorted(((p, v) for p, v in results if p[0] in row and p[1] in row), key=lambda item: item[0])


def _rows(pairs: Sequence[Pair], row: dict[NodeId, int]) -> NDArray[np.int64]:
    return np.array([(row[a], row[b]) for a, b in pairs], np.int64).reshape(-1, 2)


def _pairs(rows: NDArray[np.int64], nodes: Sequence[NodeId]) -> list[Pair]:
    return [(nodes[a], nodes[b]) for a, b in rows.tolist()]


FILE = FileKind(MAGIC, {"format": FORMAT, "tables": TABLES}, _parts, _read, "are no verdicts of this version")
save, packed, load = FILE.save, FILE.packed, FILE.load
