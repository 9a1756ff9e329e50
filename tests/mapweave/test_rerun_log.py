"""What a replay writes for the Rerun viewer, read back by Rerun's reader as Arrow tables."""

import threading
import time
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mapweave import Camera, HybridMap, MapId, Pose2, read_camera, read_map_file
from mapweave.agent.localization.fix import Fix
from mapweave.agent.mapping.mapper import Mapper
from mapweave.agent.observation import Observation, Odometry, RobotDescription
from mapweave.agent.occupancy_grid import FREE, OCCUPIED, OccupancyGrid
from mapweave.agent.pipeline import Pipeline
from mapweave.cli import main
from mapweave.hybridmap.errors import NotConnected, SettingsError
from mapweave.vision.lens import Lens
from tests.agent.conftest import DESCRIPTION, PhotoWalls
from tests.agent.localization.test_node_localizer import located
from tests.mapweave.command_line import complaint
from tests.mapweave.log_readers import rows_of
from tests.mapweave.wall_drive import COUNT, STEP, wall_drive
from tests.waiting import free_port

# Each process that collects tests would wait for it, so it is imported where it is used.
pytestmark = pytest.mark.skipif(find_spec("rerun") is None, reason='needs the extra "rerun"')


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return wall_drive(tmp_path_factory.mktemp("drive") / "walk")


@pytest.mark.slow
def test_a_replay_is_read_back_as_it_was(drive: Path, tmp_path, capfd, signals: None):
    out = tmp_path / "logs" / "walk.rrd"
    words = ["--offline", "--data", str(tmp_path), "--epoch", "1", "--rerun", str(out)]
    assert main(["replay", str(drive), *words]) == 0
    assert "not in the Rerun log" not in capfd.readouterr().err
    rows = rows_of(out)
    stamps = [stamp for stamp, _ in rows["/walk/tracked:scalars"]]
    assert len(stamps) == COUNT and len(set(np.diff(stamps))) == 1
    for name in (
        "now:text",
        "command/forward:scalars",
        "map/robot/camera:blob",
        "map/robot/camera/tracks:positions",
    ):
        assert [stamp for stamp, _ in rows[f"/walk/{name}"]] == stamps, name
    # The image, but for what JPEG loses.
    for k in (0, COUNT - 1):
        blob = np.array(rows["/walk/map/robot/camera:blob"][k][1], np.uint8).ravel()
        image = cv2.imdecode(blob, cv2.IMREAD_GRAYSCALE)
        truth = cv2.imread(str(drive / "images" / f"{k}.png"), cv2.IMREAD_GRAYSCALE)
        assert np.abs(image.astype(int) - truth).mean() < 5.0
        inside = np.array(rows["/walk/map/robot/camera/tracks:positions"][k][1])
        assert ((inside >= 0) & (inside < [320, 240])).all()
    assert len(inside) == rows["/walk/tracked:scalars"][-1][1][0] > 20
    # The robot, as the replay's trajectory file has it.
    poses = np.loadtxt(tmp_path / "walk.1.tum")
    logged = [value[0] for _, value in rows["/walk/map/robot:translation"]]
    assert np.array(logged)[-len(poses) :, :2] == pytest.approx(poses[:, 1:3], abs=1e-5)
    assert logged[-1][0] == pytest.approx(STEP * (COUNT - 1), abs=0.05)
    # Its map, as the map file has it.
    whole = HybridMap(read_map_file(tmp_path / "walk.1.mapweave").changes)
    nodes, labels = (rows[f"/walk/map/nodes:{what}"][-1][1] for what in ("positions", "labels"))
    assert dict(zip(labels, np.array(nodes)[:, :2].tolist(), strict=True)) == {
        str(node.id): pytest.approx([node.map_from_robot.mean.x, node.map_from_robot.mean.y], abs=1e-5)
        for node in whole.nodes.values()
    }
    assert len(rows["/walk/map/edges:strips"][-1][1]) == len(whole.edges)
    # The bearings stay within what the camera sees.
    limit = np.degrees(read_camera(drive / "camera.toml")[0].semi_aperture)
    sides = [[value[0] for _, value in rows[f"/walk/bearings/{w}:scalars"]] for w in
             ("limit_right", "outermost_right", "outermost_left", "limit_left")]  # fmt: skip
    assert set(sides[0]) == {-sides[3][0]} and sides[3][0] == pytest.approx(limit)
    assert all(right < left for right, left in zip(sides[1], sides[2], strict=True))
    assert max(sides[2]) <= limit + 0.2 and min(sides[1]) >= -limit - 0.2
    # Their colours differ from that of the limits, and from each other.
    colours = {str(rows[f"/walk/bearings/{w}:colors"][-1][1]) for w in
               ("limit_left", "outermost_left", "outermost_right")}  # fmt: skip
    assert len(colours) == 3
    # Landmarks: on the walls, which are ahead of the robot.
    seen = np.array(rows["/walk/map/robot/landmarks:positions"][-1][1])
    assert len(seen) > 10 and (seen[:, 0] > 0.1).all()
    # Each ellipsoid is around one of them, and larger along the line of sight than across.
    centres, sizes = (np.array(rows[f"/walk/map/robot/ellipsoids:{what}"][-1][1]) for what in
                      ("centers", "half_sizes"))  # fmt: skip
    nearest = np.linalg.norm(centres[:, None] - seen, axis=2).min(axis=1)
    assert len(centres) == len(sizes) > 10 and nearest.max() < 1e-5
    assert ((sizes > 0.0) & (sizes <= 3.0)).all()
    assert (sizes.max(axis=1) > 2.0 * sizes.min(axis=1)).mean() > 0.5
    # The camera, where the robot has it.
    intrinsics = np.array(rows["/walk/map/robot/camera:image_from_camera"][0][1]).reshape(3, 3).T
    assert intrinsics[0] == pytest.approx([277.0, 0.0, 159.5]) and intrinsics[1, 2] == pytest.approx(119.5)
    assert rows["/walk/map/robot/camera:translation"][0][1][0][2] == pytest.approx(0.3)
    assert "mission: carried" in rows["/walk/now:text"][-1][1][0]


