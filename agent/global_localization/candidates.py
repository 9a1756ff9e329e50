"""Sources of place candidates for a view: the robot's own map, and the fleet's."""

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.global_localization.refuted_places import RefutedPlaces
from mapweave.agent.global_localization.view_agreement import ViewAgreement
from mapweave.agent.localization.place_recognition import aliased_places, recognise_places
from mapweave.agent.mission import WhereAmI
from mapweave.agent.motion_primitives import NO_ANSWER, MotionPrimitives
from mapweave.agent.observation import Command
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import PoseGaussian
from mapweave.hybridmap.query import Certainty, RelocalizeAnswer, View
from mapweave.registration.recognition import Recognition
from mapweave.vision.sift import Features

RIVAL = 0.5
"""Another node of the own map with this share of the best one's inliers is a rival,"""
APART = 0.5
"""if it puts the robot further away than this, m: then the view is ambiguous."""

SILENCE = 20.0
"""After an unanswered question the fleet is not asked for so long, s."""


@dataclass(frozen=True, eq=False)
class RecognizedNode:
    """A node of the own map, recognised in an image: its landmarks can be tracked from there on."""

    node: Node
    image: NDArray[np.uint8]
    features: Features
    recognition: Recognition


@dataclass(frozen=True, eq=False)
class Candidate:
    """A place where the robot may be.

    Attributes:
        node: of any robot's map.
        node_from_robot: pose.
        recognized: the recognition on the own map; None for a candidate of the fleet.
        distance_known: False if the distance to the node is unknown (a photograph of unknown scale).
    """

    node: NodeId
    node_from_robot: PoseGaussian
    recognized: RecognizedNode | None = None
    distance_known: bool = True


@dataclass(frozen=True, eq=False)
class RankedPlaces:
    """One source's candidates for a view.

    Attributes:
        places: best first.
        ambiguous: why the best cannot be distinguished from another, in words; else empty.
        reason: of the outcome, in words.
    """

    places: tuple[Candidate, ...]
    ambiguous: str
    reason: str


class OwnMapSource:
    """The robot's own map as a source of candidates.

    Attributes:
        map: which may grow.
        elsewhere: whether the robot knows that it is on another floor than this map.
    """

    def __init__(self, hybrid_map: HybridMap, rng: np.random.Generator) -> None:
        """Take the map, and the source of verification's random samples."""
        self.map = hybrid_map
        self.elsewhere = False
        self._rng = rng

    def candidates(self, view: View, image: NDArray[np.uint8], features: Features) -> RankedPlaces:
        """Nodes that a view shows, of an image with these features; the most certain pose first."""
        if self.elsewhere:
            return RankedPlaces((), "", "the own map is of another floor")
        recalled = recognise_places(self.map, view, self._rng)
        if not recalled:
            return RankedPlaces((), "", f"none of {len(self.map.nodes)} nodes is recognised")
        alike = aliased_places(recalled, RIVAL, APART)
        ambiguous = "" if alike is None else f"nodes {alike[0].id} and {alike[1].id} look the same"
        # A node from afar may show as many landmarks as the one at which the robot stands, which says more.
        recalled.sort(key=lambda pair: float(np.linalg.det(pair[1].node_from_robot.covariance)))
        places = tuple(
            Candidate(
                node.id, recognition.node_from_robot, RecognizedNode(node, image, features, recognition)
            )
            for node, recognition in recalled
        )
        best, recognition = recalled[0]
        return RankedPlaces(places, ambiguous, f"node {best.id}: {recognition.inliers} landmarks agree")


class FleetMapSource:
    """The fleet's merged map as a source of candidates: its server knows of rooms that look the same.

    Attributes:
        refuted: its places that the robot's own view did not bear out.
        near: the robot knows that it is on the floor of this node; None if it does not.
    """

    def __init__(self, motion: MotionPrimitives) -> None:
        """Take the motion primitives, which ask and stand still until the answer comes."""
        self.refuted = RefutedPlaces(motion)
        self.near: NodeId | None = None
        self._motion = motion
        self._silent_until = 0.0
        self._agreement = ViewAgreement()

    def candidates(self, view: View) -> Generator[Command, None, RankedPlaces]:
        """Where a view was taken, by the fleet's map; a silent fleet is not asked at each view.

        A view that is no proof alone counts together with an earlier one, see `ViewAgreement`.
        """
        if self._motion.now < self._silent_until:
            return RankedPlaces((), "", NO_ANSWER)
        answer = yield from self._motion.ask(WhereAmI(self._motion.number(), view, self.near))
        if answer.content is None:
            self._silent_until = self._motion.now + (answer.retry_after or SILENCE)
        if not isinstance(answer.content, RelocalizeAnswer):
            return RankedPlaces((), "", answer.error or "no answer")
        content, motion = answer.content, self._motion
        ambiguous = content.reason if content.certainty is Certainty.AMBIGUOUS else ""
        place = self._agreement.take(content, motion.odom_from_robot, motion.way, motion.turned)
        if place is None:
            return RankedPlaces((), ambiguous, content.reason)
        if self.refuted.holds(place.node):
            return RankedPlaces((), ambiguous, f"again node {place.node}, of which nothing was in view")
        reason = content.reason
        if content.certainty is Certainty.UNKNOWN:
            reason = f"{place.inliers} landmarks of {place.node} agree, and so does an earlier view"
        candidate = Candidate(place.node, place.node_from_robot, distance_known=place.distance_known)
        return RankedPlaces((candidate,), ambiguous, reason)
