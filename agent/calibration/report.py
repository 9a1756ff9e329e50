"""Estimates in words: a table, and which parameter is likely to be declared wrongly."""

import math
from dataclasses import dataclass

from mapweave.agent.calibration.estimate import SIGNIFICANT, Estimate, Lengths
from mapweave.agent.calibration.parameter_sigmas import useful
from mapweave.agent.drive_geometry import Parameter
from mapweave.hybridmap.pose import Array

P = Parameter
NAMES = {
    P.WHEEL_SCALE: "wheel scale", P.TURN_SCALE: "turn scale", P.DRIFT: "drift, deg/m",
    P.FORWARD: "camera forward, m", P.LEFT: "camera left, m", P.HEADING: "camera heading, deg",
    P.PITCH: "camera pitch, deg", P.ROLL: "camera roll, deg", P.HEIGHT: "camera height, m",
    P.DELAY: "delay, s",
}  # fmt: skip
LOGARITHMIC = (P.WHEEL_SCALE, P.TURN_SCALE, P.HEIGHT)
ANGLES = (P.DRIFT, P.HEADING, P.PITCH, P.ROLL)


@dataclass(frozen=True)
class Cause:
    """A parameter that is declared wrongly.

    Attributes:
        parameter: which.
        declared: value in people's units.
        estimated: likewise.
        sigma: of the estimate, likewise.
        sigmas: how many sigmas the two are apart (`Estimate.contradiction`).
        lengths: what shows the wheels' scale.
    """

    parameter: Parameter
    declared: float
    estimated: float
    sigma: float
    sigmas: float
    lengths: Lengths = Lengths.FLOOR

    def __str__(self) -> str:
        """One line."""
        d, e = self.declared, self.estimated
        times = e / d if self.parameter in LOGARITHMIC else 1.0
        # What makes the floor pass faster than the wheels turn is a longer way, or a camera nearer to it.
        share = 100.0 * abs(1.0 / times - 1.0)
        height = f"{share:.1f} % {'lower' if times > 1.0 else 'higher'} than declared: measure it"
        seen, instead = {
            Lengths.RANGERS: ("what is ahead comes nearer", " (or its sensors read wrong by as much)"),
            Lengths.BOTH: ("the floor moves, and what is ahead comes nearer,", ""),
        }.get(self.lengths, ("the floor moves", f" (or the camera were {height})"))
        texts = {
            P.WHEEL_SCALE: f"{seen} as if the wheels went {times:.3f} times as far as they report{instead}",
            P.TURN_SCALE: f"in turns the image turns {times:.3f} times as far as the wheels report: axle or "
            "wheel sizes",
            P.DRIFT: f"driving ahead, the image turns by {e - d:+.2f} deg/m that the wheels do not report: "
            "one wheel is larger",
            P.FORWARD: f"in turns the image moves as if the camera were {e:z.2f} m ahead of the axle; "
            f"declared {d:z.2f}",
            P.LEFT: f"in turns the image moves as if the camera were {e:z.2f} m left of the axle's middle; "
            f"declared {d:z.2f}",
            P.HEADING: f"driving ahead, the image moves as if the camera looked {e:z.1f} deg to the left; "
            f"declared {d:z.1f}",
            P.PITCH: f"driving ahead, the image moves as if the camera looked {e:z.1f} deg down; "
            f"declared {d:z.1f}",
            P.ROLL: f"in turns the image moves as if the camera were rolled by {e:z.1f} deg; "
            f"declared {d:z.1f}",
            P.HEIGHT: f"the floor moves as if the camera were {e:.2f} m high; declared {d:.2f}",
            P.DELAY: f"where turns begin and end the wheels are {1e3 * (e - d):+.0f} ms late to the images",
        }
        return f"{texts[self.parameter]}; run `mapweave calibrate drive`"


def readable(vector: Array) -> Array:
    """(10,) parameters in people's units: shares, m, degrees, s."""
    values = vector.copy()
    for p in LOGARITHMIC:
        values[p] = math.exp(vector[p])
    for p in ANGLES:
        values[p] = math.degrees(vector[p])
    return values


def readable_sigmas(estimate: Estimate) -> Array:
    """(10,) sigmas in people's units."""
    sigmas = estimate.sigmas.copy()
    for p in LOGARITHMIC:
        sigmas[p] *= math.exp(estimate.vector[p])
    for p in ANGLES:
        sigmas[p] = math.degrees(sigmas[p])
    return sigmas


def causes(estimate: Estimate) -> list[Cause]:
    """Which parameters that the drive shows are declared wrongly, the surest first."""
    off, sigmas = estimate.contradiction
    wrong = estimate.shown & (off > SIGNIFICANT * sigmas) & (off > useful(estimate.declared))
    value, was, sigma = readable(estimate.vector), readable(estimate.declared), readable_sigmas(estimate)
    lengths = estimate.lengths
    found = [
        Cause(p, float(was[p]), float(value[p]), float(sigma[p]), float(off[p] / sigmas[p]), lengths)
        for p in P
        if wrong[p]
    ]
    return sorted(found, key=lambda cause: -cause.sigmas)