@pytest.mark.slow
def test_ellipsoids_have_the_covariance_and_the_floor_lies_where_it_was_seen():
    from rerun.components import Colormap

    from mapweave.processes.rerun_log import _ellipsoids, _floor

    rng = np.random.default_rng(3)
    roots = rng.normal(0, 0.2, (6, 3, 3))
    covariances = roots @ np.swapaxes(roots, 1, 2)
    covariances[4] *= 1e4  # too large to be drawn
    covariances[5] = np.inf
    drawn = _ellipsoids(rng.normal(0, 1, (6, 3)), covariances)
    axes = Rotation.from_quat(drawn.quaternions.as_arrow_array().to_pylist()).as_matrix()
    sizes = np.array(drawn.half_sizes.as_arrow_array().to_pylist())
    again = np.einsum("nij,nj,nkj->nik", axes, (sizes / 2.0) ** 2, axes)
    assert again == pytest.approx(covariances[:4], rel=1e-3, abs=1e-6)

    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, 0.3)
    grid = OccupancyGrid(RobotDescription(camera, ranger_bearings=(0.0,), ranger_reach=2.0))
    for _ in range(3):
        grid.see(Pose2(1.02, 2.02, np.pi / 2), np.array([0.8]))  # looks along y
    map_ = _floor(grid.taken())
    side = map_.cell_size.as_arrow_array().to_pylist()[0]
    x, y, _ = map_.translation.as_arrow_array().to_pylist()[0]
    form = map_.format.as_arrow_array().to_pylist()[0]
    image = np.array(map_.data.as_arrow_array().to_pylist()[0], np.uint8).reshape(
        form["height"], form["width"]
    )
    rows, columns = np.nonzero(image == OCCUPIED)
    places = np.column_stack([x + (columns + 0.5) * side, y + (len(image) - rows - 0.5) * side])
    reach = 0.8 + RobotDescription(camera).radius
    assert len(places) and np.abs(places - [1.02, 2.02 + reach]).max() < side
    middle = image[len(image) - 1 - int((2.4 - y) / side), int((1.02 - x) / side)]
    assert middle == FREE
    # Without a colormap the viewer draws greys as costs: all floor was one orange sheet.
    assert map_.colormap is not None
    assert map_.colormap.as_arrow_array().to_pylist() == [Colormap.RvizMap.value]


