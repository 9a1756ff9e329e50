"""How much room ways keep to the border of the field of view, and what parts of the servo have in common."""

from __future__ import annotations

MIN_VISIBLE = 4
"""Landmarks that must stay in view."""
FIELD_MARGIN = 0.05
"""Rad, room that ways keep to the border of the field of view where they can."""
LEAST_MARGIN = 0.008
"""Rad, room below which no way is taken."""
TURN_GAIN = 2.5
"""1/s, of turns on the spot and of the heading on legs."""


def margins() -> tuple[float, ...]:
    """Margins to plan with, rad, the widest first."""
    wide, least = FIELD_MARGIN, LEAST_MARGIN
    return (wide, 0.6 * wide, max(0.3 * wide, least), least)
