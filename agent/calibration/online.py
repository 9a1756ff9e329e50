"""Calibration while mapping: image pairs of the tracks that are followed anyway, a solution now and then.

It costs about one reduction of a pair a tick while estimates change, and one Gauss-Newton step every few
seconds. No tick does two of these: a solution comes two ticks after the pair that it was due with. What the
drive shows and contradicts the geometry in use is said once, in one line, and used from the next node on.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.arrays import lengths, median
from mapweave.agent.calibration.correction import OdometryCorrection, corrected, frame_change, geometry_of
from mapweave.agent.calibration.counted_wheels import CountedWheels
from mapweave.agent.calibration.estimate import SIGNIFICANT, Estimate, Lengths
from mapweave.agent.calibration.estimator import Estimator
from mapweave.agent.calibration.floor_tiles import FloorTiles
from mapweave.agent.calibration.image_pairs import (
    FEWEST_PAIRS,
    LEAST_LEFT,
    LEAST_TRACKS,
    LONGEST_S,
    SHORTEST_S,
    sigma_of,
)
from mapweave.agent.calibration.learned import LearnedGeometry, intrinsics_of, joined
from mapweave.agent.calibration.pair_information import ImagePair
from mapweave.agent.calibration.parameter_sigmas import useful
from mapweave.agent.calibration.ranger_scale import RangerScale
from mapweave.agent.calibration.report import NAMES, Cause, causes, readable
from mapweave.agent.calibration.turn_correction import TurnCorrection
from mapweave.agent.drive_geometry import COUNT, DriveGeometry, Parameter
from mapweave.agent.observation import Observation, RobotDescription
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.vision.lens import Lens

P = Parameter
ENOUGH = 0.04
"""A pair ends when half of its tracks have moved this far, as a share of the image's width,"""
ENOUGH_HEIGHTS = 0.5
"""or the camera by so many of its heights: near floor leaves the view;"""
LEAST = 0.004
"""and says nothing if they have moved less than this."""
SOLVE_EVERY = 4
"""Pairs between two solutions."""
PARTS = 2
"""Ticks over which a solution is spread: the floor, the step."""
MOST_PAIRS = 150
KEPT_NEW = 40
"""Of these the newest stay; of the others those go that turn least."""
MARGIN_S = 2.0
"""Before and after a pair the wheels' readings are kept for so long, s: a delay asks for them."""
STEPS = 1
"""Gauss-Newton steps of a solution."""
SETTLED = 0.5
"""Two solutions in a row must agree to this share of a useful sigma."""
LASTING = 1.5
"""A parameter is wrong if all solutions say so while the pairs grow by this factor: what a few have in common
by chance, more do not bear out. Without, one of nine simulated robots got three false names within 23 s."""
SURE = 4.0
"""It is wrong also if one solution says so by so many sigmas,"""
MANY_PAIRS = 100
"""once so many pairs were taken: these have little in common by chance, and a drive may be too short for half
as many again. Both chosen; see docs/decisions/delay.md."""
WORTH = np.full(COUNT, 2.0)
"""A change is put to use if it is larger than so many useful sigmas, and sure enough to be named."""
WORTH[P.WHEEL_SCALE] = 1.0
"""Wheels that go less far than they report are corrected as soon as they are named: by the floor, the height
counts. Those that go further, as soon as it is sure that it is they, and not the height. Once corrected on
this drive, they follow the estimate whenever it is a sigma away, either way."""

NAMED_ONLY = [p for p in Parameter if p not in (P.FORWARD, P.HEADING, P.PITCH, P.DELAY)]
"""Named, but not used by themselves. The wheels' scales and drift are what all else is measured by; a camera
aside or rolled shows too weakly. Of these only the wheels' scale is used, where the floor shows it, and
proximity sensors, if there are any, bear it out. The floor shows it for the height that is declared."""


