"""Settings of the two filters: noise, gates and health."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FilterSettings:
    """How the mapping filter believes, gates and stops.

    Attributes:
        pixel_sigma: standard deviation of a tracked pixel, px.
        adaptation: how much of an image's noise beyond what is said is taken over at once, 0 ... 1: a floor
            that is not flat, shaking and blur make all pixels worse than any tracker knows.
        wheel_floor: standard deviation of a wheel's way in a step without any, m.
        side_slip: standard deviation of the slip aside of a step, as a share of the wheels' way.
        pose_noise: process noise of each step on (x m, y m, heading rad), standard deviations.
        slip_sigmas: wheels that an image refutes by more than this have slipped.
        slip: sigma of (forward m, turn rad) of a step whose wheels the landmarks refute.
        distrust: for so many steps after that, wheels that claim to stand are not believed.
        prior_depth: depth at which a landmark is expected when nothing is known, m.
        prior_spread: sigma of the prior inverse depth, in units of 1 / prior_depth. 1.2 reaches from
            0.3 prior_depth (two sigma) to infinity (one sigma).
        relinearisations: how often at most a step is linearised again in the light of its image.
        gate_probability: share of true measurements that each gate lets pass.
        least_agreeing: fewer accepted landmarks than this are no healthy update.
        least_agreeing_share: nor is a smaller share of those seen.
        patience: so many steps without an image are told.
        parallax_px: depths cannot be told before landmarks have moved by this much in the image, px.
        converged_sigma: depth sigma under which a landmark has converged, m.
        converged_share: the same as a share of the depth; the larger of the two counts.
        widest_slope: landmarks further aside than this |a| have left the view for good and are let go.
        nearest: landmarks nearer than this to the optical centre are let go, m.
    """

    pixel_sigma: float = 0.7
    adaptation: float = 0.1
    wheel_floor: float = 1e-5
    side_slip: float = 0.0
    pose_noise: tuple[float, float, float] = (0.0, 0.0, 0.0)
    slip_sigmas: float = 4.5
    slip: tuple[float, float] = (0.1, 0.2)
    distrust: int = 10
    prior_depth: float = 2.5
    prior_spread: float = 1.2
    relinearisations: int = 3
    gate_probability: float = 0.999
    least_agreeing: int = 3
    least_agreeing_share: float = 0.4
    patience: int = 2
    parallax_px: float = 5.0
    converged_sigma: float = 0.05
    converged_share: float = 0.05
    widest_slope: float = 4.0
    nearest: float = 0.05


@dataclass(frozen=True, slots=True)
class LocalizationSettings:
    """How the localization filter believes, gates and judges itself.

    Attributes:
        wheel_floor: standard deviation of a wheel's way in a step without any, m.
        side_slip: standard deviation of the slip aside of a step, as a share of the wheels' way.
    """

    wheel_floor: float = 1e-5
    side_slip: float = 0.0
