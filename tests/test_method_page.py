"""docs/method.md: its charts, numbers, equations and the files that it names are those of the code."""

import math
import re
from pathlib import Path

import numpy as np
import pytest

from mapweave.agent.ekf import gating, localization_filter, mapping_filter, motion
from mapweave.agent.exploration import behaviours, carried_mapping
from mapweave.agent.mapping import initial_depth, keyframe_builder, mapper
from mapweave.agent.observation import RobotDescription
from mapweave.agent.servo import margins, supervisor, visibility
from mapweave.agent.servo.laws import BETA_SHIFT, PHI_SHIFT, charts, control
from mapweave.agent.settings import FilterSettings

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
FLAT = " ".join(PAGE.split())
FILTER = FilterSettings()
NUMBERS = (
    ("λ = {:g}, and a gain", supervisor.LAMBDA),
    ("a gain of {:g} on both speeds", supervisor.GAIN),
    ("ρ_D = {:g} mm", 1000 * supervisor.DEAD_ZONE),
    ("nearer than {:g} m. At distance", visibility.MIN_DEPTH),
    ("landmarks in view by {:g} rad", margins.FIELD_MARGIN),
    ("no longer keeps {:g} rad", 0.5 * margins.LEAST_MARGIN),
    ("σ = {:g} of its way", RobotDescription.__dataclass_fields__["wheel_noise"].default),
    ("σ₃ = {:g} (|u₁|", RobotDescription.__dataclass_fields__["side_slip"].default),
    ("σ_px is {:g} px", FILTER.pixel_sigma),
    ("the {:g} % gate", 100 * gating.GATE_PROBABILITY),
    ("the depth is {:g} times the camera's height", mapper.DEPTHS_PER_HEIGHT),
    ("w is {:g} of its value", initial_depth.PRIOR_SPREAD),
    ("at least {:g} over the camera's height", initial_depth.PRIOR_NEAR),
    ("depth sigma of {:g} cm", 100 * mapping_filter.CONVERGED_SIGMA),
    ("cm or {:g} % of its depth", 100 * mapping_filter.CONVERGED_SHARE),
    ("when {:g} % of its landmarks have", 100 * carried_mapping.CONVERGED),
    ("drives {:g} m forth and back", behaviours.DRIVE),
    ("below 1/{:g} of its depth", 1 / keyframe_builder.DEPTH_SHARE),
    ("up to {:g} landmarks", keyframe_builder.MOST_LANDMARKS),
    ("The paper's {:g} m and", localization_filter.LOST_POSITION),
    ("m and {:g} rad are what", localization_filter.LOST_HEADING),
    ("less certain than {:g} rad", localization_filter.LOOSE_HEADING),
)


@pytest.mark.parametrize(("words", "value"), NUMBERS)
def test_numbers_of_the_page_are_those_of_the_code(words: str, value: float):
    assert words.format(value) in FLAT


def test_counts_that_are_written_out():
    assert (margins.MIN_VISIBLE, behaviours.LEFT) == (4, 4)
    assert "At least four landmarks must stay in view" in FLAT
    assert "until four features are left" in FLAT
    assert localization_filter.ITERATIONS == 4
    assert "at most four times" in FLAT
    assert motion.WHEEL_FLOOR == 1e-5
    assert "(10⁻⁵ m)²" in PAGE


def shift(cell: str, angle: str) -> float:
    """What a cell of the table adds to its angle, as "β − π" adds -pi, rad."""
    match = re.fullmatch(rf"{angle}(?: ([−+]) (2?)π)?", cell)
    assert match is not None, cell
    sign, factor = match.groups()
    return {"−": -1.0, "+": 1.0, None: 0.0}[sign] * (2.0 if factor else 1.0) * math.pi


def test_the_five_charts_of_the_page_are_those_of_the_laws():
    rows = re.findall(r"^\| (\d) \| (β[^|]*?) \| (φ[^|]*?) \|", PAGE, re.MULTILINE)
    assert [row[0] for row in rows] == ["1", "2", "3", "4", "5"]
    assert [shift(row[1], "β") for row in rows] == pytest.approx(BETA_SHIFT)
    assert [shift(row[2], "φ") for row in rows] == pytest.approx(PHI_SHIFT)


def test_the_derivatives_that_the_page_states_follow_from_its_control():
    """beta~' and V' as written, against (2) driven by (5) as the code has it."""
    random = np.random.default_rng(1)
    rho, phi = random.uniform(0.1, 3.0, 50)[:, None], random.uniform(0.0, 2 * math.pi, 50)
    beta, gain = random.uniform(-3.0, 3.0, 50), supervisor.LAMBDA
    u, omega = control(phi, beta, gain)
    u, sine = u[:, None], np.sin(beta)[:, None]
    phi_tilde, beta_tilde = charts(phi, beta)
    rho_rate, phi_rate, beta_rate = -rho * np.cos(beta)[:, None] * u, sine * u, sine * u - omega
    sinc = np.sin(2 * beta_tilde) / (2 * beta_tilde)
    np.testing.assert_allclose(beta_rate, -gain * beta_tilde - sinc * phi_tilde, atol=1e-12)
    falls = rho * rho_rate + phi_tilde * phi_rate + beta_tilde * beta_rate
    np.testing.assert_allclose(falls, -((rho * np.cos(beta_tilde)) ** 2) - gain * beta_tilde**2, atol=1e-12)


def test_files_and_functions_that_the_page_names_are_there():
    """A name without its folder is in the folder that the text before it, or its heading, names."""
    folders = [ROOT / folder for folder in ("", "agent/servo", "agent/ekf")]
    for name, function in re.findall(r"`([\w/]+\.py)(?:: (\w+))?`", PAGE):
        (path,) = [folder / name for folder in folders if (folder / name).exists()]
        assert not function or f"def {function}(" in path.read_text(encoding="utf-8"), f"{name}: {function}"