class OnlineCalibration:
    """Watches wheels and tracks, and keeps the geometry that a robot uses.

    Attributes:
        description: the robot as everything behind the lens shall know it now.
        lens: of its images now.
        causes: parameters that were found to be declared wrongly, in the order in which they were found.
        contradicted: what of an earlier drive was given up, a line each.
        pending: what the mapper shall change to with its next node, if anything: the robot, the lens,
            `old_from_new` of the robot's frame, and by what the wheels' way is longer.
    """

    def __init__(self, description: RobotDescription, learned: LearnedGeometry | None = None) -> None:
        """Begin with what is declared, or was learned on an earlier drive.

        Args:
            description: as the robot is declared.
            learned: of an earlier drive; left out if it does not fit the description.
        """
        self._declared = description
        declared = geometry_of(description)
        if learned is None or not learned.fits(description):
            learned = LearnedGeometry(declared, intrinsics_of(description), {})
        self._geometry = learned.over(declared)
        self.description, self.lens = corrected(description, self._geometry)
        self.causes: list[Cause] = []
        self.contradicted: list[str] = []
        self.pending: tuple[RobotDescription, Lens, Pose2, float] | None = None
        self._next = self._geometry
        self._correction = OdometryCorrection()
        self._plain = Lens(description.camera, description.distortion)
        self._estimator = Estimator(declared, sigma_of(description.camera))
        if learned.parameters:
            self._estimator.vector = self._geometry.vector
        # What is used instead of what is declared; its sigmas; what of it only an earlier drive has shown.
        self._used = np.array([p in learned.parameters for p in Parameter])
        self._sigmas = learned.sigmas
        self._earlier = self._used.copy()
        self._counted = CountedWheels()
        self._turn_correction = TurnCorrection()
        self._first_turned: float | None = None
        self._turns: list[float] = []
        self._source: object = None
        self._first_s = self._first_way = 0.0
        self._ids: NDArray[np.int64] = np.zeros(0, np.int64)
        self._begin: Array = np.zeros((0, 2))
        self._ranger_scale = RangerScale(description)
        self._tiles = FloorTiles(description.camera, self._plain)
        self._floor: NDArray[np.float32] = np.zeros((0, 0), np.float32)
        self._since_solution = 0
        self._parts_left = 0
        self._taken = 0
        self._named_since = np.full(COUNT, np.inf)
        self._changed_since = np.full(COUNT, np.inf)
        self._stale = 0
        self._last: Estimate | None = None
        self._settled = np.zeros(COUNT, np.bool_)

    @property
    def learned(self) -> LearnedGeometry | None:
        """What the next start shall know of this drive and those before it; None if that is nothing.

        Estimates of the last solution are better than those with which the robot has begun to correct itself.
        """
        vector, sigmas, used = self._next.vector, self._sigmas.copy(), self._used
        last = self._last
        if last is not None:
            agree = np.abs(last.vector - vector) < SIGNIFICANT * np.hypot(last.sigmas, sigmas)
            better = used & last.shown & self._settled & agree
            for p in (p for p in Parameter if better[p]):
                here = float(last.vector[p]), float(last.sigmas[p])
                earlier = float(vector[p]), float(sigmas[p])
                vector[p], sigmas[p] = joined(*earlier, *here, p) if self._earlier[p] else here
        return LearnedGeometry.of(self._declared, vector, sigmas, used) if used.any() else None

    @property
    def geometry(self) -> DriveGeometry:
        """The geometry in use."""
        return self._geometry

    @property
    def estimate(self) -> Estimate | None:
        """The last solution."""
        return self._last

    @property
    def lever_error(self) -> float:
        """How far the camera may stand from where it is assumed on the robot, m.

        By the last solution, root mean square: its distance, and how uncertain it is. Before images show
        anything, as far as the camera stands above the floor, and never further.
        """
        last, most = self._last, self._geometry.height
        if last is None:
            return most
        lever = [P.FORWARD, P.LEFT]
        squares = (last.vector - self._geometry.vector)[lever] ** 2 + np.diag(last.covariance)[lever]
        return min(math.sqrt(squares.sum()), most)

    def correct(self, observation: Observation) -> Observation:
        """Count what the wheels report, and correct it by the geometry in use. Once a tick, first of all."""
        wheels = observation.odometry
        stamp = 1e-9 * observation.stamp_ns
        if stamp <= self._counted.stamp:
            # A clock that stands or goes back: what was seen before cannot be tied to the wheels any more.
            self._forget()
        if self._counted.full:
            self._trim()
        self._counted.add(stamp, wheels)
        self._ranger_scale.step(wheels, observation.proximity)
        return self._correction.step(observation, self._geometry)

    def watch(
        self,
        image: NDArray[np.uint8],
        source: object,
        ids: NDArray[np.int64],
        raw: Array,
        turned: float | None = None,
    ) -> Sequence[Cause]:
        """Take the tracks of the last image; returns causes that are found now.

        Args:
            image: (H, W) grey, the last.
            source: whose tracks they are: ids of another source mean others.
            ids: (N,) of the tracks.
            raw: (N, 2) px in the real image.
            turned: by the filter that follows the tracks, since it began, rad; None if there is none.
        """
        now = self._counted.stamp
        found = self._solve()
        if source is not self._source or now - self._first_s > 3.0 * LONGEST_S:
            self._start(image, source, now, ids, raw, turned)
            return found
        if now - self._first_s < SHORTEST_S:
            return found
        mine, theirs = _common(self._ids, ids)
        moved = median(lengths(raw[theirs] - self._begin[mine])) if len(mine) else 0.0
        camera = self._declared.camera
        due = now - self._first_s >= LONGEST_S or moved > ENOUGH * camera.width
        way = abs(self._counted.way - self._first_way)
        leaving = len(mine) < LEAST_LEFT * len(self._ids) or way > ENOUGH_HEIGHTS * camera.mount_height
        if not (due or leaving):
            self._refresh()
            return found
        pair = None
        if len(mine) >= LEAST_TRACKS and moved > LEAST * camera.width:
            before, after = (
                (self._plain.undistort(px) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
                for px in (self._begin[mine], raw[theirs])
            )
            pair = ImagePair(self._first_s, now, before, after)
        floor, turned_before = self._floor, self._first_turned
        self._start(image, source, now, ids, raw, turned)
        if pair is not None:
            self._take(pair, floor)
            if turned_before is not None and turned is not None:
                newest = self._estimator.newest_turn(self._counted.track())
                self._turn_correction.add(newest, turned - turned_before)
        return found

    def take_turn(self) -> float:
        """How much further the robot has turned than the filter says, rad, since this was called last."""
        return self._turn_correction.take()

    def pause(self) -> None:
        """The tracks are not to be trusted now."""
        self._source = None

    def switched(self) -> None:
        """The mapper has changed to what was pending."""
        if self.pending is not None:
            self.description, self.lens, *_ = self.pending
            self._geometry, self.pending = self._next, None

    def _start(
        self,
        image: NDArray[np.uint8],
        source: object,
        now: float,
        ids: NDArray[np.int64],
        raw: Array,
        turned: float | None,
    ) -> None:
        self._first_turned = turned
        order = ids.argsort()
        self._source, self._first_s, self._ids, self._begin = source, now, ids[order], raw[order]
        self._first_way = self._counted.way
        self._floor = self._tiles.part(image)

    def _take(self, pair: ImagePair, floor: NDArray[np.float32]) -> None:
        estimator = self._estimator
        wheels = self._counted.track()
        estimator.add_with_floor(pair, wheels, self._tiles, floor, self._floor)
        turned = np.interp([pair.first_s, pair.last_s], wheels.stamps, wheels.turn)
        self._taken += 1
        self._turns.append(abs(float(turned[1] - turned[0])))
        if len(estimator.pairs) > MOST_PAIRS:
            old = int(np.argmin(self._turns[:-KEPT_NEW]))
            estimator.drop(old)
            del self._turns[old]
        self._since_solution += 1
        if len(estimator.pairs) >= FEWEST_PAIRS and self._since_solution >= SOLVE_EVERY:
            self._since_solution, self._parts_left = 0, PARTS

    def _solve(self) -> Sequence[Cause]:
        """Do the next part of a solution that is due; causes that it finds."""
        if not self._parts_left:
            return ()
        self._parts_left -= 1
        if self._parts_left:
            self._estimator.find_floor()
            self._estimator.ranged = self._ranger_scale.scale()
            return ()
        estimate = self._estimator.solve(self._counted.track(), STEPS)
        before, self._last = self._last, estimate
        if before is None:
            return ()
        settled = np.abs(estimate.vector - before.vector) < np.maximum(
            SETTLED * useful(estimate.declared), estimate.sigmas
        )
        self._settled = settled
        self._adopt(estimate, settled & before.shown)
        known = {cause.parameter for cause in self.causes}
        wrong = {cause.parameter: cause for cause in causes(estimate) if settled[cause.parameter]}
        lasting = self._lasting(np.array([p in wrong for p in Parameter]), self._named_since)
        surely = SURE if self._taken >= MANY_PAIRS else math.inf
        found = [
            cause for p, cause in wrong.items() if (lasting[p] or cause.sigmas > surely) and p not in known
        ]
        self.causes += found
        return found

    def _lasting(self, wrong: NDArray[np.bool_], since: Array) -> NDArray[np.bool_]:
        """(10,) which were wrong while the pairs grew; (10,) since how many they are is kept up to date."""
        since[~wrong] = np.inf
        since[wrong] = np.minimum(since[wrong], self._taken)
        return np.asarray(self._taken >= LASTING * since)

    def _adopt(self, estimate: Estimate, settled: NDArray[np.bool_]) -> None:
        """Use what the drive shows where it differs enough from what is used."""
        target = self._next.vector
        off, sigmas = estimate.against(target)
        w = P.WHEEL_SCALE
        away = off[w] > sigmas[w]
        if estimate.vector[w] > target[w]:
            # What stands on the floor and is taken for it makes the way seem longer, never shorter.
            sigmas[w] = estimate.sigmas[w]
        change = (
            estimate.shown
            & settled
            & (off > WORTH * useful(estimate.declared))
            & (off > SIGNIFICANT * np.hypot(sigmas, np.where(self._earlier, self._sigmas, 0.0)))
        )
        by_floor = estimate.lengths in (Lengths.FLOOR, Lengths.BOTH)
        named_only = [p for p in NAMED_ONLY if not (p is P.WHEEL_SCALE and by_floor)]
        change[named_only] = False
        change &= self._lasting(change, self._changed_since)
        if by_floor and self._used[w] and not self._earlier[w]:
            # What was declared is contradicted already, and few pairs are far off: more know better.
            change[w] = estimate.shown[w] and settled[w] and away
        if not change.any():
            return
        # What is shown but differs less goes along: the estimates belong together. The wheels' scale brings
        # nothing along and does not go along: only lengths tell of it.
        belongs = change.any(where=np.arange(COUNT) != P.WHEEL_SCALE)
        along = belongs & estimate.shown & settled & (off > sigmas)
        along[[*named_only, P.WHEEL_SCALE]] = False
        self._next = DriveGeometry.of(np.where(change | along, estimate.vector, target))
        self._note(change | along, change, target, estimate)
        scale = self._next.wheel_scale / self._geometry.wheel_scale
        self.pending = (
            *corrected(self._declared, self._next),
            frame_change(self._geometry, self._next),
            scale,
        )

    def _note(self, taken: NDArray[np.bool_], wrong: NDArray[np.bool_], before: Array, now: Estimate) -> None:
        """Note what is used from now on of a solution.

        Args:
            taken: (10,) from it.
            wrong: (10,) because what was used before is contradicted.
            before: (10,) what was used.
            now: the solution.
        """
        given_up = wrong & self._earlier
        was, value = readable(before), readable(now.vector)
        self.contradicted += [
            f"{NAMES[p]} {was[p]:z.2f}, learned earlier, is contradicted by images and wheels: "
            f"now {value[p]:z.2f}"
            for p in Parameter
            if given_up[p]
        ]
        self._used, self._sigmas = self._used | taken, np.where(taken, now.sigmas, self._sigmas)
        self._earlier &= ~taken

    def _refresh(self) -> None:
        """Reduce one pair again, each in its turn, between the images that make new ones."""
        estimator = self._estimator
        if self._last is not None and len(estimator.pairs) > 1:
            self._stale = (self._stale + 1) % len(estimator.pairs)
            if estimator.stale(self._stale):
                estimator.refresh(self._stale, self._counted.track())

    def _trim(self) -> None:
        """Forget what the wheels counted between the pairs."""
        now, pairs = self._counted.stamp, self._estimator.pairs
        begins = [*(pair.first_s for pair in pairs), max(self._first_s, now - 3.0 * LONGEST_S)]
        ends = [*(pair.last_s for pair in pairs), now]
        self._counted.forget_between(np.array(begins) - MARGIN_S, np.array(ends) + MARGIN_S)

    def _forget(self) -> None:
        self._counted, self._turns = CountedWheels(), []
        vector = self._estimator.vector
        self._estimator = Estimator(geometry_of(self._declared), sigma_of(self._declared.camera))
        self._estimator.vector = vector
        self._source, self._last, self._settled = None, None, np.zeros(COUNT, np.bool_)
        self._since_solution = self._parts_left = self._taken = 0
        self._named_since[:] = self._changed_since[:] = np.inf


def _common(ordered: NDArray[np.int64], ids: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """(K,) places of the same ids in (N,) ascending ones and in (M,) others; in each there is an id once."""
    if not len(ids):
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    order = ids.argsort()
    places = order.take(ids.take(order).searchsorted(ordered), mode="clip")
    mine = np.flatnonzero(ids.take(places) == ordered)
    return mine, places.take(mine)
