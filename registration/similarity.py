"""The similarity transform between pairs of points in the plane, by generalised least squares.

The start is Umeyama's closed form (IEEE PAMI 13(4), 1991), which in the plane is one complex division. From
there Gauss-Newton steps minimise r' C^-1 r with the joint covariance C of all points. Errors that move all
points as one do no harm: they are in the span of the transform's own parameters.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array, Pose2, wrap_angle

LEAST = 3
"""Pairs: two determine a similarity, and leave nothing to check it by."""
MOST_TURN = math.radians(3.0)
"""Pairs that know the rotation no better are too near to each other, rad: 10 m away that is half a metre."""
CLEARLY = 13.8
"""By how much the chi-squares of the plan as it is and of its mirror image have to differ: odds of 1000, as
2 ln 1000."""
STEPS = 50
"""Gauss-Newton steps at most; from the closed form it takes three or four."""
WRONG = 0.01
"""A pair is called wrong where chance alone would single out one of the pairs as clearly this often."""
STRETCHED = 3.0
"""Sigmas between the scale that is given and the scale of the pairs, from which on one of them is wrong."""


@dataclass(frozen=True, slots=True)
class Similarity:
    """Coordinates of frame b in frame a: `a = scale R(heading) b + (x, y)`. Name it `a_from_b`.

    Attributes:
        x: of b's origin, in units of a.
        y: of b's origin, in units of a.
        heading: rad, counter-clockwise from a's x axis to b's.
        scale: units of a in a unit of b.
    """

    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0
    scale: float = 1.0

    def apply(self, points: NDArray[Any]) -> Array:
        """Map (..., 2) points of b into a."""
        return Pose2(self.x, self.y, self.heading).apply(self.scale * np.asarray(points, np.float64))


@dataclass(frozen=True, eq=False)
class SimilarityFit:
    """A least-squares solution.

    Attributes:
        a_from_b: the transform.
        covariance: (4, 4) of x, y, heading, ln scale; zeros for a scale that was given. If the residuals are
            larger than the points' covariance explains, it is larger by their ratio (Birge's).
        residuals: (K, 2) of each pair, in a.
        chi2: of the residuals with the points' covariance.
        freedom: degrees of freedom of that.
    """

    a_from_b: Similarity
    covariance: Array
    residuals: Array
    chi2: float
    freedom: int

    @property
    def excess(self) -> float:
        """How many times the variances would have to be larger to explain the residuals; 1 at least."""
        return max(1.0, self.chi2 / self.freedom) if self.freedom else 1.0

    @property
    def rms(self) -> float:
        """Root mean square of the residuals' lengths, in units of a."""
        return math.sqrt(float((self.residuals**2).sum(axis=1).mean()))

    @property
    def sigmas(self) -> Array:
        """(4,) of x, y, heading, ln scale."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


@dataclass(frozen=True, slots=True)
class LeftOut:
    """What the other pairs say of one.

    Attributes:
        off: distance of its point from where the others put it, in a.
        chance: how likely it is to be as far off if it is right.
    """

    off: float
    chance: float


def fit_similarity(a: Array, b: Array, covariance: Array, scale: float | None = None) -> SimilarityFit:
    """Fit `a_from_b`.

    Args:
        a: (K, 2) points, with errors.
        b: (K, 2) the same points, exact.
        covariance: (2K, 2K) joint covariance of the points in a, positive definite.
        scale: units of a in a unit of b; None: it is fitted, too.

    Raises:
        InvalidValue: the points are in one place.
    """
    count, free = len(a), scale is None
    weight = np.linalg.inv(0.5 * (covariance + covariance.T))
    middle = b.mean(axis=0)
    start = _closed_form(a, b - middle, np.diag(covariance).reshape(-1, 2).mean(axis=1), scale)
    p = np.array([start.x, start.y, start.heading, math.log(start.scale)])
    used = 4 if free else 3
    for _ in range(STEPS):
        moved, jacobian = _linearised(p, b - middle)
        normal = jacobian[:, :used].T @ weight @ jacobian[:, :used]
        step = np.linalg.solve(normal, jacobian[:, :used].T @ weight @ (a - moved).ravel())
        p[:used] += step
        if np.abs(step).max() < 1e-12 * max(1.0, float(np.abs(p).max())):
            break
    moved, jacobian = _linearised(p, b - middle)
    jacobian = jacobian[:, :used]
    residuals = a - moved
    chi2 = float(residuals.ravel() @ weight @ residuals.ravel())
    of_middle = np.zeros((4, 4))
    of_middle[:used, :used] = np.linalg.inv(jacobian.T @ weight @ jacobian)
    # The transform is that of b's origin, not of the middle of the points.
    shift, own = _linearised(p, -middle[None])
    turn = np.eye(4)
    turn[:2] = own
    spread = max(1.0, chi2 / (2 * count - used)) if 2 * count > used else 1.0
    transform = Similarity(
        float(shift[0, 0]), float(shift[0, 1]), wrap_angle(float(p[2])), scale or math.exp(p[3])
    )
    return SimilarityFit(transform, spread * turn @ of_middle @ turn.T, residuals, chi2, 2 * count - used)


def leave_one_out(a: Array, b: Array, covariance: Array, scale: float | None = None) -> tuple[LeftOut, ...]:
    """Fit without each pair in turn, and say how well it fits the others.

    By leaving out a pair that is right, chi-square falls by what two degrees of freedom have; if the other
    pairs' residuals are larger than their covariance explains, it is measured by them (an F test, of which
    the tail for two degrees of freedom is a power).

    Returns:
        One for each pair. Where the others leave no degree of freedom, each has a chance of 1:
        which is wrong cannot be known.
    """
    whole = fit_similarity(a, b, covariance, scale)
    out = []
    for k in range(len(a)):
        others = np.delete(np.arange(len(a)), k)
        rows = (2 * others[:, None] + np.arange(2)).ravel()
        rest = fit_similarity(a[others], b[others], covariance[np.ix_(rows, rows)], scale)
        off = float(np.linalg.norm(a[k] - rest.a_from_b.apply(b[k])))
        fall = max(0.0, whole.chi2 - rest.chi2)
        if rest.freedom == 0:
            chance = 1.0
        elif rest.excess > 1.0:
            chance = (1.0 + fall / rest.chi2) ** (-0.5 * rest.freedom)
        else:
            chance = math.exp(-0.5 * fall)
        out.append(LeftOut(off, chance))
    return tuple(out)


def wrong_pair(left_out: Iterable[LeftOut]) -> int | None:
    """The pair that is most probably wrong; None if none is clearly."""
    every = list(left_out)
    worst = min(range(len(every)), key=lambda k: every[k].chance)
    return worst if every[worst].chance * len(every) < WRONG else None


def scale_contradiction(a: Array, b: Array, covariance: Array, scale: float) -> tuple[float, float]:
    """The scale of the pairs, and by how many sigmas a given one is off."""
    free = fit_similarity(a, b, covariance)
    return free.a_from_b.scale, abs(math.log(free.a_from_b.scale / scale)) / float(free.sigmas[3])


def check_pairs(a: Array, b: Array, covariance: Array, scale: float | None = None) -> None:
    """Refuse pairs that do not determine a transform.

    Raises:
        InvalidValue: they are too few, too near to each other, in a line, or contradict each other or the
            given scale; or a mirror image fits better.
    """
    if len(a) < LEAST:
        raise InvalidValue(f"{len(a)} pairs are too few: click {LEAST} or more")
    proper = fit_similarity(a, b, covariance, scale)
    # Of a mirror image y points the other way.
    mirrored = fit_similarity(a, b * (1.0, -1.0), covariance, scale)
    lead = (mirrored.chi2 - proper.chi2) / min(proper.excess, mirrored.excess)
    if lead < -CLEARLY:
        raise InvalidValue(
            f"a mirror image of the plan fits better (residuals {mirrored.rms:.2f} m, as it is "
            f"{proper.rms:.2f} m): mirror the image, or look whether two pairs are exchanged"
        )
    if proper.sigmas[2] / math.sqrt(proper.excess) > MOST_TURN:
        spread = math.sqrt(float(((a - a.mean(axis=0)) ** 2).sum(axis=1).mean()))
        raise InvalidValue(
            f"the pairs are too near to each other: they lie within {spread:.2f} m, which leaves the plan's "
            f"rotation uncertain by {math.degrees(proper.sigmas[2]):.1f} deg; click some further apart"
        )
    if scale is not None and _unlikely(proper):
        free = fit_similarity(a, b, covariance)
        # One wrong pair among others that fit the given scale pulls a free scale towards itself.
        named = lead >= CLEARLY and wrong_pair(leave_one_out(a, b, covariance, scale)) is not None
        if not _unlikely(free) and not named:
            fourth = "; if it is right, one pair is wrong: click a fourth" if len(a) == LEAST else ""
            raise InvalidValue(
                f"the given scale of {scale:g} m/px does not fit: the pairs agree on "
                f"{free.a_from_b.scale:.4g} m/px, and with the given one the residuals are "
                f"{proper.rms:.2f} m; correct it, or leave it out{fourth}"
            )
    if lead < CLEARLY and _unlikely(proper):
        raise InvalidValue(
            f"the pairs contradict each other: residuals of {proper.rms:.2f} m; one is wrong, click more "
            "pairs to learn which"
        )
    if lead < CLEARLY:
        raise InvalidValue(
            "the pairs lie in a line, so a plan and its mirror image fit alike: click one beside the line"
        )


def _unlikely(fit: SimilarityFit) -> bool:
    """Whether the residuals are far larger than the points' covariance explains."""
    return fit.chi2 > CLEARLY * max(fit.freedom, 1)


