"""The way of a robot in sight of a place whose landmarks have bearings and no depths.

Postures of the robot in the place's frame, and of each landmark the ray at the place and the inverse depth
along it, are what wheels and pixels so far make most likely: bundle adjustment over a few keyframes (Triggs
et al. 2000), landmarks eliminated by the Schur complement. Pixels leave the scale open; the wheels give it as
soon as the robot has moved. No filter is used: at the start nothing is known well enough to linearise once.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agent.homing.bundle import Bundle
from agent.homing.keyframes import Keyframes
from agent.homing.rays import Rays, rescaled
from agent.observation import Odometry, RobotDescription
from hybridmap.camera import Camera
from hybridmap.pose import Array, Pose2, PoseGaussian, wrap_angle

ENOUGH = 1e-3
"""nats; a round that gains no more is the last."""


@dataclass(frozen=True)
class TrailSettings:
    """How much of the way is kept, and what is believed beforehand.

    Attributes:
        pixel_sigma: standard deviation of a tracked pixel, px.
        node_sigma: of a pixel in the place's own view, px.
        huber: a pixel that misses by more sigma than this counts less.
        keyframes: postures that are kept.
        recent: of the last images are kept in any case: what they show is averaged.
        apart: m, an older one stays if it is this far from the one before it.
        apart_turn: rad, likewise.
        nearness: 1/m, standard deviation of an inverse depth before anything is seen: things are seldom
            nearer than its reciprocal.
        rounds: of Levenberg-Marquardt at most, a tick.
        first_rounds: likewise at the start.
    """

    pixel_sigma: float = 0.7
    node_sigma: float = 0.7
    huber: float = 3.0
    keyframes: int = 12
    recent: int = 4
    apart: float = 0.05
    apart_turn: float = 0.15
    nearness: float = 2.0
    rounds: int = 3
    first_rounds: int = 25


class Trail:
    """What is known of a robot's way toward a place.

    Attributes:
        cost: half the squared misses of everything, for comparing two beginnings of one way.
    """

    def __init__(
        self,
        description: RobotDescription,
        place: Camera,
        pixels_at_place: NDArray[np.floating],
        prior: PoseGaussian,
        settings: TrailSettings | None = None,
        start: Pose2 | None = None,
    ) -> None:
        """Begin.

        Args:
            description: of the robot that drives.
            place: camera of the place's view.
            pixels_at_place: (N, 2) px, where the landmarks are there.
            prior: place_from_robot at the first image, however uncertain.
            settings: see there.
            start: where to begin searching for the first posture; the prior's mean without.
        """
        self.settings = s = settings or TrailSettings()
        self._description, self._prior = description, prior
        camera = description.camera
        noise = s.pixel_sigma / np.array([camera.fx, camera.fy])
        self._bundle = Bundle(prior, noise, s.huber)
        self._rays = Rays.of(place, pixels_at_place, s.node_sigma, s.nearness, camera)
        self._frames = Keyframes.starting(start or prior.mean, len(pixels_at_place))
        self._step = PoseGaussian(Pose2(), np.zeros((3, 3)))
        self._covariance = prior.covariance
        self._known = np.zeros(len(pixels_at_place), np.bool_)
        self._misses = np.zeros(len(pixels_at_place))
        self.cost = 0.0

    @property
    def pose(self) -> PoseGaussian:
        """`place_from_robot` now."""
        last = Pose2.from_vector(self._frames.postures[-1])
        turn = np.eye(3)
        turn[:2, :2] = last.rotation.T
        return PoseGaussian(last, turn @ self._covariance @ turn.T) @ self._step

    @property
    def first(self) -> Pose2:
        """`place_from_robot` at the first image, as it is known now."""
        return Pose2.from_vector(self._frames.postures[0])

    @property
    def known(self) -> NDArray[np.bool_]:
        """(N,) which landmarks have been seen on the way."""
        return self._known

    @property
    def inverse_depths(self) -> tuple[Array, Array]:
        """(N,) 1/m along the place's optical axis, and their standard deviations; NaN if never seen."""
        values = np.where(self._known, self._rays.values[:, 2], np.nan)
        return values, np.where(self._known, self._rays.inverse_depth_sigmas, np.nan)

    def points(self, farthest: float = 50.0) -> Array:
        """(N, 3) m, landmarks in the place's robot frame; too far to tell stands at `farthest`, m."""
        return self._rays.points(self._known, farthest)

    def misses(self) -> Array:
        """(N,) how many sigma each landmark missed its place by in the last image; NaN if not in it."""
        return self._misses

    def move(self, odometry: Odometry) -> None:
        """Take one step of the wheels."""
        d = self._description
        way = d.wheel_noise * (abs(odometry.forward) + abs(odometry.turn) * d.axle)
        step = PoseGaussian.from_sigmas(odometry.motion(), way + 1e-4, way / d.axle + 1e-4)
        self._step = self._step @ step

    def see(self, ids: NDArray[np.int64], pixels: Array) -> None:
        """Take one image: where it shows landmarks.

        Args:
            ids: (K,) indices of landmarks.
            pixels: (K, 2) px in the ideal image.
        """
        s, camera = self.settings, self._description.camera
        slopes = np.full((len(self._known), 2), np.nan)
        slopes[ids] = (np.array([camera.cx, camera.cy]) - pixels) / np.array([camera.fx, camera.fy])
        first = not self._known.any()
        self._frames = self._frames.extended(
            self._step, slopes, (s.apart, s.apart_turn), s.keyframes, s.recent
        )
        self._step = PoseGaussian(Pose2(), np.zeros((3, 3)))
        new = np.isfinite(slopes[:, 0]) & ~self._known
        if new.any():
            self._known = self._known | new
            self._rays = self._rays.triangulated(self._frames)
        self._improve(s.first_rounds if first else s.rounds)

    def restarted(self, first: Pose2, rounds: int) -> Trail:
        """The same way with the same sightings, thought to have begun elsewhere: where does that lead?

        Args:
            first: place_from_robot at the first image, to search from.
            rounds: of Levenberg-Marquardt at most.
        """
        other = copy.copy(self)
        place_from_old = first @ Pose2.from_vector(self._frames.postures[0]).inverse()
        other._frames = self._frames.carried(place_from_old)
        other._rays = self._rays.triangulated(other._frames).triangulated(other._frames)
        other._improve(rounds)
        return other

    def forget(self, ids: NDArray[np.int64]) -> None:
        """Landmarks that turned out to be wrong: drop all that was seen of them."""
        self._frames = self._frames.without(ids)
        self._known = self._known.copy()
        self._known[ids] = False

    def _improve(self, rounds: int) -> None:
        """Levenberg-Marquardt from where the estimate stands."""
        bundle, damping = self._bundle, 1e-9
        frames, rays = rescaled(self._frames, self._rays, self._prior)
        if bundle.cost(frames, rays) > bundle.cost(self._frames, self._rays):
            frames, rays = self._frames, self._rays
        fit = bundle.linearised(frames, rays)
        for _ in range(rounds):
            by_posture, by_ray = fit.step(damping)
            there = frames.moved(by_posture)
            tried = rays.moved(by_ray, there)
            gain = fit.cost - bundle.cost(there, tried)
            if gain < 0.0:
                damping = max(20.0 * damping, 1e-7)
                continue
            frames, rays, damping = there, tried, 0.1 * damping
            fit = bundle.linearised(frames, rays)
            if gain < ENOUGH * (1.0 + ENOUGH * fit.cost):
                break
        self._covariance, sigmas = fit.covariances()
        postures = frames.postures.copy()
        postures[:, 2] = [wrap_angle(float(h)) for h in postures[:, 2]]
        self._frames = replace(frames, postures=postures)
        self._rays = replace(rays, inverse_depth_sigmas=sigmas)
        self._misses, self.cost = fit.last_misses, fit.cost
