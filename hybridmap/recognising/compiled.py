"""All inner loops as machine code; hybridmap.recognising.algebra has the same in NumPy."""

from hybridmap.recognising.compiled_hypotheses import from_three_bearings, from_two_points, log_ratios
from hybridmap.recognising.compiled_matching import squared_steps, two_nearest
from hybridmap.recognising.compiled_postures import (
    determined,
    improve,
    linearise,
    normal_equations,
    predict,
)

__all__ = [
    "determined", "from_three_bearings", "from_two_points", "improve", "linearise", "log_ratios",
    "normal_equations", "predict", "squared_steps", "two_nearest",
]  # fmt: skip
