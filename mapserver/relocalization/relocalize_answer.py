"""A verdict as the answer that robots and people get: poses, probabilities, and a reason in words."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from mapweave.hybridmap.node import Node, NodeId
from mapweave.hybridmap.query import NO_COMPONENT, Certainty, RelocalizeAnswer, Whereabouts
from mapweave.mapserver.relocalization.aliased_landmarks import between
from mapweave.mapserver.relocalization.calibration import probabilities
from mapweave.mapserver.relocalization.place_hypotheses import PlaceHypothesis, supported
from mapweave.mapserver.relocalization.verdict import Outcome, Verdict
from mapweave.mapserver.relocalization.view_registration import Registration
from mapweave.merge.pose_graph.merged_map import MergedMap


def answer_of(
    verdict: Verdict, merged: MergedMap, node_of: Callable[[NodeId], Node | None], least_features: int
) -> RelocalizeAnswer:
    """Put a verdict into an answer.

    Args:
        verdict: the places and the outcome.
        merged: where nodes are.
        node_of: gives a node by its id.
        least_features: that a view needs.
    """
    reason = _reason(verdict, merged, least_features)
    if verdict.outcome not in (Outcome.FOUND, Outcome.AMBIGUOUS) and not verdict.confirmable:
        return RelocalizeAnswer(Certainty.UNKNOWN, (), reason)
    chances = probabilities(supported(verdict.places))
    candidates = tuple(
        _whereabouts(place, chance, merged, node_of)
        for place, chance in zip(verdict.places, chances, strict=True)
    )
    certainty = Certainty.UNKNOWN if verdict.confirmable else Certainty.AMBIGUOUS
    if verdict.outcome is Outcome.FOUND:
        # The distance from a photograph is unknown.
        certainty = Certainty.FOUND if candidates[0].distance_known else Certainty.PLACE
    return RelocalizeAnswer(certainty, candidates, reason)


def _whereabouts(
    place: PlaceHypothesis,
    probability: float,
    merged: MergedMap,
    node_of: Callable[[NodeId], Node | None],
) -> Whereabouts:
    best, placement = place.best, merged.poses.get(place.best.node)
    node = node_of(best.node)
    return Whereabouts(
        best.node,
        place.best_from_robot,
        None if placement is None else placement.merged_from_robot @ place.best_from_robot,
        NO_COMPONENT if placement is None else placement.component,
        best.recognition.inliers,
        probability,
        distance_known=node is None or not node.landmarks.scale_share,
    )


def _reason(verdict: Verdict, merged: MergedMap, least_features: int) -> str:
    """The outcome in words."""
    words = ""
    if verdict.places:
        first, others = verdict.places[0].best, len(verdict.places[0].sightings) - 1
        words = f"{first.recognition.inliers} landmarks of {first.node} agree"
    match verdict.outcome:
        case Outcome.FOUND:
            return f"{words}, and {others} more nodes with them" if others else words
        case Outcome.AMBIGUOUS:
            return _rivalry(verdict.rivals, merged)
        case Outcome.FEW_FEATURES:
            features = len(verdict.registration.candidates.view)
            return f"the view has {features} features; {least_features} are needed"
        case Outcome.NO_CANDIDATE:
            return "no node of any map has features like these"
        case Outcome.NOT_RECOGNISED:
            return _nearest_refusal(verdict.registration)
        case Outcome.ONE_WEAK_NODE:
            return f"not sure: {words}, and no other node confirms it"
        case Outcome.ONE_THING:
            return f"not sure: {words}, all on one thing, and nothing of what should be around it"


def _rivalry(rivals: Sequence[PlaceHypothesis], merged: MergedMap) -> str:
    """The possible places, and their aliasing, in words."""
    names = " or ".join(str(place.best.node) for place in rivals)
    most, least = len(rivals[0].features), len(rivals[-1].features)
    words = f"it may be {names}: they explain {most} to {least} features"
    around = max(place.nodes_around for place in rivals)
    if around:
        words += f", and {around} nodes around them look the same"
    if any(between(merged, rivals[0].best.node, place.best.node) is None for place in rivals):
        words += ", and nothing joins their parts of the map yet"
    return words


def _nearest_refusal(registration: Registration) -> str:
    """The reason of the node that came nearest to being recognised."""
    if not registration.refusals:
        return "the similar nodes are gone"
    node, refusal = max(registration.refusals, key=lambda item: (item[1].inliers, item[1].matches, item[0]))
    return f"not recognised; nearest is {node}: {refusal.reason}"