def test_the_loop_never_waits_for_the_log(tmp_path, monkeypatch):
    """A disk that stands still costs ticks of the log, and no time of the robot."""
    from mapweave.processes.rerun_log import RerunLog
    from mapweave.processes.tick_log import QUEUED

    goes_on = threading.Event()
    monkeypatch.setattr(RerunLog, "_write_words", lambda self, moment: goes_on.wait(60.0))
    pipeline = Pipeline(MapId("r0", 1), RobotDescription(Camera(64, 48, 60.0, 60.0, 32.0, 24.0, 0.3)))
    log = RerunLog(str(tmp_path / "r0.rrd"), "r0")
    began = time.monotonic()
    for k in range(QUEUED + 40):
        observation = Observation(k * 10**8, Odometry(0.0, 0.0), np.zeros((48, 64), np.uint8))
        log.step(observation, pipeline.step(observation), pipeline)
    assert time.monotonic() - began < 30.0, "it would have waited for a minute"
    goes_on.set()
    assert "ticks, since writing was too slow" in log.close()
    assert 39 <= log.left_out <= 40
    assert len(rows_of(tmp_path / "r0.rrd")["/r0/tracked:scalars"]) == QUEUED + 40 - log.left_out


def test_what_is_no_place_for_a_log_is_refused(drive: Path, tmp_path, capfd):
    from mapweave.processes.rerun_log import RerunLog

    output = complaint(capfd, "replay", drive, "--offline", "--data", tmp_path, "--rerun", tmp_path / "x.txt")
    assert "give a file that ends with .rrd, or connect" in output
    with pytest.raises(SettingsError, match="cannot be written"):
        RerunLog(str(drive / "camera.toml" / "x.rrd"), "r0")
    for address in (f"rerun+http://127.0.0.1:{free_port()}/proxy", "rerun+http://127.0.0.1:99999999/proxy"):
        with pytest.raises(NotConnected, match=r"no Rerun viewer at .*: start it with `rerun`"):
            RerunLog(address, "r0")


def test_while_navigating_it_shows_the_landmarks_of_the_node_where_the_image_has_them():
    from mapweave.processes.tick_log import tracked_of

    walls, start = PhotoWalls(), Pose2(0.25, -0.1, 0.08)
    node = walls.mapped(Mapper(MapId("r0", 1), DESCRIPTION))
    localizer = located(walls, DESCRIPTION, node, start)
    camera = DESCRIPTION.camera
    pipeline: Any = SimpleNamespace(lens=Lens(camera, DESCRIPTION.distortion), fix=Fix.of(localizer))
    tracks, bearings, points, covariances = tracked_of(pipeline)
    assert len(tracks) == len(points) > 10 and bearings == pytest.approx(camera.bearings(localizer.pixels))
    order = [np.argsort(ids) for ids in (localizer.visible, localizer.landmarks.ids)]
    off = camera.project(points[order[1]]) - localizer.pixels[order[0]]
    assert np.median(np.linalg.norm(off, axis=1)) < 2.0
    # The same ellipsoids, turned with the robot: their longest axes point away from its camera.
    _, axes = np.linalg.eigh(covariances)
    rays = points - [camera.mount_forward, 0.0, camera.mount_height]
    along = np.abs(np.einsum("ni,ni->n", axes[:, :, 2], rays)) / np.linalg.norm(rays, axis=1)
    assert np.median(along) > 0.95
