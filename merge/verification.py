"""Candidate pairs become links: do the two nodes' landmarks agree on a posture?"""

from __future__ import annotations

import zlib

import numpy as np

from hybridmap.node import Node
from hybridmap.recognition import Recognition, RecognitionSettings, examine_nodes
from merge.links import Link, RefusedLink


def verify(a: Node, b: Node, settings: RecognitionSettings | None = None) -> Link | RefusedLink:
    """Compare two nodes.

    The answer depends on the two nodes alone: they are put in the order of their ids, and the random draws
    of the estimator start from the ids, so neither order of arrival nor other nodes have a say.

    Args:
        a: one node.
        b: another one.
        settings: when two nodes count as the same place.

    Returns:
        A link, or why there is none.
    """
    if b.id < a.id:
        a, b = b, a
    rng = np.random.default_rng(zlib.crc32(f"{a.id} {b.id}".encode()))
    verdict = examine_nodes(a, b, settings, rng)
    if isinstance(verdict, Recognition):
        return Link(a.id, b.id, verdict.node_from_robot, verdict.pairs, verdict.evidence)
    return RefusedLink(a.id, b.id, verdict.reason)
