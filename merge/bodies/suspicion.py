"""Suspicion: what is asked of links that are left when others between the same two maps have been refuted.

Where bodies have refuted one story between two maps, places there are known to look alike, and in a warehouse
there is always a next story. It need not be one under which the two robots come near each other. But what
the cameras should have seen of each other's maps tells (`merge.bodies.absence`), and here it may decide: that
all things changed within the hour is less probable than that one more place looks like another.

A true story is safe: robots whose bodies and sensors speak for it are not suspected, at three places at least
views must show nothing of what they should, and the odds are fair as they are everywhere else, only that
fewer are asked for.
"""

from __future__ import annotations

import math

import numpy as np

from merge.bodies.absence import absence
from merge.bodies.clash import Clash
from merge.bodies.exclusion import evidence_in_all
from merge.bodies.settings import ExclusionSettings
from merge.bodies.trails import Trail
from merge.graph.posegraph import PoseGraph


def suspicion(
    graph: PoseGraph, first: Trail, second: Trail, settings: ExclusionSettings | None = None
) -> Clash | None:
    """Whether two robots' views contradict a merge of their maps that comes after a refuted one.

    Args:
        graph: the merged component that holds the nodes of both.
        first: of one robot.
        second: of another one.
        settings: when that is enough.

    Returns:
        The clash, or None if there is none, or nothing is known.
    """
    s = settings or ExclusionSettings()
    if first.clock != second.clock or first.agent == second.agent:
        return None
    views = absence(graph, first, second, s.absence)
    blank = views.show_nothing(s.absence)
    places = len(np.unique(views.witnesses(s.absence)[blank]))
    if places < s.least_witnesses or views.evidence(s.absence) < -math.log(s.doubt_again):
        return None
    evidence = views.evidence(s.absence) + evidence_in_all(graph, first, second, s)
    if evidence < -math.log(s.doubt_again):
        return None
    return Clash(first.agent, second.agent, first.clock, 0, 0.0, 0.0, evidence, blank=int(blank.sum()))
