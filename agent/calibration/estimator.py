"""Least squares for the geometry of a drive over reduced image pairs.

A pair says how the camera has moved (`pair_information.py`), the wheels and the parameters how it should have
(`drive_geometry.py`). What is left between them is slip of the wheels, which every pair has of its own; its
size is estimated along with the parameters (expectation maximisation), so that neither a drive on ice nor one
on rails gets a false sigma. Gauss-Newton with pairs weighted by Student's t; the covariance is the larger of
the model's and of what blocks of pairs scatter (sandwich), because slip has a memory that the model has not.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.calibration.camera_motions import (
    CameraMotions,
    WheelTrack,
    counted,
    motions_over,
    predict,
    robot_from_camera,
    slip_steps,
)
from mapweave.agent.calibration.estimate import SIGNIFICANT, Estimate, Lengths
from mapweave.agent.calibration.floor_path import DrivenStep, follow, heights_over
from mapweave.agent.calibration.floor_scale import floor_scale
from mapweave.agent.calibration.floor_tiles import FloorTiles
from mapweave.agent.calibration.pair_information import (
    FARTHEST_FLOOR,
    ImagePair,
    PairInformation,
    reduce_pair,
    with_floor,
)
from mapweave.agent.calibration.parameter_sigmas import MODEL_SIGMAS, PRIOR_SIGMAS, useful
from mapweave.agent.calibration.ranger_scale import RangedScale
from mapweave.agent.calibration.turn_correction import PairTurn
from mapweave.agent.drive_geometry import COUNT, DriveGeometry, Parameter
from mapweave.hybridmap.pose import Array

P = Parameter
STALE = 0.25
"""A pair is reduced again when a parameter has moved by this share of a useful sigma since."""
STEP = np.array([1e-5, 1e-5, 1e-6, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5, 1e-5, 1e-4])
"""Of the numeric derivative."""
NOISE_STEPS = 4
"""Of expectation maximisation in each Gauss-Newton step."""
STALE_PITCH = 0.02
"""Pairs that were reduced with another pitch than the present, rad, tell nothing of the floor: its tiles were
looked for elsewhere."""
DELAY_SMOOTH_S = 0.5
"""Over which the wheels' speed is averaged where it serves as an instrument for the delay."""
STUDENT = 5.0
"""Degrees of freedom of the pairs' weights."""
BLOCK = 4
"""Pairs in a row whose errors may go together."""
TWO_SIGMA = 2.0
"""At which the sigmas of a short drive cover the errors."""
FIRST_NOISE = np.array([0.05**2, 0.03**2, 0.03**2, 0.01**2, 0.01**2, 0.02**2])
"""Variances before any is estimated, per metre or per pair: see `_noise_basis`."""
LEAST_SIGMA = 0.2
"""Least standard deviation of a track as a share of what is assumed beforehand: lenses are not quite as they
were calibrated. In simulation tracks scatter by a fifth of a pixel or less; taken for half a pixel, wheels
that slip count for more than what is seen."""
AGREEMENT = 2.5
"""Sigmas within which floor and proximity sensors must agree on the wheels' scale to bear each other out."""
ROUNDS = 3
"""Of a batch: reductions of all pairs."""
INNER = 6
"""Gauss-Newton steps between two reductions of the pairs."""


