"""What can be set of the servo."""

from __future__ import annotations

from dataclasses import dataclass, field

from mapweave.agent.servo.plan import Price


@dataclass(frozen=True, slots=True)
class ServoSettings:
    """Settings of the supervisor; the defaults suit a webcam at 10 Hz.

    Attributes:
        lambda_: gain lambda of the laws; 2 is critically damped.
        gain: 1/s, how fast time runs in the laws; multiplies both speeds.
        dead_zone: rho_D, m: nearer than this only the heading is mended.
        position_tolerance: m, estimated distance at which the goal counts as reached. A centimetre of true
            distance less what a pose filter may be off.
        heading_tolerance: rad.
        settle_ticks: ticks in a row inside both tolerances before the robot has arrived.
        min_visible: landmarks that must stay in view.
        min_depth: m, nearer landmarks do not count.
        field_margin: rad, room that ways keep to the border of the field of view where they can.
        least_margin: rad, room below which no way is taken.
        clearance: m, room between the footprint and obstacles.
        most_landmarks: how many landmarks ways are checked against.
        missed_ticks: a landmark that should be in view and is not tracked this long is not counted on.
        law_reach: m, nearer than this no law is taken up (one at work goes on): the direction to the goal
            is noise there, and short legs are surer.
        law_bonus: a law is preferred to a plan up to this share of extra cost.
        law_bonus_m: and up to this extra cost, m.
        horizon: s, look-ahead of the last check before a command leaves.
        forward_gain: 1/s, slows legs toward their end.
        turn_gain: 1/s, of turns on the spot and of the heading on legs.
        cruise: share of the robot's speed limits that is used.
        retreat: m, longest way back along the optical axis to find landmarks again.
        price: what turns and legs cost in a plan.
    """

    lambda_: float = 2.0
    gain: float = 1.5
    dead_zone: float = 0.004
    position_tolerance: float = 0.0075
    heading_tolerance: float = 0.008
    settle_ticks: int = 3
    min_visible: int = 4
    min_depth: float = 0.1
    field_margin: float = 0.05
    least_margin: float = 0.008
    clearance: float = 0.04
    most_landmarks: int = 24
    missed_ticks: int = 10
    law_reach: float = 0.04
    law_bonus: float = 0.15
    law_bonus_m: float = 0.05
    horizon: float = 0.15
    forward_gain: float = 1.5
    turn_gain: float = 2.5
    cruise: float = 1.0
    retreat: float = 0.6
    price: Price = field(default_factory=Price)

    def margins(self) -> tuple[float, ...]:
        """Margins to plan with, the widest first."""
        wide, least = self.field_margin, self.least_margin
        return (wide, 0.6 * wide, max(0.3 * wide, least), least)
