"""What drives have done to the map: the edges that they measured, and the merged map before and after."""

import statistics

import numpy as np

from benchmarks.navigate.office import Mapped
from mapweave.evaluation.map_score import score_map
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.node import EdgeKind
from mapweave.storage.map_file import MapFile

Figures = dict[str, float | int | None]


def map_figures(before: MapFile, after: MapFile, mapped: Mapped) -> Figures:
    """Compare driven edges and merged maps with the truth.

    Args:
        before: the server's map before the first drive.
        after: and after the last.
        mapped: where each node's image was truly taken.

    Returns:
        Errors are medians over the driven edges, `driven_nees` the mean squared Mahalanobis distance of the
        truth (3 is expected); the map's error is that of its nodes after one rigid alignment, RMS.
    """
    edges = [edge for edge in HybridMap(after.changes).edges.values() if edge.kind is EdgeKind.DRIVEN]
    true = [mapped.truth[edge.a].inverse() @ mapped.truth[edge.b] for edge in edges]
    off = [edge.a_from_b.mean.inverse() @ there for edge, there in zip(edges, true, strict=True)]
    nees = [edge.a_from_b.mahalanobis2(there) for edge, there in zip(edges, true, strict=True)]
    both_ways = sum(min(edge.evidence["there"], edge.evidence["back"]) > 0 for edge in edges)
    errors = [float(np.hypot(one.x, one.y)) for one in off]
    turns = [float(np.degrees(abs(one.heading))) for one in off]
    return {
        "driven_edges": len(edges),
        "driven_both_ways": both_ways,
        "driven_error_m_median": round(statistics.median(errors), 4) if edges else None,
        "driven_error_deg_median": round(statistics.median(turns), 3) if edges else None,
        "driven_nees": round(statistics.mean(nees), 2) if edges else None,
        "map_error_m_before": round(_error(before, mapped), 4),
        "map_error_m_after": round(_error(after, mapped), 4),
    }


def _error(merged: MapFile, mapped: Mapped) -> float:
    places = {node: (component, pose.mean) for node, (component, pose) in merged.poses.items()}
    return score_map(places, [], mapped.truth).ate
