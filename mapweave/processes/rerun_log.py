"""What an agent senses, estimates and decides, for the Rerun viewer: into a file, or to a viewer that runs.

Below the robot's name, on the time line `stamp`:

    map                       frame of the robot's own map
    map/nodes, map/edges      the map so far, edges in the colours of their kinds
    map/floor                 what the rangers saw: free, occupied, unknown
    map/robot                 pose of the robot; map/path is the way so far
    map/robot/landmarks       the filter's landmarks with ellipsoids of two sigmas
    map/robot/camera          the camera, its image, and the tracks in it
    bearings/...              outermost bearings of the tracks against the limit of the field of view
    pose/..., command/...     uncertainty of the pose, and what the wheels do
    status, now               what it does and why, in words
"""

import socket
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from mapweave.agent.occupancy_grid import GridCells
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import NotConnected, SettingsError
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Edge, Node
from mapweave.hybridmap.pose import Array
from mapweave.processes.tick_log import (
    EDGE_COLOURS,
    PATIENCE,
    QUALITY,
    STEP,
    LoggedTick,
    TickLog,
    ellipsoids,
)

CONNECT = "connect"
"""Instead of a file: to the viewer on this computer."""
VIEWER = "rerun+http://127.0.0.1:9876/proxy"
"""Where a viewer listens, see `rerun --help`."""
SOON = 2.0
"""s; a viewer that is there is found sooner."""
IMAGE_AT = 0.5
"""m before the camera, where its image hangs: farther away it hides the map."""
SIDES, LIMIT = {"left": [60, 150, 230], "right": [50, 170, 90]}, [200, 60, 60]
"""Colours of the outermost bearings, and of their limits."""


class RerunLog(TickLog):
    """Writes for the Rerun viewer."""

    title = "Rerun log"

    def __init__(self, target: str, robot: str) -> None:
        """Begin a recording.

        Args:
            target: file that ends with `.rrd`; `connect` for the viewer on this computer; or the address of
                a viewer, `rerun+http://192.168.1.7:9876/proxy`.
            robot: its name, under which everything is.

        Raises:
            SettingsError: the target is none of these, or the file cannot be written.
            NotConnected: there is no viewer.
        """
        self._robot = robot
        self._recording = recording = rr.RecordingStream("mapweave", make_default=False)
        if target == CONNECT or target.startswith("rerun+"):
            address = VIEWER if target == CONNECT else target
            _check_viewer(address)
            recording.connect_grpc(address, default_blueprint=_layout(robot))
        else:
            recording.save(_writable(target), default_blueprint=_layout(robot))
        recording.set_log_tick_enabled(False)
        recording.set_log_time_enabled(False)
        self._words = ""
        self._path: list[Array] = []
        self._camera: Camera | None = None
        super().__init__("rerun")

    def _write(self, moment: LoggedTick) -> None:
        self._recording.set_time("stamp", timestamp=np.datetime64(moment.stamp_ns, "ns"))
        self._write_camera(moment)
        self._write_pose(moment)
        self._write_words(moment)
        if moment.floor is not None:
            self._log("map/floor", _floor(moment.floor))

    def _end(self, ended: bool) -> str:
        missing = ""
        try:
            self._recording.flush(timeout_sec=PATIENCE)
        except RuntimeError as error:
            missing = f"the end ({str(error).splitlines()[0]})"
        self._recording.disconnect()
        return missing

    def _log(self, path: str, value: rr.AsComponents, static: bool = False) -> None:
        self._recording.log(f"{self._robot}/{path}", value, static=static)

    def _write_camera(self, moment: LoggedTick) -> None:
        camera, path = moment.camera, "map/robot/camera"
        if camera != self._camera:
            self._camera = camera
            # The camera looks along the robot's x: its x is the robot's -y, its y the robot's -z.
            axes = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
            at = [camera.mount_forward, 0.0, camera.mount_height]
            self._log(path, rr.Transform3D(translation=at, mat3x3=axes))
            size = (camera.width, camera.height)
            focal, middle = (camera.fx, camera.fy), (camera.cx, camera.cy)
            lens = rr.Pinhole(
                focal_length=focal, principal_point=middle, resolution=size, image_plane_distance=IMAGE_AT
            )
            self._log(path, lens)
            for side, colour in SIDES.items():
                outermost = rr.SeriesLines(colors=colour, names=f"outermost {side}")
                self._log(f"bearings/outermost_{side}", outermost, static=True)
                limit = rr.SeriesLines(colors=LIMIT, names=f"limit {side}")
                self._log(f"bearings/limit_{side}", limit, static=True)
        if moment.image is not None:
            self._log(path, rr.Image(moment.image).compress(jpeg_quality=QUALITY))
        self._log(f"{path}/tracks", rr.Points2D(moment.tracks_px, radii=2.0, colors=[60, 220, 90]))
        for curve, degrees in moment.bearing_curves.items():
            self._log(f"bearings/{curve}", rr.Scalars(degrees))

    def _write_pose(self, moment: LoggedTick) -> None:
        self._log("map/robot/landmarks", rr.Points3D(moment.landmarks, radii=0.01, colors=[240, 160, 40]))
        self._log("map/robot/ellipsoids", _ellipsoids(moment.landmarks, moment.covariances))
        for name, value in (("forward", moment.command.forward), ("turn", moment.command.turn)):
            self._log(f"command/{name}", rr.Scalars(value))
        self._log("tracked", rr.Scalars(moment.status.tracked))
        if moment.map_from_robot is None:
            return
        pose, sigma = moment.map_from_robot.mean, np.sqrt(np.diag(moment.map_from_robot.covariance))
        angle = rr.RotationAxisAngle(axis=[0.0, 0.0, 1.0], radians=pose.heading)
        self._log("map/robot", rr.Transform3D(translation=[pose.x, pose.y, 0.0], rotation=angle))
        self._log("pose/sigma_xy", rr.Scalars(float(sigma[:2].max())))
        self._log("pose/sigma_heading", rr.Scalars(float(sigma[2])))
        here = np.array([pose.x, pose.y, 0.0])
        if not self._path or np.linalg.norm(here - self._path[-1]) > STEP:
            self._path.append(here)

    def _write_map(self, stamp_ns: int, nodes: tuple[Node, ...], edges: tuple[Edge, ...]) -> None:
        self._recording.set_time("stamp", timestamp=np.datetime64(stamp_ns, "ns"))
        means = {node.id: node.map_from_robot.mean for node in nodes}
        places = {node: np.array([at.x, at.y, 0.0]) for node, at in means.items()}
        labels = [str(node.id) for node in nodes]
        self._log(
            "map/nodes", rr.Points3D(list(places.values()), labels=labels, show_labels=False, radii=0.04)
        )
        self._log("map/edges", _edges(places, edges))
        self._log("map/path", rr.LineStrips3D([self._path], colors=[90, 130, 255]))

    def _write_words(self, moment: LoggedTick) -> None:
        status = moment.status
        self._log("now", rr.TextDocument(f"mission: {status.mission}\n\n{status.words}"))
        if status.doing != self._words:
            self._words = status.doing
            self._log("status", rr.TextLog(status.words))


