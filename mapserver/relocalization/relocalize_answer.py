"""A verdict as the answer that robots and people get: poses, probabilities, and a reason in words."""

from collections.abc import Callable, Sequence

from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import PoseGaussian, wrap_angle
from mapweave.hybridmap.query import NO_COMPONENT, Certainty, RelocalizeAnswer, SimilarPlace, Whereabouts
from mapweave.mapserver.relocalization.aliased_landmarks import between
from mapweave.mapserver.relocalization.calibration import probabilities
from mapweave.mapserver.relocalization.place_hypotheses import ALONE, NodeMatch, PlaceHypothesis, supported
from mapweave.mapserver.relocalization.verdict import Outcome, Verdict
from mapweave.mapserver.relocalization.view_registration import Registration
from mapweave.merge.pose_graph.merged_map import MergedMap

MOST_SIMILAR = 3
"""Places that are named if none is recognised."""


def answer_of(
    verdict: Verdict, merged: MergedMap, node_of: Callable[[NodeId], Node | None], least_features: int
) -> RelocalizeAnswer:
    """Put a verdict into an answer.

    A place that seems certain while a part of the map is missing is ambiguous: its like may be in that part.
    """
    reason = _reason(verdict, merged, least_features)
    known = verdict.outcome in (Outcome.FOUND, Outcome.AMBIGUOUS)
    similar = () if known else similar_places(verdict, least_features)
    if verdict.missing:
        reason = f"{reason}; partial: {verdict.missing}"
    if not known and not verdict.confirmable:
        return RelocalizeAnswer(Certainty.UNKNOWN, (), reason, similar, verdict.missing)
    chances = probabilities(supported(verdict.places))
    candidates = tuple(
        _whereabouts(place, chance, merged, node_of)
        for place, chance in zip(verdict.places, chances, strict=True)
    )
    if verdict.missing:
        return RelocalizeAnswer(Certainty.AMBIGUOUS, candidates, reason, similar, verdict.missing)
    certainty = Certainty.UNKNOWN if verdict.confirmable else Certainty.AMBIGUOUS
    if verdict.outcome is Outcome.FOUND:
        # The distance from a photograph is unknown.
        certainty = Certainty.FOUND if candidates[0].distance_known else Certainty.PLACE
    return RelocalizeAnswer(certainty, candidates, reason, similar)


def similar_places(verdict: Verdict, least_features: int) -> tuple[SimilarPlace, ...]:
    """What came nearest to being recognised, and what was missing: places with most landmarks first.

    Args:
        verdict: that no place is certain.
        least_features: landmarks that must agree in any case.
    """
    weak = [
        SimilarPlace(
            match.node,
            match.recognition.matches,
            match.recognition.inliers,
            ALONE,
            _weakness(match),
            _turn(match.recognition.node_from_robot),
        )
        for match in verdict.registration.matches
    ]
    refused = [
        SimilarPlace(
            node,
            refusal.matches,
            refusal.inliers,
            least_features,
            refusal.reason,
            _turn(refusal.node_from_robot),
        )
        for node, refusal in verdict.registration.refusals
        if refusal.matches
    ]
    ranked = sorted(refused, key=lambda one: (-one.inliers, -one.matches, one.node))
    return tuple([*weak, *ranked][:MOST_SIMILAR])


def _weakness(match: NodeMatch) -> str:
    if match.one_thing:
        return "all landmarks that agree are on one thing, and nothing of what should be around it is seen"
    agree = f"{match.recognition.inliers} landmarks agree"
    return f"{agree}; {ALONE} are needed, or a second node that confirms it"


def _turn(node_from_robot: PoseGaussian | None) -> float | None:
    return None if node_from_robot is None else wrap_angle(-node_from_robot.mean.heading)


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
        first, others = verdict.places[0].best, len(verdict.places[0].matches) - 1
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
        words += f", and {counted(around, 'node')} around them {'looks' if around == 1 else 'look'} the same"
    if any(between(merged, rivals[0].best.node, place.best.node) is None for place in rivals):
        words += ", and nothing joins their parts of the map yet"
    return words


def _nearest_refusal(registration: Registration) -> str:
    """The reason of the node that came nearest to being recognised."""
    if not registration.refusals:
        return "the similar nodes are gone"
    # Of equals the first, as in `similar_places`.
    node, refusal = min(registration.refusals, key=lambda item: (-item[1].inliers, -item[1].matches, item[0]))
    return f"not recognised; nearest is {node}: {refusal.reason}"