def _closed_form(a: Array, b: Array, variances: Array, scale: float | None) -> Similarity:
    """Weighted by the mean variance of each point; b has its mean at the origin."""
    weights = 1.0 / variances
    weights /= weights.sum()
    a_middle, b_middle = weights @ a, weights @ b
    p = (a - a_middle) @ (1.0, 1.0j)
    q = (b - b_middle) @ (1.0, 1.0j)
    product, size = complex(weights @ (p * q.conj())), float(weights @ np.abs(q) ** 2)
    if not size > 0.0 or not abs(product) > 0.0:
        raise InvalidValue("all pairs are in one place: click some that are further apart")
    fitted = abs(product) / size if scale is None else scale
    turned = Similarity(0.0, 0.0, math.atan2(product.imag, product.real), fitted)
    x, y = a_middle - turned.apply(b_middle)
    return Similarity(float(x), float(y), turned.heading, fitted)


def _linearised(p: Array, b: Array) -> tuple[Array, Array]:
    """(K, 2) points of b in a, and (2K, 4) their derivatives by x, y, heading, ln scale."""
    arm = Similarity(0.0, 0.0, float(p[2]), math.exp(p[3])).apply(b)
    jacobian = np.zeros((len(b), 2, 4))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
    jacobian[:, :, 2] = np.stack([-arm[:, 1], arm[:, 0]], axis=1)
    jacobian[:, :, 3] = arm
    return arm + p[:2], jacobian.reshape(-1, 4)