def _ellipsoids(points: Array, covariances: Array) -> rr.Ellipsoids3D:
    """Ellipsoids of landmarks that are known well enough to be drawn."""
    centres, half_sizes, quaternions = ellipsoids(points, covariances)
    return rr.Ellipsoids3D(
        centers=centres, half_sizes=half_sizes, quaternions=quaternions,
        colors=[240, 160, 40], fill_mode=rr.components.FillMode.DenseWireframe,
    )  # fmt: skip


def _edges(places: dict[NodeId, Array], edges: tuple[Edge, ...]) -> rr.LineStrips3D:
    known = [edge for edge in edges if edge.a in places and edge.b in places]
    return rr.LineStrips3D(
        np.array([[places[edge.a], places[edge.b]] for edge in known]).reshape(-1, 2, 3),
        colors=np.array([EDGE_COLOURS[edge.kind] for edge in known]).reshape(-1, 3), radii=0.015,
        labels=[str(edge.kind) for edge in known], show_labels=False,
    )  # fmt: skip


def _floor(cells: GridCells) -> rr.GridMap:
    """Rows of the image are along -y of the map, columns along x."""
    image = np.ascontiguousarray(cells.occupancy.T[::-1].astype(np.uint8))  # unknown becomes 255
    form = rr.components.ImageFormat(
        width=image.shape[1], height=image.shape[0], color_model="L", channel_datatype="U8"
    )
    corner = [*cells.corner.tolist(), -0.01]
    return rr.GridMap(
        data=image.tobytes(),
        format=form,
        cell_size=cells.side,
        translation=corner,
        colormap=rr.components.Colormap.RvizMap,
    )


def _layout(robot: str) -> rrb.Blueprint:
    """The map on the left; camera, curves and words on the right."""
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(
                origin=f"{robot}/map",
                name="map",
                eye_controls=rrb.EyeControls3D(position=(-4.0, 0.0, 6.0), look_target=(1.0, 0.0, 0.0)),
            ),
            rrb.Vertical(
                rrb.Spatial2DView(origin=f"{robot}/map/robot/camera", name="camera"),
                rrb.TimeSeriesView(origin=f"{robot}/bearings", name="bearings against the limit, deg"),
                rrb.TimeSeriesView(origin=f"{robot}/pose", name="uncertainty of the pose, m and rad"),
                rrb.Tabs(
                    rrb.TextDocumentView(origin=f"{robot}/now", name="now"),
                    rrb.TextLogView(origin=f"{robot}/status", name="status"),
                ),
                row_shares=[4, 2, 2, 2],
            ),
        ),
        collapse_panels=True,
    )


def _check_viewer(address: str) -> None:
    parts = urlsplit(address)
    try:
        with socket.create_connection((parts.hostname or "", parts.port or 0), SOON):
            return
    except (OSError, ValueError, OverflowError):
        raise NotConnected(f"no Rerun viewer at {address}: start it with `rerun`, or give a file") from None


def _writable(target: str) -> Path:
    path = Path(target)
    if path.suffix != ".rrd":
        raise SettingsError(f"--rerun {target}: give a file that ends with .rrd, or {CONNECT}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    except OSError as error:
        raise SettingsError(f"--rerun {target}: cannot be written ({error.strerror})") from None
    return path