class Estimator:
    """Takes image pairs, one after the other or many, and estimates the geometry from all of them.

    Attributes:
        vector: (10,) parameters as they are estimated now.
        pairs: that are kept.
        informations: what they are reduced to.
        reduced_at: (10,) parameters at which each was reduced.
        floor_tracks: tracks that lie on the floor.
        ranged: the wheels' scale by proximity sensors; None if they do not show it.
    """

    def __init__(self, declared: DriveGeometry, sigma: float, keep_wheels: bool = False) -> None:
        """Begin with what is declared.

        Args:
            declared: the geometry.
            sigma: standard deviation of a track, in normalised coordinates.
            keep_wheels: hold the wheels' scale to a percent instead of the height.
        """
        self.declared = declared.vector
        self._stale = STALE * useful(self.declared)
        self.vector = self.declared.copy()
        prior = np.array([PRIOR_SIGMAS[p] for p in P])
        if keep_wheels:
            prior[[P.WHEEL_SCALE, P.HEIGHT]] = prior[[P.HEIGHT, P.WHEEL_SCALE]]
        self._prior = np.diag(1.0 / prior**2)
        self._sigma = self._most_sigma = sigma
        self._keep_wheels = keep_wheels
        self._noise: Array = FIRST_NOISE.copy()
        self._depth = (0.3, 0.5)
        self.reduced_at: list[Array] = []
        self._reduced_sigmas: list[float] = []
        self._ways: list[list[DrivenStep]] = []
        self._floor: tuple[float, float] | None = None
        self.floor_tracks = 0
        self.ranged: RangedScale | None = None
        self.pairs: list[ImagePair] = []
        self.informations: list[PairInformation] = []
        self._covariance = np.diag(prior**2)

    def add(self, pair: ImagePair, wheels: WheelTrack) -> PairInformation:
        """Reduce a pair at the present parameters and keep it."""
        self.pairs.append(pair)
        self.informations.append(self._reduced(pair, wheels))
        self.reduced_at.append(self.vector.copy())
        self._reduced_sigmas.append(self._sigma)
        follow(self._ways, pair.first_s, pair.last_s, self.informations[-1].at)
        return self.informations[-1]

    def add_with_floor(
        self,
        pair: ImagePair,
        wheels: WheelTrack,
        tiles: FloorTiles,
        before: NDArray[np.float32],
        after: NDArray[np.float32],
    ) -> None:
        """Reduce a pair and keep it, with the tiles of the floor that its two images show.

        Args:
            pair: its tracks.
            wheels: what they have counted, up to the second image at least.
            tiles: of the camera.
            before: part of the first image, as `FloorTiles.part`.
            after: part of the second.
        """
        information = self.add(pair, wheels)
        pair = self.pairs[-1] = replace(pair, floor=tiles.match(before, after, information.at))
        self.informations[-1] = with_floor(information, pair, self._most_sigma)

    def drop(self, index: int) -> None:
        """Forget a pair."""
        del self.pairs[index], self.informations[index], self.reduced_at[index], self._reduced_sigmas[index]
        del self._ways[index]

    def stale(self, index: int) -> bool:
        """Whether a pair was reduced with parameters, or a sigma of tracks, that differ from the present."""
        moved = np.abs(self.vector - self.reduced_at[index]) > self._stale
        return bool(moved.any()) or abs(math.log(self._sigma / self._reduced_sigmas[index])) > STALE

    def refresh(self, index: int, wheels: WheelTrack) -> None:
        """Reduce a pair again at the present parameters."""
        self.informations[index] = self._reduced(self.pairs[index], wheels)
        self._ways[index][0].at = self.informations[index].at
        self.reduced_at[index] = self.vector.copy()
        self._reduced_sigmas[index] = self._sigma

    def _reduced(self, pair: ImagePair, wheels: WheelTrack) -> PairInformation:
        first, last = np.array([pair.first_s]), np.array([pair.last_s])
        ways, turns = counted(self.vector, wheels, first, last)
        predicted = motions_over(self.vector, ways, turns)
        noise = self._noises(ways, turns)[0]
        return reduce_pair(pair, predicted[0], noise, self._sigma, self._depth, self._most_sigma)

    def newest_turn(self, wheels: WheelTrack) -> PairTurn:
        """How far the robot has turned over the newest pair."""
        pair, information = self.pairs[-1], self.informations[-1]
        ways, turns = counted(self.vector, wheels, np.array([pair.first_s]), np.array([pair.last_s]))
        by_wheels = motions_over(self.vector, ways, turns)
        off, a = by_wheels.since(information.at)[0], information.matrix
        covariance = np.asarray(np.linalg.inv(a + np.linalg.inv(self._noises(ways, turns)[0])), np.float64)
        slip = covariance @ (information.vector - a @ off)
        # The robot turns about the up of the camera, and what the camera sees turns the other way.
        down = by_wheels.floor[0] / np.linalg.norm(by_wheels.floor[0])
        turned = math.exp(self.vector[P.TURN_SCALE]) * float(turns.sum())
        turned += self.vector[P.DRIFT] * math.exp(self.vector[P.WHEEL_SCALE]) * float(ways.sum())
        return PairTurn(turned + float(down @ slip[3:]), float(down @ covariance[3:, 3:] @ down))

    def solve(self, wheels: WheelTrack, iterations: int = INNER, few_turns: bool = False) -> Estimate:
        """Estimate from the pairs as they are reduced now.

        Args:
            wheels: what they have counted.
            iterations: Gauss-Newton steps.
            few_turns: widen the sigma of the camera's forward offset where few blocks show it.
        """
        first = np.array([pair.first_s for pair in self.pairs])
        last = np.array([pair.last_s for pair in self.pairs])
        floor = np.zeros(COUNT)
        if self._floor is not None:
            floor[[P.WHEEL_SCALE, P.HEIGHT]] = 1.0, -1.0
        at = CameraMotions(
            *(np.stack([getattr(i.at, name) for i in self.informations])
              for name in ("rotation", "translation", "floor"))
        )  # fmt: skip
        a = np.stack([i.matrix for i in self.informations])
        b = np.stack([i.vector for i in self.informations])
        measured, spread = self._floor or (0.0, 1.0)
        fixed = np.outer(floor, floor) / spread**2
        lengths = self._lengths()
        shows = self.ranged is not None and lengths is not Lengths.CONTRADICT
        tight, ranged = (self.ranged.sigma**-2, self.ranged.log) if self.ranged and shows else (0.0, 0.0)
        fixed[P.WHEEL_SCALE, P.WHEEL_SCALE] += tight
        for _ in range(iterations):
            ways, turns = counted(self.vector, wheels, first, last)
            off = motions_over(self.vector, ways, turns).since(at)
            jacobian = self._jacobian(wheels, first, last, ways, turns, at, off)
            rest = b - _product(a, off)
            basis, growth = self._noise_basis(ways, turns)
            whitened = np.asarray(np.linalg.inv(basis), np.float64)
            transposed = np.swapaxes(whitened, 1, 2)
            for _ in range(NOISE_STEPS):
                variances = growth * self._noise
                inverse = (transposed / variances[:, None]) @ whitened
                posterior = np.asarray(np.linalg.inv(a + inverse), np.float64)
                slip = _product(posterior, rest)
                weight = _weights((_product(whitened, slip) ** 2 / variances).sum(1))
                self._learn_noise(whitened, growth, slip, posterior, weight)
            keep = np.eye(6) - a @ posterior
            scores = weight[:, None] * _product(np.swapaxes(jacobian, 1, 2), _product(keep, rest))
            # One product of (10, 6 N) and (6 N, 10): of four tensors at once it takes half of a solution.
            pulled = (weight[:, None, None] * (keep @ a @ jacobian)).reshape(-1, COUNT)
            hessian = jacobian.reshape(-1, COUNT).T @ pulled + self._prior + fixed
            gradient: Array = scores.sum(0) - self._prior @ (self.vector - self.declared)
            gradient = gradient + floor * (measured - floor @ self.vector) / spread**2
            gradient[P.WHEEL_SCALE] += tight * (ranged - self.vector[P.WHEEL_SCALE])
            self.vector = self.vector + np.linalg.solve(hessian, gradient)
        self._learn_scene()
        inverse_hessian = np.asarray(np.linalg.inv(hessian), np.float64)
        scatter = self._scatter(inverse_hessian, scores)
        if few_turns:
            growth = np.ones(COUNT)
            growth[P.FORWARD] = _few_pulls(_blocks(scores) @ inverse_hessian[:, P.FORWARD])
            scatter = scatter * np.outer(growth, growth)
        self._covariance = _wider(inverse_hessian, scatter)
        self._covariance = self._covariance + np.diag(MODEL_SIGMAS**2)
        return Estimate(
            self.vector.copy(),
            self._covariance,
            self.declared,
            len(self.pairs),
            self.floor_tracks,
            self._keep_wheels,
            lengths,
        )

    def batch(self, pairs: Sequence[ImagePair], wheels: WheelTrack) -> Estimate:
        """Estimate from many pairs at once, all reduced again in each round."""
        self.pairs, self.informations, self.reduced_at, self._floor = [], [], [], None
        self._reduced_sigmas, self._ways = [], []
        for pair in pairs:
            self.add(pair, wheels)
        estimate = self.solve(wheels)
        for _ in range(ROUNDS):
            for index in range(len(pairs)):
                self.refresh(index, wheels)
            self.find_floor()
            estimate = self.solve(wheels, few_turns=True)
        return estimate

    def find_floor(self) -> None:
        """Find the floor below the horizon: it ties the way's scale to the height.

        Nothing else is learnt from the floor: a pavement or a carpet must not bend the rest.
        """
        self._floor, self.floor_tracks = None, 0
        tilts = np.array([abs(self.vector[P.PITCH] - at[P.PITCH]) for at in self.reduced_at])
        kept = np.flatnonzero(tilts < STALE_PITCH)
        if not len(kept):
            return
        floors = [self.informations[k].floor for k in kept]
        points = [floor.points for floor in floors]
        down = -robot_from_camera(*self.vector[[P.HEADING, P.PITCH, P.ROLL]].tolist())[2]
        heights, off = heights_over(points, [self._ways[k] for k in kept], down)
        numbers = np.repeat(kept, [len(some) for some in points])
        # A way that was assumed shorter makes all of the scene smaller.
        height = math.exp(self.vector[P.HEIGHT])
        assumed = np.array([at[P.WHEEL_SCALE] for at in self.reduced_at])[numbers]
        logs = assumed - np.log(np.clip(heights / height, 1.0 / FARTHEST_FLOOR, FARTHEST_FLOOR))
        logs -= self.vector[P.WHEEL_SCALE]
        sigmas = np.concatenate([floor.sigmas for floor in floors])
        found = floor_scale(logs, sigmas, off / height, numbers, BLOCK)
        if found is None:
            return
        pitch = math.sqrt(self._covariance[P.PITCH, P.PITCH]) * found.flatness
        log = self.vector[P.WHEEL_SCALE] - self.vector[P.HEIGHT] + found.log
        self._floor = float(log), math.hypot(found.sigma, pitch)
        self.floor_tracks = found.tracks

    def _lengths(self) -> Lengths:
        """What besides the wheels shows how far the robot has gone."""
        if self.ranged is None:
            return Lengths.FLOOR
        if self._floor is None:
            return Lengths.RANGERS
        by_floor = self._floor[0] + self.declared[P.HEIGHT]
        sigma = math.hypot(self._floor[1], PRIOR_SIGMAS[P.HEIGHT], self.ranged.sigma)
        agree = abs(by_floor - self.ranged.log) < AGREEMENT * sigma
        return Lengths.BOTH if agree else Lengths.CONTRADICT

    def _jacobian(
        self,
        wheels: WheelTrack,
        first: Array,
        last: Array,
        ways: Array,
        turns: Array,
        at: CameraMotions,
        off: Array,
    ) -> Array:
        """(N, 6, 10) of the predicted motions with respect to the parameters, numeric."""
        columns = []
        for k in range(COUNT):
            moved = self.vector.copy()
            moved[k] += STEP[k]
            if k == P.WHEEL_SCALE:
                # The floor alone tells it: epipolar lines know no scale, and assumed depths must not.
                columns.append(0.0 * off)
                continue
            if k == P.DELAY:
                columns.append(self._delay_column(moved, wheels, first, last, at))
                continue
            columns.append((motions_over(moved, ways, turns).since(at) - off) / STEP[k])
        return np.stack(columns, axis=-1)

    def _delay_column(
        self, moved: Array, wheels: WheelTrack, first: Array, last: Array, at: CameraMotions
    ) -> Array:
        """(N, 6) of the predicted motions with respect to the delay.

        It is the change of speed from the first image to the last. That of turning is taken from the images
        instead of from the wheels: noise of single readings would pass for the motion that shows a delay,
        since what they add to the prediction they also add to its error.
        """
        smooth = wheels.smooth(DELAY_SMOOTH_S)
        here = predict(self.vector, smooth, first, last)
        column = (predict(moved, smooth, first, last).since(at) - here.since(at)) / STEP[P.DELAY]
        turning = slip_steps(self.vector)[:, 2]
        span = last - first
        still = CameraMotions(np.broadcast_to(np.eye(3), at.rotation.shape), 0.0 * at.floor, 0.0 * at.floor)
        up = -here.floor / np.linalg.norm(here.floor, axis=1, keepdims=True)
        seen = -(at.since(still)[:, 3:6] * up).sum(1) / span
        reckoned = -(here.since(still)[:, 3:6] * up).sum(1) / span
        middle, order = 0.5 * (first + last), np.argsort(first)
        apart = (seen - reckoned)[order]
        ends = (np.interp(t, middle[order], apart) for t in (first, last))
        begins, finishes = ends
        return np.asarray(column + turning * (finishes - begins)[:, None])

    def _noise_basis(self, ways: Array, turns: Array) -> tuple[Array, Array]:
        """Directions (N, 6, 6) in which a pair errs by itself, and how their variances grow (N, 6).

        Slip ahead, aside and in turning grow with the way; a vehicle pitches and rolls on its springs
        however far it goes.

        Args:
            ways: (N, SUBSTEPS) m, of the wheels.
            turns: (N, SUBSTEPS) rad.
        """
        n = len(ways)
        basis = np.zeros((n, 6, 6))
        basis[:, :, :3] = slip_steps(self.vector)
        basis[:, 3, 3] = basis[:, 5, 4] = basis[:, 1, 5] = 1.0
        moving = np.abs(ways).sum(1) + 0.3 * np.abs(turns).sum(1) + 0.01
        growth = np.ones((n, 6))
        growth[:, :3] = moving[:, None]
        growth[:, 5] = moving**2 + 1e-4
        return basis, growth

    def _noises(self, ways: Array, turns: Array) -> Array:
        """(N, 6, 6) covariances of what a pair errs by itself."""
        basis, growth = self._noise_basis(ways, turns)
        return (basis * (growth * self._noise)[:, None]) @ np.swapaxes(basis, 1, 2)

    def _learn_noise(
        self, whitened: Array, growth: Array, slip: Array, posterior: Array, weight: Array
    ) -> None:
        """One step of expectation maximisation for the variances of slip and springs."""
        own = _product(whitened, slip)
        spread = ((whitened @ posterior) * whitened).sum(2)
        share = (weight[:, None] * own**2 + spread) / growth
        learned = (share.sum(0) + 5.0 * FIRST_NOISE * 0.01) / (len(share) + 5.0)
        self._noise = np.clip(learned, 1e-4 * FIRST_NOISE, 4.0 * FIRST_NOISE)

    def _learn_scene(self) -> None:
        """How far things are, and how exactly they are followed."""
        depths = np.array([i.inverse_depths for i in self.informations if i.tracks > 5])
        if len(depths):
            mean, spread = np.median(depths, axis=0)
            spread = max(spread, 0.5 * mean)
            if spread > 0.0:
                # Where wheels and image go opposite ways, no point has a depth.
                self._depth = (float(mean), float(spread))
            scatter = float(np.median([i.scatter for i in self.informations if i.tracks > 5]))
            self._sigma = float(np.clip(scatter, LEAST_SIGMA * self._most_sigma, self._most_sigma))

    def _scatter(self, inverse_hessian: Array, scores: Array) -> Array:
        """(10, 10) covariance by how blocks of pairs pull apart.

        Neighbours count together (Newey and West 1987), since slip goes on from one block to the next.
        """
        blocks = _blocks(scores)
        cross = 0.5 * blocks[:-1].T @ blocks[1:]
        pulls = _few_blocks(len(blocks)) ** 2 * (blocks.T @ blocks + cross + cross.T)
        prior = inverse_hessian @ self._prior @ inverse_hessian
        return np.asarray(inverse_hessian @ pulls @ inverse_hessian + prior)


