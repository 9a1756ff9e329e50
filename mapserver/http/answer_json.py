"""A relocalization in plain values, as it is printed and sent to people."""

from __future__ import annotations

from typing import Any

import numpy as np

from mapweave.hybridmap.query import RelocalizeAnswer


def answer_record(answer: RelocalizeAnswer) -> dict[str, Any]:
    """The answer for `json.dumps`.

    Returns:
        `certainty`, `reason` and `candidates`, best first: `node`; `node_from_robot` and `merged_from_robot`
        (None if the node lies nowhere yet), [m, m, rad]; `sigma` of the first, [m, m, rad]; `component`,
        `inliers`, `probability` and `distance_known`.
    """
    candidates = []
    for place in answer.candidates:
        merged = place.merged_from_robot
        candidates.append({
            "node": str(place.node),
            "node_from_robot": place.node_from_robot.mean.vector.tolist(),
            "sigma": np.sqrt(np.diag(place.node_from_robot.covariance)).tolist(),
            "merged_from_robot": None if merged is None else merged.mean.vector.tolist(),
            "component": place.component,
            "inliers": place.inliers,
            "probability": place.probability,
            "distance_known": place.distance_known,
        })  # fmt: skip
    return {"certainty": str(answer.certainty), "reason": answer.reason, "candidates": candidates}
