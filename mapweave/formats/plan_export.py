"""The transform between a floor plan and the merged map, as Open-RMF, Nav2 and tf want it."""

import json
import math
from collections.abc import Callable, Sequence

import numpy as np

from mapweave.hybridmap.floor_plan import FloorPlan, PlacedPlan, PlanPart
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.mapserver.http.json_values import json_values

MAP_FRAME = "map"
"""What ROS calls the frame of a map; here that of the merged map."""


def export_rmf(placed: PlacedPlan, part: PlanPart) -> str:
    """`reference_coordinates` of an RMF fleet adapter's configuration.

    RMF's coordinates are those of the traffic editor: metres from the upper left corner of the image, x
    right, y up, so that all y are negative. The points lie exactly on the transform: what the adapter's
    `nudged` estimates from them is just this transform.
    """
    robot = np.array([pair.merged for pair in part.pairs])
    rmf = rmf_points(placed.plan, part, robot)
    # RMF wants the transform from its own coordinates to the robot's.
    corner = rmf_from_plan(placed.plan, part)
    robot_from_rmf = (corner @ part.plan_from_merged).inverse()
    return "\n".join([
        f"# Plan {placed.name} ({placed.plan.image.file}), Mapweave component {part.component}.",
        "# rmf: m in the traffic editor, with this image as the floor plan at "
        f"{part.metres_per_pixel:.6g} m/px.",
        "# robot: m in the merged map.",
        f"# rotation {robot_from_rmf.heading:.6f} rad, scale 1, translation "
        f"[{robot_from_rmf.x:.4f}, {robot_from_rmf.y:.4f}] (robot from rmf, as nudged.estimate(rmf, robot))",
        "reference_coordinates:",
        f"  {json.dumps(placed.name, ensure_ascii=False)}:",
        f"    rmf: {_points(rmf)}",
        f"    robot: {_points(robot)}",
        "",
    ])  # fmt: skip


def export_nav2(placed: PlacedPlan, part: PlanPart) -> str:
    """The lines of a `map.yaml` that put the image under the merged map, and the transform instead."""
    corner = part.plan_from_merged.inverse() @ placed.plan.origin
    return "\n".join([
        f"# Plan {placed.name}, Mapweave component {part.component}.",
        "# Either: the image in the frame of the merged map. Many parts of Nav2 ignore the yaw of an origin.",
        f"image: {json.dumps(placed.plan.image.file, ensure_ascii=False)}",
        f"resolution: {part.metres_per_pixel:.6g}",
        f"origin: [{corner.x:.4f}, {corner.y:.4f}, {corner.heading:.6f}]",
        "# Or: keep the map.yaml as it is, and publish where its frame lies in that of the merged map:",
        f"# {_static_transform(placed.name, part)}",
        "",
    ])  # fmt: skip


def export_tf(placed: PlacedPlan, part: PlanPart) -> str:
    """The command that publishes the frame of the plan in that of the merged map."""
    return f"{_static_transform(placed.name, part)}\n"


def export_json(placed: PlacedPlan, part: PlanPart) -> str:
    """Everything that is known, one JSON object."""
    inverse = part.plan_from_merged.inverse()
    content = {
        "name": placed.name,
        "image": json_values(placed.plan.image),
        "origin": json_values(placed.plan.origin),
        **json_values(part),
        "merged_from_plan": json_values(inverse),
    }
    return f"{json.dumps(content, indent=1)}\n"


FORMATS: dict[str, Callable[[PlacedPlan, PlanPart], str]] = {
    "rmf": export_rmf,
    "nav2": export_nav2,
    "tf": export_tf,
    "json": export_json,
}
"""What each is called on the command line."""


def rmf_from_plan(plan: FloorPlan, part: PlanPart) -> Pose2:
    """The frame of the plan in that of the traffic editor, whose origin is the upper left corner."""
    upper_left = plan.origin @ Pose2(0.0, plan.image.height * part.metres_per_pixel, 0.0)
    return upper_left.inverse()


def rmf_points(plan: FloorPlan, part: PlanPart, merged: Array) -> Array:
    """(K, 2) points of the component in the traffic editor, m."""
    return rmf_from_plan(plan, part).apply(part.plan_from_merged.apply(merged))


def _static_transform(name: str, part: PlanPart) -> str:
    pose = part.plan_from_merged.inverse()
    frame = "".join(c if c.isascii() and c.isalnum() else "_" for c in name).strip("_") or "plan"
    return (
        f"ros2 run tf2_ros static_transform_publisher --x {pose.x:.4f} --y {pose.y:.4f} --z 0 "
        f"--yaw {pose.heading:.6f} --pitch 0 --roll 0 --frame-id {MAP_FRAME} --child-frame-id {frame}"
    )


def _points(points: Array | Sequence[Sequence[float]]) -> str:
    return f"[{', '.join(f'[{x:.4f}, {y:.4f}]' for x, y in points)}]"


def plan_words(placed: PlacedPlan) -> list[str]:
    """What `mapweave plan show` prints: the transform, each pair, and doubts."""
    plan = placed.plan
    size = f"{plan.image.width} x {plan.image.height} px"
    lines = [f"plan {placed.name}: {plan.image.file}, {size}, {len(plan.pairs)} pairs"]
    for part in placed.parts:
        pose, sigmas = part.plan_from_merged, np.sqrt(np.diag(np.reshape(part.covariance, (4, 4))))
        given = plan.metres_per_pixel is not None
        scale = f"{part.metres_per_pixel:.5g} m/px"
        scale += (
            f" as given, {part.fitted_scale:.5g} by the pairs ({part.scale_sigmas:.1f} sigma)"
            if given
            else f" by the pairs (sigma {sigmas[3]:.1%})"
        )
        lines += [
            f"component {part.component}: {scale}; residuals {part.rms:.2f} m rms",
            f"  plan_from_merged: {pose.x:.3f}, {pose.y:.3f} m, {math.degrees(pose.heading):.2f} deg; sigma "
            f"{part.sigma:.2f} m amid the pairs, {math.degrees(sigmas[2]):.2f} deg",
        ]
        lines += [
            f"  pair {pair.number}: {pair.node}, map {pair.merged[0]:.2f},{pair.merged[1]:.2f}, plan "
            f"{pair.plan[0]:.2f},{pair.plan[1]:.2f}: off by {pair.off:.2f} m, from the others by "
            f"{pair.off_others:.2f} m"
            for pair in part.pairs
        ]
        lines += [f"  doubtful: {doubt}" for doubt in part.doubts]
    if placed.reason:
        lines.append(f"left out: {placed.reason}" if placed.parts else f"not placed: {placed.reason}")
    return lines
