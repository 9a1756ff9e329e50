"""Candidate pairs become links: do the two nodes' landmarks agree on a pose?"""

import math
import zlib

import numpy as np

from mapweave.hybridmap.node import Node
from mapweave.merge.pose_graph.links import Link, RefusedLink
from mapweave.registration.recognition import (
    Recognition,
    RecognitionFailure,
    RecognitionSettings,
    examine_nodes,
)

MOST_SIGMA_XY = 0.16
"""Largest standard deviation of their relative position, m. A link that may be off by half a metre joins
nothing that a robot could drive."""


MOST_SIGMA_HEADING = 0.05
"""Largest standard deviation of their relative heading, rad."""


def verify(a: Node, b: Node, settings: RecognitionSettings | None = None) -> Link | RefusedLink:
    """Compare two nodes.

    The answer depends on the two nodes alone: they are put in the order of their ids, and the ids seed the
    estimator's random numbers, so neither order of arrival nor other nodes matter.

    Returns:
        A link, or why there is none.
    """
    if b.id < a.id:
        a, b = b, a
    verdict = examine(a, b, settings)
    if isinstance(verdict, Recognition):
        sigma_xy, sigma_heading = verdict.evidence["sigma_xy"], verdict.evidence["sigma_heading"]
        if sigma_xy > MOST_SIGMA_XY or sigma_heading > MOST_SIGMA_HEADING:
            degrees = math.degrees(sigma_heading)
            reason = f"the same place, but known to {sigma_xy:.2f} m and {degrees:.1f} deg only"
            return RefusedLink(a.id, b.id, reason)
        return Link(a.id, b.id, verdict.node_from_robot, verdict.pairs, verdict.evidence)
    return RefusedLink(a.id, b.id, verdict.reason)


def examine(
    a: Node, b: Node, settings: RecognitionSettings | None = None
) -> Recognition | RecognitionFailure:
    """Input of `verify`: the same seeds, the same numbers.

    Args:
        a: the node with the smaller id.
        b: the other one.
        settings: when they are linked.
    """
    rng = np.random.default_rng(zlib.crc32(f"{a.id} {b.id}".encode()))
    return examine_nodes(a, b, settings, rng)
