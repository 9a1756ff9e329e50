"""Explanations in plain values, as they are printed and sent to people."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Any

import numpy as np

from mapweave.hybridmap.explanation import (
    Explanation,
    Hop,
    MapsExplanation,
    PairExplanation,
    RouteExplanation,
)
from mapweave.hybridmap.manual_constraint import ManualConstraint
from mapweave.hybridmap.map_event import MapEvent
from mapweave.hybridmap.pose import PoseGaussian


def explanation_record(told: Explanation) -> dict[str, Any]:
    """Of two nodes, of a route, or of each two maps as `maps`."""
    if isinstance(told, PairExplanation):
        return pair_values(told)
    if isinstance(told, RouteExplanation):
        return route_values(told)
    return {"maps": [maps_values(one) for one in told]}


def pair_values(told: PairExplanation) -> dict[str, Any]:
    """The explanation of two nodes for `json.dumps`, with all that is needed to draw it.

    Returns:
        The fields of PairExplanation by name. `images` are [width, height] px of a and b, `pixels` where each
        of their landmarks is in them; `matches` and `shared` are indices of landmarks.
    """
    misfit = told.misfit
    return {
        "a": str(told.a.id),
        "b": str(told.b.id),
        "standing": str(told.standing),
        "reason": told.reason,
        "landmarks": [len(node.landmarks) for node in (told.a, told.b)],
        "images": [[node.camera.width, node.camera.height] for node in (told.a, told.b)],
        "pixels": [np.round(node.landmarks.pixels.astype(float), 1).tolist() for node in (told.a, told.b)],
        "matches": told.matches.tolist(),
        "shared": told.shared.tolist(),
        "residuals_px": [None if np.isnan(value) else float(value) for value in told.residuals_px],
        "a_from_b": None if told.a_from_b is None else _gaussian(told.a_from_b),
        "evidence": told.evidence,
        "probability": told.probability,
        "misfit": None
        if misfit is None
        else {
            "merged_a_from_b": _gaussian(misfit.merged_a_from_b),
            "off": misfit.off.tolist(),
            "strain2": misfit.strain2,
            "alone": misfit.alone,
        },
        "witnesses": [
            {"a": str(w.a), "b": str(w.b), "distance2": w.distance2, "agrees": w.agrees, "kept": w.kept}
            for w in told.witnesses
        ],
        "claims": list(told.claims),
        "rulings": [_ruling_values(ruling) for ruling in told.rulings],
    }


def maps_values(told: MapsExplanation) -> dict[str, Any]:
    """The explanation of two maps for `json.dumps`: the fields of MapsExplanation by name."""
    return {
        "first": str(told.first),
        "second": str(told.second),
        "joined": told.joined,
        "reason": told.reason,
        "links": told.links,
        "landmarks": told.landmarks,
        "refused": told.refused,
        "unverified": told.unverified,
        "nearest": [
            {"a": str(n.a), "b": str(n.b), "matches": n.matches, "inliers": n.inliers, "lacks": n.lacks}
            for n in told.nearest
        ],
        "rulings": [_ruling_values(ruling) for ruling in told.rulings],
    }


def route_values(told: RouteExplanation) -> dict[str, Any]:
    """The explanation of a route for `json.dumps`: the fields of RouteExplanation by name."""
    return {
        "start": str(told.start),
        "goal": str(told.goal),
        "found": told.found,
        "reason": told.reason,
        "hops": [_hop(hop) for hop in told.hops],
        "gaps": [_hop(hop) for hop in told.gaps],
        "apart": None if told.apart is None else maps_values(told.apart),
    }


def history_record(happenings: Iterable[MapEvent]) -> dict[str, Any]:
    """What has happened, for `json.dumps`: `history`, each with `stamp_ns`, `time` (UTC), `kind`, `words`."""
    return {
        "history": [
            {
                "stamp_ns": one.stamp_ns,
                "time": time_of(one.stamp_ns),
                "kind": str(one.kind),
                "words": one.words,
            }
            for one in happenings
        ]
    }


def time_of(stamp_ns: int) -> str:
    """Wall time since 1970 as `2026-03-01 12:00:07`, UTC."""
    return datetime.fromtimestamp(stamp_ns // 1_000_000_000, UTC).strftime("%Y-%m-%d %H:%M:%S")


def _hop(hop: Hop) -> dict[str, Any]:
    return {
        "a": str(hop.a),
        "b": str(hop.b),
        "kind": hop.kind,
        "distance": hop.distance,
        "turn": hop.turn,
        "cost": hop.cost,
        "words": hop.words,
    }


def _gaussian(pose: PoseGaussian) -> dict[str, Any]:
    return {"mean": pose.mean.vector.tolist(), "covariance": pose.covariance.tolist()}


def _ruling_values(ruling: ManualConstraint) -> dict[str, Any]:
    return {
        "ends": [str(end) for end in ruling.ends],
        "apart": ruling.apart,
        "who": ruling.who,
        "stamp_ns": ruling.stamp_ns,
        "because": ruling.because,
    }
