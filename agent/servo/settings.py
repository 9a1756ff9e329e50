"""What can be set of the servo."""

from __future__ import annotations

from dataclasses import dataclass, field

from mapweave.agent.servo.plan import Price

MIN_VISIBLE = 4
"""Landmarks that must stay in view."""
FIELD_MARGIN = 0.05
"""Rad, room that ways keep to the border of the field of view where they can."""
LEAST_MARGIN = 0.008
"""Rad, room below which no way is taken."""
TURN_GAIN = 2.5
"""1/s, of turns on the spot and of the heading on legs."""


@dataclass(frozen=True, slots=True)
class ServoSettings:
    """Settings of the supervisor; the defaults suit a webcam at 10 Hz.

    Attributes:
        price: what turns and legs cost in a plan.
    """

    price: Price = field(default_factory=Price)

    def margins(self) -> tuple[float, ...]:
        """Margins to plan with, the widest first."""
        wide, least = FIELD_MARGIN, LEAST_MARGIN
        return (wide, 0.6 * wide, max(0.3 * wide, least), least)
