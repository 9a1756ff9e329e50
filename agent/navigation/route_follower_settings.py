"""What can be set of the follower of routes."""

from __future__ import annotations

from dataclasses import dataclass, field

from mapweave.agent.localization.node_detector import NodeDetectorSettings


@dataclass(frozen=True)
class RouteFollowerSettings:
    """How a route is followed.

    Attributes:
        lookout: when a node ahead counts as found; a pose may be off by as much again for each metre
            driven blind.
        passed: an intermediate node is passed within this distance, m.
        sight_turn: a node's landmarks are looked for when the robot's heading is within this of it, rad.
        sight_reach: and the robot within this distance of it, m.
        look_every: ticks between two looks for the next nodes' landmarks.
        skip: nodes further along the route that are looked for as well.
        blind: way without any landmark in sight after which the robot must find itself again, m.
        goal_looks: fresh looks at the goal, averaged, that decide whether the robot stands there.
        hidden: seconds at the goal without its landmarks in sight, or recognised, after which it is not
            there, s.
        patience: seconds without getting on before an edge counts as blocked.
        parking_patience: likewise at the goal.
        stalled: seconds that the servo may take without getting nearer; then the robot drives around.
        stalled_parking: likewise on the way to the goal's pose, which may take a manoeuvre.
        barred: how long it drives around then, s.
        near: within this distance of the goal the last, blind turns are made if it is not in sight, m.
    """

    lookout: NodeDetectorSettings = field(default_factory=NodeDetectorSettings)
    passed: float = 0.22
    sight_turn: float = 0.6
    sight_reach: float = 1.4
    look_every: int = 4
    skip: int = 2
    blind: float = 2.0
    goal_looks: int = 4
    hidden: float = 2.0
    patience: float = 6.0
    parking_patience: float = 30.0
    stalled: float = 3.0
    stalled_parking: float = 10.0
    barred: float = 5.0
    near: float = 0.35
