"""A lost robot's search for itself: look, recognise, ask, turn, and drive on where all views are alike."""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass, field

import numpy as np

from agent.localizing.fix import Fix
from agent.localizing.localizer import Localizer, LocalizerSettings
from agent.localizing.recall import exact_enough, lookalikes, recall_all
from agent.mission import Answer, WhereAmI
from agent.navigating.helm import NO_ANSWER, Behaviour, Helm
from agent.observation import Command, RobotDescription
from agent.vision.lens import Lens
from agent.vision.sift import Sift
from hybridmap.hybrid_map import HybridMap
from hybridmap.node import Node
from hybridmap.pose import Pose2, PoseGaussian, wrap_angle
from hybridmap.query import Certainty, RelocalizeAnswer, View
from hybridmap.recognising.recognition import Recognition


@dataclass(frozen=True)
class SearchSettings:
    """How a lost robot finds itself.

    Attributes:
        still: seconds that it stands still before a look.
        look_turn: between two looks, rad.
        turn_rate: of that turn, rad/s.
        least_features: a view with fewer is not worth a question.
        sure: standard deviations up to which it believes a recognition at once, m and rad; the longer it has
            looked around, the less it asks for: twice as much after a whole turn.
        lenient: by how much less exact it may be where the robot has only just lost sight of everything.
        familiar: so many headings of nodes nearby are tried before a turn all around,
        nearby: of nodes within this, m,
        rich: with so many landmarks.
        rival: another node of the own map with this share of the best one's inliers has a say too;
        apart: if it puts the robot further away than this, m, the view is ambiguous.
        move: after a whole turn in vain it looks from elsewhere: this far away, m, if there is room,
        least_move: and at least this far, m; else it goes on turning.
        speed: of that drive, m/s.
        silence: after a question that nobody answered the own map alone is asked for so long, s.
        localizer: tracking and filtering of the landmarks that it has found.
    """

    still: float = 0.2
    look_turn: float = 0.5
    turn_rate: float = 0.6
    least_features: int = 8
    sure: tuple[float, float] = (0.06, 0.03)
    lenient: float = 2.0
    familiar: int = 3
    nearby: float = 0.8
    rich: int = 40
    rival: float = 0.6
    apart: float = 0.5
    move: float = 0.8
    least_move: float = 0.2
    speed: float = 0.2
    silence: float = 20.0
    localizer: LocalizerSettings = field(default_factory=LocalizerSettings)


