"""What an agent senses, estimates and decides, as MCAP with messages of ROS 2, for Foxglove and rviz.

/tf, /tf_static             map to base_footprint to camera_optical_frame
/camera/image/compressed    the image, and /camera/camera_info; /camera/tracks, the tracks in it
/landmarks                  the filter's landmarks with ellipsoids of two sigmas
/map, /floor                nodes and edges; what the rangers saw of the floor
/pose, /path                the pose with its covariance, and the way so far
/bearings/...               outermost bearings of the tracks against the limit of the field of view, deg
/cmd_vel, /status           what the wheels do; what the robot does and why, in words
"""

from functools import partial
from pathlib import Path
from typing import Any

import cv2

from mapweave.agent.occupancy_grid import GridCells
from mapweave.agent.recordings.mcap_writer import McapTopics, check_new
from mapweave.agent.ros_messages import making
from mapweave.agent.ros_messages.values import FOOTPRINT, TF_TYPE
from mapweave.hybridmap.errors import DeviceError, SettingsError
from mapweave.hybridmap.node import Edge, Node
from mapweave.hybridmap.pose import Pose2
from mapweave.processes.markers import MAP, landmark_markers, map_markers
from mapweave.processes.tick_log import QUALITY, STEP, LoggedTick, TickLog, ellipsoids
from mapweave.wire.ros2.messages import make

POINTS, TRACK_PX = 1, 4.0
"""Of foxglove_msgs/msg/PointsAnnotation: type, and size of a point."""


class McapLog(TickLog):
    """Writes a bag, FOLDER/NAME.mcap with its metadata."""

    title = "MCAP log"

    def __init__(self, folder: str) -> None:
        """Begin a recording.

        Raises:
            SettingsError: it cannot be made, or holds something.
        """
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

        path = Path(folder)
        try:
            check_new(path)
            path.rmdir()  # which rosbags makes itself
            self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
            # Floor and ellipsoids repeat themselves: a third of the bytes, for a ms of each second.
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            self._writer.open()
        except (DeviceError, OSError) as error:
            raise SettingsError(f"--mcap-log {error}") from None
        self._topics = McapTopics(self._writer)
        self._camera: Any = None
        self._path: list[Any] = []
        self._last: Pose2 | None = None
        super().__init__("mcap-log")

    def _write(self, moment: LoggedTick) -> None:
        send = partial(self._topics.send, stamp_ns=moment.stamp_ns)
        if moment.camera != self._camera:
            self._camera = moment.camera
            mount = making.mount(moment.stamp_ns, moment.camera)
            send("/tf_static", make(TF_TYPE, transforms=[mount]))
        self._write_image(moment, send)
        self._write_pose(moment, send)
        markers = landmark_markers(
            moment.stamp_ns,
            FOOTPRINT,
            moment.landmarks,
            ellipsoids(moment.landmarks, moment.covariances),
        )
        send("/landmarks", markers)
        for curve, degrees in moment.bearing_curves.items():
            send(f"/bearings/{curve}", _number(degrees))
        if moment.floor is not None:
            send("/floor", _floor(moment.floor, moment.stamp_ns))
        status = moment.status
        send("/status", make("std_msgs/msg/String", data=f"{status.mission}; {status.words}"))

    def _end(self, ended: bool) -> str:
        if not ended:
            return "the end (the disk is too slow)"
        try:
            self._writer.close()
        except OSError as error:
            return f"the end ({error.strerror})"
        return ""

    def _write_image(self, moment: LoggedTick, send: Any) -> None:
        head = making.header(moment.stamp_ns, making.OPTICAL)
        if moment.image is not None:
            data = cv2.imencode(".jpg", moment.image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].reshape(-1)
            image = make("sensor_msgs/msg/CompressedImage", header=head, format="jpeg", data=data)
            send("/camera/image/compressed", image)
        send("/camera/camera_info", making.camera_info(head, moment.camera))
        point, green = (
            "foxglove_msgs/msg/Point2",
            make("foxglove_msgs/msg/Color", r=0.24, g=0.86, b=0.35, a=1.0),
        )
        # Theirs begin at the corner of the first pixel, ours in its middle.
        points = [make(point, x=x + 0.5, y=y + 0.5) for x, y in moment.tracks_px.tolist()]
        tracks = make(
            "foxglove_msgs/msg/PointsAnnotation", timestamp=head.stamp, type=POINTS, points=points,
            outline_color=green, outline_colors=[], fill_color=green, thickness=TRACK_PX,
        )  # fmt: skip
        annotations = make("foxglove_msgs/msg/ImageAnnotations", circles=[], points=[tracks], texts=[])
        send("/camera/tracks", annotations)

    def _write_pose(self, moment: LoggedTick, send: Any) -> None:
        head = making.header(moment.stamp_ns, FOOTPRINT)
        send(
            "/cmd_vel",
            make("geometry_msgs/msg/TwistStamped", header=head, twist=making.twist(moment.command)),
        )
        if moment.map_from_robot is None:
            return
        pose, head = moment.map_from_robot.mean, making.header(moment.stamp_ns, MAP)
        moved = making.transform(moment.stamp_ns, MAP, FOOTPRINT, pose)
        send("/tf", make(TF_TYPE, transforms=[moved]))
        known = making.pose_with_covariance(moment.map_from_robot)
        send("/pose", make("geometry_msgs/msg/PoseWithCovarianceStamped", header=head, pose=known))
        if self._last is None or pose.distance(self._last) > STEP:
            self._last = pose
            self._path.append(make("geometry_msgs/msg/PoseStamped", header=head, pose=making.pose(pose)))

    def _write_map(self, stamp_ns: int, nodes: tuple[Node, ...], edges: tuple[Edge, ...]) -> None:
        places = {node.id: node.map_from_robot.mean for node in nodes}
        self._topics.send("/map", map_markers(places, edges), stamp_ns)
        head = making.header(stamp_ns, MAP)
        self._topics.send("/path", make("nav_msgs/msg/Path", header=head, poses=self._path), stamp_ns)


def _number(value: float) -> Any:
    return make("std_msgs/msg/Float64", data=float(value))


def _floor(cells: GridCells, stamp_ns: int) -> Any:
    """Rows of the message are along y of the map, columns along x."""
    seen = cells.occupancy
    x, y = cells.corner.tolist()
    info = make(
        "nav_msgs/msg/MapMetaData", map_load_time=making.header(stamp_ns, MAP).stamp,
        resolution=cells.side, width=seen.shape[0], height=seen.shape[1],
        origin=making.pose(Pose2(x, y)),
    )  # fmt: skip
    data = seen.T.ravel()
    head = making.header(stamp_ns, MAP)
    return make("nav_msgs/msg/OccupancyGrid", header=head, info=info, data=data)
