"""Where a robot with a goal is: it searches on its own map and on the fleet's, and gets a fix on a node."""

from __future__ import annotations

from collections.abc import Generator

import numpy as np

from mapweave.agent.global_localization.candidates import Candidate, FleetMap, OwnMap
from mapweave.agent.global_localization.global_localization import LENIENT, STILL, GlobalLocalization
from mapweave.agent.global_localization.search_policy import BEYOND_PORTAL, TO_NAVIGATE
from mapweave.agent.localization.fix import Fix
from mapweave.agent.localization.node_localizer import NodeLocalizer
from mapweave.agent.motion_primitives import MotionPrimitives
from mapweave.agent.navigation.portal_crossing import PortalCrossing
from mapweave.agent.observation import Command, RobotDescription
from mapweave.agent.settings import AgentSettings
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.node import NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Sift

FixSearch = Generator[Command, None, Fix | None]


class Positioning:
    """Finds the robot. Nodes of another floor than that of the last fix come into question only once nothing
    else is found.

    Attributes:
        search: the search that goes on; None without one.
        place: that the last search has found; None if it found none.
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
        self._found_by = ""
        self._motion = motion
        self._description, self._lens, self._settings = description, lens, settings
        self._own, self._fleet = OwnMap(own_map, rng), FleetMap(motion)
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
        """Search until the robot is found.

        Args:
            expected: see GlobalLocalization.search.
        """
        self.search = self._localization
        return self._fix((yield from self._localization.search(expected)))

    def look(self, detail: str) -> FixSearch:
        """Stand still for one view, which may be less exact; None if it shows no place for certain."""
        self.search, self._localization.detail = self._localization, detail
        yield from self._motion.stand(STILL)
        return self._fix((yield from self._localization.look(LENIENT)))

    def find_beyond(self, crossing: PortalCrossing) -> FixSearch:
        """Look around once on the floor to which a portal leads, then by all that is known."""
        assert crossing.wait is not None, "the robot is at a portal"
        self.search = self._beyond
        self._own.elsewhere, self._fleet.near = crossing.elsewhere, crossing.wait.portal.exit
        return self._fix((yield from self._beyond.search()) or (yield from self._beyond.search()))

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
