"""Floor plans under a merged map: the transform of each, what its pairs say of each other, and doubts."""

import math
from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np

from mapweave.hybridmap.annotation import Annotations
from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.floor_plan import (
    MAX_PARTS,
    FittedPair,
    FloorPlan,
    PlacedPlan,
    PlacedPlans,
    PlanPair,
    PlanPart,
)
from mapweave.hybridmap.limits import MAX_WORDS
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.registration.similarity import (
    LEAST,
    STRETCHED,
    LeftOut,
    SimilarityFit,
    check_pairs,
    fit_similarity,
    leave_one_out,
    scale_contradiction,
    wrong_pair,
)
from mapweave.wire.messages import encode

CLICK = 0.1
"""How precisely a person clicks a place that is known in the map, m: an arm's breadth. Where the residuals
are larger, the covariance is (mapweave.registration.similarity)."""


def placed_plan(name: str, plan: FloorPlan, merged: MergedMap) -> PlacedPlan:
    """Lay a plan under each component that has enough of its pairs."""
    by_component: dict[int, list[int]] = {}
    missing = []
    for k, pair in enumerate(plan.pairs):
        number = merged.component_of(pair.node)
        if number is None:
            missing.append(k)
        else:
            by_component.setdefault(number, []).append(k)
    parts, reasons = [], []
    for number, members in sorted(by_component.items(), key=lambda item: (-len(item[1]), item[0])):
        if len(members) < LEAST:
            reasons.append(f"component {number} has {counted(len(members), 'pair')}, and {LEAST} are needed")
            continue
        try:
            part = _part(plan, merged, number, members)
            # One that no message holds would cost people the answer about all plans.
            encode(PlacedPlans((PlacedPlan(name, plan, (part,)),)))
            parts.append(part)
        except InvalidValue as error:
            reasons.append(f"component {number}: {error}")
    nodes = Counter(str(plan.pairs[k].node) for k in missing)
    if missing:
        reasons.append(
            f"{counted(len(missing), 'pair')} of nodes that are not in the merged map: {', '.join(nodes)}"
        )
    return PlacedPlan(name, plan, tuple(parts[:MAX_PARTS]), "; ".join(reasons)[:MAX_WORDS])


def placed_plans(annotations: Annotations, merged: MergedMap) -> PlacedPlans:
    """All plans that are in force, by name."""
    return PlacedPlans(
        tuple(placed_plan(entry.name, plan, merged) for entry, plan in annotations.in_force(FloorPlan))
    )


def check_plan(plan: FloorPlan, merged: MergedMap) -> PlacedPlan:
    """Refuse a plan that lies under no component, and a pixel that its image does not have.

    Raises:
        InvalidValue: with the reason.
    """
    width, height = plan.image.width, plan.image.height
    for k, pair in enumerate(plan.pairs, 1):
        if not (0.0 <= pair.u <= width and 0.0 <= pair.v <= height):
            raise InvalidValue(
                f"pair {k} ({pair.node}): pixel {pair.u:g},{pair.v:g} is outside of the image, which is "
                f"{width} x {height} px"
            )
    placed = placed_plan("plan", plan, merged)
    if not placed.parts:
        raise InvalidValue(placed.reason)
    return placed


def points_in_merged(pairs: Sequence[PlanPair], merged: MergedMap, component: int) -> tuple[Array, Array]:
    """Where the places of some pairs of one component are.

    Returns:
        (K, 2) m, in the component's frame, and the (2K, 2K) joint covariance of clicks and the map's shape.
    """
    graph = merged.graphs[component]
    nodes = [pair.node for pair in pairs]
    points, jacobian = np.zeros((len(pairs), 2)), np.zeros((2 * len(pairs), 3 * len(pairs)))
    for k, pair in enumerate(pairs):
        pose = graph.pose(pair.node)
        points[k] = pose.apply(np.array([pair.x, pair.y]))
        # The node's pose is perturbed on the right, by dx, dy, da: the point moves by dx - y da, dy + x da.
        arm = np.array([[1.0, 0.0, -pair.y], [0.0, 1.0, pair.x]])
        jacobian[2 * k : 2 * k + 2, 3 * k : 3 * k + 3] = pose.rotation @ arm
    joint = graph.covariance(nodes).reshape(3 * len(pairs), 3 * len(pairs))
    shape = _shape_alone(points, jacobian @ joint @ jacobian.T)
    return points, shape + CLICK**2 * np.eye(2 * len(pairs))


