"""Values as JSON: the fields of the wire, with ids as `r0.1.17` and poses and arrays as numbers."""

from dataclasses import fields
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints, event_words
from mapweave.hybridmap.map_event import MapEvent
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.wire.typed import Packers, packed


def json_values(value: Any) -> dict[str, Any]:
    """What `json.dumps` takes: the fields of a value by name."""
    values: dict[str, Any] = packed(value, AS_JSON)
    return values


def constraint_values(record: ManualConstraints) -> dict[str, Any]:
    """The record of manual constraints: each with its number, whether it is in force, and in words."""
    holding = set(record.in_force)
    return {
        "constraints": [
            {
                "number": number,
                "in_force": constraint in holding,
                "time": time_of(constraint.stamp_ns),
                **json_values(constraint),
            }
            for number, constraint in enumerate(record.made, 1)
        ]
    }


def time_of(stamp_ns: int) -> str:
    """Wall time since 1970 as `2026-03-01 12:00:07`, UTC."""
    return datetime.fromtimestamp(stamp_ns // 1_000_000_000, UTC).strftime("%Y-%m-%d %H:%M:%S")


def _numbers(array: NDArray[Any]) -> Any:
    """Nested lists; NaN becomes None."""
    if array.dtype.kind != "f":
        return array.tolist()
    return np.where(np.isnan(array), np.array(None), array).tolist()


def _pose(pose: PoseGaussian) -> dict[str, Any]:
    sigma = np.sqrt(np.diag(pose.covariance))
    return {
        "mean": pose.mean.vector.tolist(),
        "sigma": sigma.tolist(),
        "covariance": pose.covariance.tolist(),
    }


def _node(node: Node) -> dict[str, Any]:
    """A node with what is needed to draw it: the size of its image and where in it the landmarks are, px."""
    pixels = np.round(node.landmarks.pixels.astype(float), 1)
    return {
        "id": str(node.id),
        "image": [node.camera.width, node.camera.height],
        "pixels": pixels.tolist(),
    }


def _event(event: MapEvent) -> dict[str, Any]:
    return {
        "stamp_ns": event.stamp_ns,
        "time": time_of(event.stamp_ns),
        "kind": event.kind.value,
        "words": event.words,
    }


def _constraint(constraint: ManualConstraint) -> dict[str, Any]:
    values = {field.name: packed(getattr(constraint, field.name), AS_JSON) for field in fields(constraint)}
    return {**values, "words": event_words(constraint)}


AS_JSON: Packers = {
    ManualConstraint: _constraint,
    MapId: str,
    NodeId: str,
    Pose2: lambda pose: pose.vector.tolist(),
    PoseGaussian: _pose,
    Node: _node,
    MapEvent: _event,
    np.ndarray: _numbers,
}
