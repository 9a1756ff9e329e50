"""Suspicion: what is asked of links that are left when others between the same two maps have been refuted.

Where bodies have refuted one story between two maps, places there are known to look alike, and in a warehouse
there is always a next story. It need not be one under which the two robots come near each other. But what
the cameras should have seen of each other's maps tells
(`mapweave.merge.mutual_exclusion.negative_evidence`), and here it may decide: that all things changed within
the hour is less probable than that one more place looks like another.

A true story is safe: robots whose bodies and sensors speak for it are not suspected, at three places at least
views must show nothing of what they should, and the odds are fair as they are everywhere else, only that
fewer are asked for.
"""

from __future__ import annotations

import math

import numpy as np

from mapweave.merge.mutual_exclusion.collision import Collision
from mapweave.merge.mutual_exclusion.exclusion import evidence_in_all
from mapweave.merge.mutual_exclusion.negative_evidence import negative_evidence
from mapweave.merge.mutual_exclusion.settings import ExclusionSettings
from mapweave.merge.mutual_exclusion.trajectories import BodyTrajectory
from mapweave.merge.pose_graph.solved_graph import PoseGraph


def suspicion(
    graph: PoseGraph, first: BodyTrajectory, second: BodyTrajectory, settings: ExclusionSettings | None = None
) -> Collision | None:
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
    views = negative_evidence(graph, first, second, s.absence)
    blank = views.show_nothing(s.absence)
    places = len(np.unique(views.witnesses(s.absence)[blank]))
    if places < s.least_witnesses or views.evidence(s.absence) < -math.log(s.doubt_again):
        return None
    evidence = views.evidence(s.absence) + evidence_in_all(graph, first, second, s)
    if evidence < -math.log(s.doubt_again):
        return None
    return Collision(first.agent, second.agent, first.clock, 0, 0.0, 0.0, evidence, blank=int(blank.sum()))
