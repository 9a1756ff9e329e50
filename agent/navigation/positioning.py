"""Where a robot with a goal is: it searches on its own map and on the fleet's, and gets a fix on a node."""

import math
from collections.abc import Generator

import numpy as np

from mapweave.agent.global_localization.candidates import Candidate, FleetMapSource, OwnMapSource
from mapweave.agent.global_localization.global_localization import (
    BEYOND_PORTAL,
    LENIENT,
    STILL,
    TO_NAVIGATE,
    GlobalLocalization,
)
from mapweave.agent.localization.fix import Fix
from mapweave.agent.localization.node_detector import Expected, NodeDetector
from mapweave.agent.localization.node_localizer import NodeLocalizer
from mapweave.agent.motion_primitives import MotionPrimitives
from mapweave.agent.navigation.portal_crossing import PortalCrossing
from mapweave.agent.observation import Command, RobotDescription
from mapweave.agent.settings import AgentSettings
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import RouteLeg
from mapweave.registration.recognition import RecognitionSettings
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Sift

LOOKS = 2
"""Failed views in a row after which a robot is lost; in between it drives on by odometry
(docs/decisions/routes.md)."""
FURTHER = 1.0
"""How far it drives on by odometry after a failed view, m. Chosen: odometry is off by a few percent of it,
and to turn back to what the robot knows, and about again, takes longer."""

FixSearch = Generator[Command, None, Fix | None]


class Positioning:
    """Finds the robot. Nodes of another floor than that of the last fix come into question only once nothing
    else is found.

    Attributes:
        search: the search that goes on; None without one.
        place: that the last search has found; None if it found none.
        failed_views: in a row, that showed no certain place.
        refuted: places of the fleet's map that the robot's own view did not bear out.
        detail: of the last search, in words.
    """

    def __init__(
        self,
        description: RobotDescription,
        lens: Lens,
        sift: Sift,
        own_map: HybridMap,
        motion: MotionPrimitives,
        settings: AgentSettings,
        rng: np.random.Generator,
        near: NodeId | None,
    ) -> None:
        """Take the means; see mapweave.agent.navigation.navigator.Navigator."""
        self.search: GlobalLocalization | None = None
        self.place: Candidate | None = None
        self.failed_views = 0
        self._found_by = ""
        self._motion = motion
        self._detector = NodeDetector(description, lens, sift, rng, settings)
        self._description, self._lens, self._settings = description, lens, settings
        self._own, self._fleet = OwnMapSource(own_map, rng), FleetMapSource(motion)
        self._fleet.near = near
        self.refuted = self._fleet.refuted
        self._localization, self._beyond = (
            GlobalLocalization(description, sift, motion, self._own, policy, self._fleet)
            for policy in (TO_NAVIGATE, BEYOND_PORTAL)
        )

    @property
    def detail(self) -> str:
        """What the search does, or has found, in words."""
        return self._found_by if self.search is None else self.search.detail

    def keep(self, fix: Fix) -> None:
        """Take note of where the robot is: if it gets lost, it is on this floor."""
        self._fleet.near = fix.node
        self._own.elsewhere &= fix.node not in self._own.map.nodes

    def find(self, expected: Pose2 | None) -> FixSearch:
        """Search until the robot is found."""
        self.search = self._localization
        return self._fix((yield from self._localization.search(expected)))

    def look(self, before: Fix | None, detail: str) -> FixSearch:
        """Stand still for one view, which may be less exact.

        Without a certain place in it the robot drives on a little by odometry, from the fix before; after
        some such views in a row it is lost: None.

        Args:
            before: where the robot was last known to be.
            detail: why it looks, in words.
        """
        self.search, self._localization.detail = self._localization, detail
        yield from self._motion.stand(STILL)
        fix = self._fix((yield from self._localization.look(LENIENT)))
        blind = self._settings.navigation.blind_distance
        if fix is None and before is not None and self.failed_views < LOOKS:
            self.failed_views += 1
            return Fix(before.node, before.node_from_robot, None, max(blind - FURTHER, 0.0))
        self.failed_views = 0
        return fix

    def find_beyond(self, crossing: PortalCrossing) -> FixSearch:
        """Look around once on the floor to which a portal leads, then by all that is known."""
        assert crossing.wait is not None, "the robot is at a portal"
        self.search = self._beyond
        self._own.elsewhere, self._fleet.near = crossing.elsewhere, crossing.wait.portal.exit
        return self._fix((yield from self._beyond.search()) or (yield from self._beyond.search()))

    def compared(self, route: tuple[RouteLeg, ...], fix: Fix) -> Fix:
        """The fix, or the robot's own if it sees the node by which the fleet has localized it.

        The robot still stands where it asked. What it recognises itself comes before any answer.
        """
        node = next((leg.node for leg in route if leg.node.id == fix.node), None)
        image = self._motion.observation.image
        if node is None or image is None:
            return fix
        # More is asked than of an expected node: any pose will do.
        anywhere = Expected(0, node, fix.node_from_robot.mean, math.inf)
        seen = self._detector.find(image, [anywhere], RecognitionSettings())
        return fix if seen is None else Fix.of(seen[1])

    def on_own_map(self, fix: Fix | None) -> Pose2 | None:
        """`map_from_robot` in the own map, if the fix is on one of its nodes."""
        node = None if fix is None else self._own.map.nodes.get(fix.node)
        if fix is None or node is None:
            return None
        return node.map_from_robot.mean @ fix.node_from_robot.mean

    def _fix(self, place: Candidate | None) -> Fix | None:
        """The fix at the place that was found, if one was."""
        self._found_by, self.search, self.place = self.detail, None, place
        if place is None:
            return None
        if (recognized := place.recognized) is None:
            return Fix(place.node, place.node_from_robot)
        localizer = NodeLocalizer(
            self._description, self._lens, recognized.node, recognized.image, recognized.features,
            recognized.recognition, self._settings,
        )  # fmt: skip
        return Fix.of(localizer)