class Search:
    """Finds out where the robot is. Of two places that look the same it takes neither.

    Attributes:
        detail: what it sees, in words.
    """

    def __init__(
        self,
        description: RobotDescription,
        lens: Lens,
        sift: Sift,
        own_map: HybridMap,
        helm: Helm,
        settings: SearchSettings,
        rng: np.random.Generator,
    ) -> None:
        """Take the means.

        Args:
            description: of the robot.
            lens: of its camera.
            sift: finds features.
            own_map: what the robot knows itself.
            helm: what moves the robot, and asks.
            settings: how.
            rng: for verification.
        """
        self.detail = ""
        self._description = description
        self._lens = lens
        self._sift = sift
        self._own_map = own_map
        self._helm = helm
        self._settings = settings
        self._rng = rng
        self._ambiguous = ""
        self._silent_until = 0.0

    def look_around(self, believed: Pose2 | None = None) -> Generator[Command, None, Fix]:
        """Look, ask, turn a little, and drive on after each whole turn, until somebody knows the view.

        Args:
            believed: `map_from_robot` in the own map by the wheels, if the robot has only just lost sight of
                everything: then it looks first where nodes nearby have looked.
        """
        s, looked = self._settings, 0.0
        self.detail, self._ambiguous = "looking", ""
        for heading in self._familiar(believed):
            yield from self._helm.turn(wrap_angle(heading - self._helm.odom_from_robot.heading), s.turn_rate)
            yield from self._helm.stand(s.still)
            fix = yield from self.look(s.lenient)
            if fix is not None:
                return fix
        while True:
            yield from self._helm.stand(s.still)
            fix = yield from self.look(1.0 + looked / math.tau)
            if fix is not None:
                return fix
            yield from self._helm.turn(s.look_turn, s.turn_rate)
            before, looked = looked, looked + s.look_turn
            if looked // math.tau > before // math.tau:
                yield from self._move_on()

    def look(self, leniency: float) -> Generator[Command, None, Fix | None]:
        """Recognise the current view, by the own map and by the fleet's, which must not contradict it.

        Args:
            leniency: by how much a recognition may be less exact than `sure`.
        """
        s, image = self._settings, self._helm.observation.image
        if image is None:
            self.detail = "no image from the camera"
            return None
        features = self._sift.extract(image)
        if len(features) < s.least_features:
            self.detail = f"only {len(features)} features in view"
            return None
        view = features.view(self._description.camera)
        own = self._known(recall_all(self._own_map, view, self._rng))
        if own is not None and not self._exact(own[1].node_from_robot, leniency):
            own = None
        answer = yield from self._ask(view)
        told = answer.content if isinstance(answer.content, RelocalizeAnswer) else None
        self.detail = (answer.error or "no answer") if told is None else told.reason
        if told is not None and told.certainty is Certainty.AMBIGUOUS:
            self._ambiguous = told.reason
            self.detail = f"ambiguous: {told.reason}"
            return None
        if own is not None and not self._contradicts(told, own):
            node, recognition = own
            self.detail = f"own map: node {node.id}, {recognition.inliers} landmarks agree"
            # The robot has stood still while the answer was on its way.
            return Fix.of(
                Localizer(self._description, self._lens, node, image, features, recognition, s.localizer)
            )
        if told is None or told.certainty not in (Certainty.FOUND, Certainty.PLACE):
            return None
        best = told.candidates[0]
        # How far away a photograph was taken shows on the way to it, not by looking again.
        if best.distance_known and not self._exact(best.node_from_robot, leniency):
            self.detail += ", but not exactly enough"
            return None
        return Fix(best.node, best.node_from_robot)

    def _ask(self, view: View) -> Generator[Command, None, Answer]:
        """Ask the fleet, which knows whether another robot's room looks the same; not in vain each time."""
        if self._helm.now < self._silent_until:
            return Answer(0, None, NO_ANSWER)
        answer = yield from self._helm.ask(WhereAmI(self._helm.number(), view))
        if answer.content is None:
            self._silent_until = self._helm.now + (answer.retry_after or self._settings.silence)
        return answer

    def _contradicts(self, told: RelocalizeAnswer | None, own: tuple[Node, Recognition]) -> bool:
        """Whether the fleet puts the robot elsewhere. It may not know yet what the own map knows."""
        if told is None or told.certainty is not Certainty.FOUND:
            return False
        best = told.candidates[0]
        known = self._own_map.nodes.get(best.node)
        if known is None:
            return True
        there = known.map_from_robot.mean @ best.node_from_robot.mean
        here = own[0].map_from_robot.mean @ own[1].node_from_robot.mean
        return here.distance(there) > self._settings.apart

    def _known(self, recalled: list[tuple[Node, Recognition]]) -> tuple[Node, Recognition] | None:
        """The own node that is seen best, unless another one, elsewhere, is seen about as well."""
        alike = lookalikes(recalled, self._settings.rival, self._settings.apart)
        if alike is not None:
            self._ambiguous = f"nodes {alike[0].id} and {alike[1].id} look the same"
            return None
        return next(iter(recalled), None)

    def _exact(self, posture: PoseGaussian, leniency: float) -> bool:
        """Whether a recognition is exact enough to drive by; else another look, elsewhere, costs little."""
        return exact_enough(posture, self._settings.sure, leniency)

    def _familiar(self, believed: Pose2 | None) -> list[float]:
        """Headings in the wheels' frame, rad, in which own nodes nearby have looked; the nearest first."""
        if believed is None:
            return []
        s, here = self._settings, self._helm.odom_from_robot.heading
        postures = [n.map_from_robot.mean for n in self._own_map.nodes.values() if len(n.landmarks) >= s.rich]
        turns = [
            wrap_angle(there.heading - believed.heading)
            for there in postures
            if believed.distance(there) <= s.nearby
        ]
        chosen: list[float] = []
        # It has just looked straight on.
        for turn in sorted(turns, key=abs):
            if all(abs(wrap_angle(turn - other)) >= s.look_turn for other in (0.0, *chosen)):
                chosen.append(turn)
        return [wrap_angle(here + turn) for turn in chosen[: s.familiar]]

    def _move_on(self) -> Behaviour:
        """All views from here are unknown or alike: look from where there is room.

        Whatever tells two places apart is to be seen from somewhere: a door that stands elsewhere, a
        picture around the corner.
        """
        s = self._settings
        way, direction = self._helm.freest()
        if way < s.least_move:
            self.detail = "no room to look from elsewhere"
            return
        why = f"ambiguous, {self._ambiguous}" if self._ambiguous else "nothing here is known"
        self.detail = f"{why}: driving on to look from elsewhere"
        self._ambiguous = ""
        yield from self._helm.turn(math.remainder(direction, math.tau), s.turn_rate)
        yield from self._helm.drive_on(min(way, s.move), s.speed)