def _shape_alone(points: Array, covariance: Array) -> Array:
    """A covariance without what moves all points as one.

    How certain that is depends on the node that is held, and it moves what is answered in plan coordinates
    as well. Baarda's S-transformation of a free network.
    """
    around = points - points.mean(axis=0)
    motions = np.zeros((len(points), 2, 3))
    motions[:, 0, 0] = motions[:, 1, 1] = 1.0
    motions[:, :, 2] = np.stack([-around[:, 1], around[:, 0]], axis=1)
    basis, _ = np.linalg.qr(motions.reshape(-1, 3))
    rest: Array = np.eye(2 * len(points)) - basis @ basis.T
    return rest @ covariance @ rest.T


def _part(plan: FloorPlan, merged: MergedMap, component: int, members: Sequence[int]) -> PlanPart:
    pairs = [plan.pairs[k] for k in members]
    points, covariance = points_in_merged(pairs, merged, component)
    pixels, scale = plan.pixels[list(members)], plan.metres_per_pixel
    check_pairs(points, pixels, covariance, scale)
    fit = fit_similarity(points, pixels, covariance, scale)
    left_out = leave_one_out(points, pixels, covariance, scale)
    fitted, sigmas = fit.a_from_b.scale, 0.0
    if scale is not None:
        fitted, sigmas = scale_contradiction(points, pixels, covariance, scale)
    corner = Pose2(fit.a_from_b.x, fit.a_from_b.y, fit.a_from_b.heading)
    in_plan = plan.origin.apply(fit.a_from_b.scale * pixels)
    off = np.linalg.norm(fit.residuals, axis=1)
    return PlanPart(
        component,
        plan.origin @ corner.inverse(),
        fit.a_from_b.scale,
        _image_matrix(plan, fit),
        tuple(fit.covariance.ravel().tolist()),
        _sigma(fit, pixels.mean(axis=0)),
        fit.rms,
        tuple(
            FittedPair(
                members[k] + 1, pair.node, _tuple(points[k]), _tuple(in_plan[k]), float(off[k]),
                left_out[k].off, left_out[k].chance,
            )
            for k, pair in enumerate(pairs)
        ),
        fitted,
        sigmas,
        tuple(_doubts(plan, members, left_out, fitted, sigmas)),
    )  # fmt: skip


def _doubts(
    plan: FloorPlan, members: Sequence[int], left_out: Sequence[LeftOut], fitted: float, sigmas: float
) -> Iterable[str]:
    wrong = wrong_pair(left_out)
    if wrong is not None:
        pair = plan.pairs[members[wrong]]
        yield (
            f"pair {members[wrong] + 1} ({pair.node}, {pair.u:g},{pair.v:g}) is most probably wrong: it lies "
            f"{left_out[wrong].off:.2f} m from where the other pairs put it"
        )
    scale = plan.metres_per_pixel
    if scale is not None and sigmas > STRETCHED:
        yield (
            f"the pairs say {fitted:.4g} m/px, the plan says {scale:.4g}: {fitted / scale - 1.0:+.1%}, "
            f"{sigmas:.1f} sigma: a pair is wrong, or the plan or the map is stretched"
        )


def _image_matrix(plan: FloorPlan, fit: SimilarityFit) -> tuple[float, float, float, float, float, float]:
    """The matrix of pixels as images have them, y down."""
    origin, right, down = fit.a_from_b.apply(
        np.array([[0.0, plan.image.height], [1.0, plan.image.height], [0.0, plan.image.height - 1.0]])
    )
    (a, b), (c, d) = (right - origin).tolist(), (down - origin).tolist()
    return a, b, c, d, float(origin[0]), float(origin[1])


def _sigma(fit: SimilarityFit, pixel: Array) -> float:
    """The sigma of where a pixel is in the map, m: the mean over the directions."""
    arm = Pose2(0.0, 0.0, fit.a_from_b.heading).apply(fit.a_from_b.scale * pixel)
    jacobian = np.array([[1.0, 0.0, -arm[1], arm[0]], [0.0, 1.0, arm[0], arm[1]]])
    return math.sqrt(0.5 * float(np.trace(jacobian @ fit.covariance @ jacobian.T)))


def _tuple(point: Array) -> tuple[float, float]:
    return float(point[0]), float(point[1])