def _product(matrices: Array, vectors: Array) -> Array:
    """(N, I) products of (N, I, J) matrices with (N, J) vectors."""
    return np.asarray((matrices @ vectors[..., None])[..., 0])


def _blocks(scores: Array) -> Array:
    """(B, 10) scores of blocks of (N, 10) pairs."""
    return np.asarray(np.add.reduceat(scores, np.arange(0, len(scores), BLOCK)))


def _few_pulls(pulls: Array) -> float:
    """By how much wider a sigma is because few of the blocks pull at a parameter.

    A vehicle that slips aside in a curve looks like one with its camera elsewhere, and each curve has a slip
    of its own: of a drive of 20 s three or four blocks out of a dozen show the lever. Their number is
    Satterthwaite's (1946) for the sum of the squares, as for clusters in Bell and McCaffrey (2002).

    Args:
        pulls: (B,) of blocks at the parameter.
    """
    squares = pulls**2
    if not squares.any():
        return 1.0
    number = float(squares.sum() ** 2 / (squares**2).sum())
    return _few_blocks(number, TWO_SIGMA) / _few_blocks(len(pulls), TWO_SIGMA)


def _few_blocks(blocks: float, z: float = SIGNIFICANT) -> float:
    """Quantile of Student's t over the Gaussian one `z`: few blocks tell no sigma.

    Abramowitz and Stegun 26.7.5.
    """
    free = max(blocks - 1.0, 1.0)
    return 1.0 + (z**2 + 1.0) / (4.0 * free) + (5.0 * z**4 + 16.0 * z**2 + 3.0) / (96.0 * free**2)


def _weights(cost: Array) -> Array:
    """(N,) of pairs by what their slip costs: what others do not bear out counts less.

    What even slip does not explain is what tracks refuse, and these have weights of their own.
    """
    return np.asarray((STUDENT + 6.0) / (STUDENT + np.maximum(cost, 0.0) + 4.0))


def _wider(one: Array, other: Array) -> Array:
    """The first covariance with each sigma at least that of the second; its correlations stay."""
    ratio = np.sqrt(np.maximum(np.diag(other) / np.diag(one), 1.0))
    return np.asarray(one * np.outer(ratio, ratio))
