"""What can be set of the follower of routes."""

from __future__ import annotations

from dataclasses import dataclass, field

from mapweave.agent.localization.node_detector import NodeDetectorSettings

NEAR = 0.35
"""Within this distance of the goal the last, blind turns are made if it is not visible, m."""


@dataclass(frozen=True)
class RouteFollowerSettings:
    """How a route is followed.

    Attributes:
        lookout: when a node ahead counts as found; a pose may be off by as much again for each metre
            driven blind.
        blind: way without any landmark in sight after which the robot must find itself again, m.
        parking_patience: likewise at the goal.
    """

    lookout: NodeDetectorSettings = field(default_factory=NodeDetectorSettings)
    blind: float = 2.0
    parking_patience: float = 30.0
