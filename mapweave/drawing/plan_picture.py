"""Pictures of floor plans with the merged map over them."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapweave.drawing.map_picture import Backdrop, MapPicture, draw_map
from mapweave.hybridmap.floor_plan import PlacedPlan, PlanPart
from mapweave.merge.pose_graph.merged_map import MergedMap


def draw_plan(
    placed: PlacedPlan, part: PlanPart, pixels: NDArray[np.uint8], merged: MergedMap, path: Path
) -> None:
    """Write a PNG: the plan, one component of the map over it, and the pairs with their differences."""
    poses = {node: part.plan_from_merged @ merged.pose(node) for node in merged.components[part.component]}
    nodes = (merged.maps[node.map].nodes[node] for node in poses)
    points = [poses[n.id].apply(n.points_in_robot[n.landmarks.has_depth, :2]) for n in nodes]
    pairs = [
        (pair.plan, tuple(part.plan_from_merged.apply(np.array(pair.merged)).tolist())) for pair in part.pairs
    ]
    backdrop = Backdrop(pixels, placed.plan.origin, part.metres_per_pixel, pairs)
    low, high = backdrop.corners.min(axis=0), backdrop.corners.max(axis=0)
    landmarks = np.concatenate(points) if points else np.zeros((0, 2))
    # A landmark that is far off must not make the plan small.
    landmarks = landmarks[((landmarks >= low) & (landmarks <= high)).all(axis=1)]
    title = f"plan {placed.name}: {part.metres_per_pixel:.4g} m/px, residuals {part.rms:.2f} m rms"
    edges = list(merged.union().edges.values())
    draw_map(MapPicture(title, poses, edges, landmarks=landmarks, backdrop=backdrop), path)
