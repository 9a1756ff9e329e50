"""How much room ways keep to the border of the field of view, and what parts of the servo have in common."""

MIN_VISIBLE = 4
"""Landmarks that must stay in view."""
FIELD_MARGIN = 0.05
"""Room that ways keep to the border of the field of view where they can, rad."""
LEAST_MARGIN = 0.008
"""Room below which no way is taken, rad."""
TURN_GAIN = 2.5
"""Gain of turns on the spot and of the heading on legs, 1/s."""
MARGINS = (FIELD_MARGIN, 0.6 * FIELD_MARGIN, 0.3 * FIELD_MARGIN, LEAST_MARGIN)
"""Margins to plan with, rad, the widest first."""
