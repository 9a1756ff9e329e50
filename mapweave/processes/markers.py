"""Markers of ROS (visualization_msgs) of what a robot knows: its map, and its landmarks."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from mapweave.agent.ros_messages import making
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Edge
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.processes.tick_log import EDGE_COLOURS
from mapweave.wire.ros2.messages import make

MAP = "map"
SPHERE, SPHERES, LINES = 2, 7, 5
"""Types of visualization_msgs/msg/Marker."""
ADD, DELETE, DELETE_ALL = 0, 2, 3
"""Actions."""
ORANGE = (0.94, 0.63, 0.16)
"""Red, green and blue of landmarks."""


def map_markers(places: Mapping[NodeId, Pose2], edges: Iterable[Edge]) -> Any:
    """A MarkerArray in the frame `map`: nodes, and edges by their kind."""
    points = {node: _point(np.array([at.x, at.y, 0.0])) for node, at in places.items()}
    markers = [_marker(MAP, "nodes", 0, SPHERES, (0.08,) * 3, (0.9, 0.9, 0.9), list(points.values()))]
    known = [edge for edge in edges if edge.a in points and edge.b in points]
    for number, (kind, colour) in enumerate(EDGE_COLOURS.items(), 1):
        ends = [points[end] for edge in known if edge.kind is kind for end in (edge.a, edge.b)]
        markers.append(_marker(MAP, kind.name.lower(), number, LINES, (0.03,) * 3, colour, ends))
    return make("visualization_msgs/msg/MarkerArray", markers=markers)


def landmark_markers(stamp_ns: int, frame: str, points: Array, drawn: tuple[Array, Array, Array]) -> Any:
    """A MarkerArray of landmarks, in place of those before.

    Args:
        stamp_ns: of the image.
        frame: of the points.
        points: (M, 3) m, all landmarks.
        drawn: of `mapweave.processes.tick_log.ellipsoids`.
    """
    nothing = _marker(frame, "", 0, SPHERES, (0.0,) * 3, ORANGE, [], action=DELETE_ALL)
    dots = [_point(point) for point in points[np.isfinite(points).all(axis=1)]]
    markers = [nothing, _marker(frame, "landmarks", 0, SPHERES, (0.02,) * 3, ORANGE, dots, stamp_ns)]
    for number, (centre, half, quaternion) in enumerate(zip(*drawn, strict=True)):
        x, y, z, w = quaternion.tolist()
        turn = make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
        pose = make("geometry_msgs/msg/Pose", position=_point(centre), orientation=turn)
        size = tuple(np.maximum(2.0 * half, 1e-3).tolist())
        marker = _marker(
            frame, "ellipsoids", number, SPHERE, size, ORANGE, [], stamp_ns, pose, ADD, alpha=0.25
        )
        markers.append(marker)
    return make("visualization_msgs/msg/MarkerArray", markers=markers)


def _point(at: Array) -> Any:
    x, y, z = map(float, at)
    return make("geometry_msgs/msg/Point", x=x, y=y, z=z)


def _marker(
    frame: str,
    name: str,
    number: int,
    form: int,
    size: tuple[float, ...],
    colour: tuple[float, float, float],
    points: list[Any],
    stamp_ns: int = 0,
    pose: Any = None,
    action: int | None = None,
    alpha: float = 1.0,
) -> Any:
    red, green, blue = colour
    x, y, z = size
    nothing = make(
        "sensor_msgs/msg/CompressedImage", header=making.header(0, ""), format="",
        data=np.zeros(0, np.uint8),
    )  # fmt: skip
    if action is None:
        action = ADD if points else DELETE
    return make(
        "visualization_msgs/msg/Marker",
        header=making.header(stamp_ns, frame), ns=name, id=number, type=form, action=action,
        pose=making.pose(Pose2()) if pose is None else pose,
        scale=make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
        color=make("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=alpha),
        lifetime=make("builtin_interfaces/msg/Duration", sec=0, nanosec=0), frame_locked=False,
        points=points, colors=[], texture_resource="", texture=nothing, uv_coordinates=[], text="",
        mesh_resource="", mesh_use_embedded_materials=False,
        mesh_file=make("visualization_msgs/msg/MeshFile", filename="", data=np.zeros(0, np.uint8)),
    )  # fmt: skip
