"""What answers are worth, by the truth."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.relocalize.places import TruePlace
from benchmarks.relocalize.queries import Query
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Array, PoseGaussian, wrap_angle
from mapweave.hybridmap.query import Certainty, RelocalizeAnswer, View

RIGHT_M, RIGHT_DEG = 0.25, 5.0
"""A place is recalled if its answer is this precise."""
STRANGERS = ("nowhere", "twins")
"""Kinds of queries to which "here" is never the right answer."""


@dataclass(frozen=True, eq=False)
class ScoredAnswer:
    """One answer, and what the truth says to it.

    Attributes:
        query: what was asked.
        certainty: of the answer.
        error_m: of its best candidate; infinite if that is in another building, or there is none.
        error_deg: likewise.
        nees: squared Mahalanobis distance of the truth, 3 expected; NaN without a candidate there.
        ms: from features to answer.
        cpu_ms: of processors meanwhile: a busy machine leaves it nearly as it is.
    """

    query: Query
    certainty: Certainty
    error_m: float
    error_deg: float
    nees: float
    ms: float = 0.0
    cpu_ms: float = 0.0

    @property
    def near(self) -> bool:
        """Whether the best candidate is where the robot is."""
        return self.error_m <= RIGHT_M and self.error_deg <= RIGHT_DEG

    @property
    def recalled(self) -> bool:
        """Whether it said "here", rightly."""
        return self.certainty is Certainty.FOUND and self.near


def ask(
    answer: Callable[[View], RelocalizeAnswer],
    queries: Sequence[Query],
    truth: Mapping[NodeId, TruePlace],
    progress: Callable[[], None],
    aside: Callable[[], Array] = lambda: np.zeros(2),
) -> list[ScoredAnswer]:
    """Ask all questions, one after the other.

    Args:
        answer: a relocalizer's.
        queries: what to ask.
        truth: about the real places.
        progress: called once a question.
        aside: what was spent so far, see `spent`, on what a server has ready and the benchmark has not; it
            does not count.
    """
    replies = []
    for query in queries:
        view = query.picture.view
        began = spent() - aside()
        answered = answer(view)
        ms, cpu_ms = 1e3 * (spent() - aside() - began)
        replies.append(replace(judged(query, answered, truth), ms=float(ms), cpu_ms=float(cpu_ms)))
        progress()
    return replies


def spent() -> Array:
    """(2,) s on the clock on the wall, and of processors by this process."""
    return np.array([time.perf_counter(), time.process_time()])


def judged(query: Query, answered: RelocalizeAnswer, truth: Mapping[NodeId, TruePlace]) -> ScoredAnswer:
    """Compare an answer with the truth."""
    if not answered.candidates:
        return ScoredAnswer(query, answered.certainty, math.inf, math.inf, math.nan)
    best = answered.candidates[0]
    place = truth.get(best.node)
    error_m, error_deg = errors(query, place, best.node_from_robot)
    nees = math.nan
    if place is not None and place.site == query.site:
        true = place.world_from_node.inverse() @ query.picture.world_from_robot
        nees = best.node_from_robot.mahalanobis2(true)
    return ScoredAnswer(query, answered.certainty, error_m, error_deg, nees)


def errors(query: Query, place: TruePlace | None, node_from_robot: PoseGaussian) -> tuple[float, float]:
    """How far a pose at a place is off, m and degrees; infinite in another building."""
    if place is None or place.site != query.site:
        return math.inf, math.inf
    true = place.world_from_node.inverse() @ query.picture.world_from_robot
    mean = node_from_robot.mean
    return mean.distance(true), abs(math.degrees(wrap_angle(mean.heading - true.heading)))


def share(replies: Sequence[ScoredAnswer], what: Callable[[ScoredAnswer], bool]) -> float:
    """The share of replies, NaN of none."""
    return round(sum(map(what, replies)) / len(replies), 4) if replies else math.nan


def figures(replies: Sequence[ScoredAnswer]) -> dict[str, float]:
    """The figures of one index; recall and errors are those of undisturbed views near nodes."""
    near = [reply for reply in replies if reply.query.kind == "near"]
    strangers = [reply for reply in replies if reply.query.kind in STRANGERS]
    known = [reply for reply in replies if reply.query.kind not in STRANGERS]
    right = [reply for reply in near if reply.recalled]
    ms, cpu_ms = [reply.ms for reply in replies], [reply.cpu_ms for reply in replies]
    return {
        "recall_at_1": share(near, lambda r: r.recalled),
        "false_accept": share(strangers, _found),
        "wrong_place": share(known, lambda r: _found(r) and not r.near),
        "ambiguous": share(near, lambda r: r.certainty is Certainty.AMBIGUOUS),
        "error_m_median": _middle([r.error_m for r in right]),
        "error_deg_median": _middle([r.error_deg for r in right]),
        "nees": round(float(np.mean([r.nees for r in right])), 3) if right else math.nan,
        "nees_over_16": share(right, lambda r: r.nees > 16.3),
        "p50_ms": round(float(np.percentile(ms, 50)), 2),
        "p95_ms": round(float(np.percentile(ms, 95)), 2),
        "cpu_p50_ms": round(float(np.percentile(cpu_ms, 50)), 2),
        "cpu_p95_ms": round(float(np.percentile(cpu_ms, 95)), 2),
    }


def recall_by_kind(replies: Sequence[ScoredAnswer]) -> dict[str, float]:
    """Recall of each kind of view of a mapped place."""
    kinds = dict.fromkeys(r.query.kind for r in replies if r.query.kind not in STRANGERS)
    return {kind: share([r for r in replies if r.query.kind == kind], lambda r: r.recalled) for kind in kinds}


def wrong_by_kind(replies: Sequence[ScoredAnswer]) -> dict[str, float]:
    """Share of each kind of view that was answered "here" wrongly; of strangers any such answer is wrong."""
    kinds = dict.fromkeys(r.query.kind for r in replies)
    return {
        kind: share(
            [r for r in replies if r.query.kind == kind],
            lambda r: _found(r) and (r.query.kind in STRANGERS or not r.near),
        )
        for kind in kinds
    }


def _found(reply: ScoredAnswer) -> bool:
    return reply.certainty is Certainty.FOUND


def _middle(values: Sequence[float]) -> float:
    return round(float(np.median(values)), 4) if values else math.nan
