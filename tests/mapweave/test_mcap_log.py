"""What a replay writes for Foxglove, read back by the definitions that the file itself has."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from mapweave import Camera, HybridMap, MapId, Pose2, read_camera, read_map_file
from mapweave.agent.observation import Observation, Odometry, RobotDescription
from mapweave.agent.occupancy_grid import FREE, OCCUPIED, OccupancyGrid
from mapweave.agent.pipeline import Pipeline
from mapweave.agent.settings import AgentSettings
from mapweave.cli import main, parser
from mapweave.hybridmap.errors import SettingsError
from mapweave.processes.markers import SPHERE, landmark_markers
from mapweave.processes.mcap_log import McapLog, _floor
from mapweave.processes.tick_log import ellipsoids
from mapweave.scenarios.fleet import TrialStage
from mapweave.scenarios.process_fleet import ProcessFleet
from mapweave.scenarios.scenario import load_scenario, scenario_path
from tests.mapweave.command_line import complaint
from tests.mapweave.log_readers import read
from tests.mapweave.wall_drive import COUNT, STEP, wall_drive


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return wall_drive(tmp_path_factory.mktemp("drive") / "walk")


@pytest.mark.slow
def test_a_replay_is_read_back_as_it_was(drive: Path, tmp_path, capfd, signals: None):
    out = tmp_path / "logs" / "walk"
    words = ["--offline", "--data", str(tmp_path), "--epoch", "1", "--mcap-log", str(out)]
    assert main(["replay", str(drive), *words]) == 0
    assert "not in the MCAP log" not in capfd.readouterr().err
    assert [path.name for path in sorted(out.iterdir())] == ["metadata.yaml", "walk.mcap"]
    said = read(out)
    stamps = [stamp for stamp, _ in said["/status"]]
    assert len(stamps) == COUNT and len(set(np.diff(stamps))) == 1
    for topic in (
        "/camera/image/compressed", "/camera/tracks", "/camera/camera_info", "/landmarks", "/cmd_vel",
    ):  # fmt: skip
        assert [stamp for stamp, _ in said[topic]] == stamps, topic
    # The image, but for what JPEG loses; the tracks are in it.
    for k in (0, COUNT - 1):
        image = cv2.imdecode(said["/camera/image/compressed"][k][1].data, cv2.IMREAD_GRAYSCALE)
        truth = cv2.imread(str(drive / "images" / f"{k}.png"), cv2.IMREAD_GRAYSCALE)
        assert np.abs(image.astype(int) - truth).mean() < 5.0
        (points,) = said["/camera/tracks"][k][1].points
        inside = np.array([(point.x, point.y) for point in points.points])
        assert points.type == points.POINTS and ((inside >= 0) & (inside <= [320, 240])).all()
    assert len(inside) > 20
    # The robot, as the replay's trajectory file has it, on tf and as a pose.
    poses = np.loadtxt(tmp_path / "walk.1.tum")
    moved = [message.transforms[0].transform.translation for _, message in said["/tf"]]
    assert np.array([(at.x, at.y) for at in moved])[-len(poses) :] == pytest.approx(poses[:, 1:3], abs=1e-5)
    pose = said["/pose"][-1][1]
    assert pose.header.frame_id == "map" and pose.pose.pose.position.x == pytest.approx(moved[-1].x)
    way = [one.pose.position.x for one in said["/path"][-1][1].poses]
    assert way == sorted(way) and way[-1] == pytest.approx(STEP * (COUNT - 1), abs=0.05)
    (mount,) = said["/tf_static"][0][1].transforms
    assert (mount.header.frame_id, mount.child_frame_id) == ("base_footprint", "camera_optical_frame")
    turn = mount.transform.rotation
    forward = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).apply([0, 0, 1])
    assert forward == pytest.approx([1, 0, 0]) and mount.transform.translation.z == pytest.approx(0.3)
    # Its map, as the map file has it.
    whole = HybridMap(read_map_file(tmp_path / "walk.1.mapweave").changes)
    nodes, *edges = said["/map"][-1][1].markers
    places = sorted((node.map_from_robot.mean.x, node.map_from_robot.mean.y) for node in whole.nodes.values())
    assert np.array(sorted((point.x, point.y) for point in nodes.points)) == pytest.approx(np.array(places))
    assert sum(len(marker.points) for marker in edges) == 2 * len(whole.edges)
    # The bearings stay within what the camera sees.
    limit = np.degrees(read_camera(drive / "camera.toml")[0].semi_aperture)
    right, left = (
        np.array([message.data for _, message in said[f"/bearings/outermost_{side}"]])
        for side in ("right", "left")
    )
    limits = [message.data for _, message in said["/bearings/limit_right"]]
    assert limits == pytest.approx([-limit] * COUNT)
    assert (right < left).all() and left.max() <= limit + 0.2 and right.min() >= -limit - 0.2
    # Landmarks, in place of those before: on the walls, which are ahead of the robot.
    clear, dots, *shapes = said["/landmarks"][-1][1].markers
    seen = np.array([(point.x, point.y, point.z) for point in dots.points])
    assert clear.action == clear.DELETEALL and len(seen) > 10 and (seen[:, 0] > 0.1).all()
    assert len(shapes) > 10
    assert {(shape.type, shape.header.frame_id) for shape in shapes} == {(SPHERE, "base_footprint")}
    assert said["/status"][-1][1].data.startswith("carried")


def test_ellipsoids_have_the_covariance():
    rng = np.random.default_rng(3)
    roots, points = rng.normal(0, 0.2, (5, 3, 3)), rng.normal(0, 1, (5, 3))
    covariances = roots @ np.swapaxes(roots, 1, 2)
    covariances[4] = np.inf
    array = landmark_markers(0, "base_footprint", points, ellipsoids(points, covariances))
    drawn = [marker for marker in array.markers if marker.type == SPHERE]
    assert len(drawn) == 4
    for marker, point, covariance in zip(drawn, points, covariances, strict=False):
        q, at, size = marker.pose.orientation, marker.pose.position, marker.scale
        axes = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
        # The scale is the whole axis, and two sigmas are half of it.
        sigmas = np.array([size.x, size.y, size.z]) / 4.0
        assert axes @ np.diag(sigmas**2) @ axes.T == pytest.approx(covariance, rel=1e-3, abs=1e-6)
        assert [at.x, at.y, at.z] == pytest.approx(point.tolist())


def test_the_floor_lies_where_it_was_seen():
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, 0.3)
    robot = RobotDescription(camera, ranger_bearings=(0.0,), ranger_reach=2.0)
    grid = OccupancyGrid(robot)
    for _ in range(3):
        grid.see(Pose2(1.02, 2.02, np.pi / 2), np.array([0.8]))  # looks along y
    floor = _floor(grid.taken(), 0)
    cells = floor.data.reshape(floor.info.height, floor.info.width)
    rows, columns = np.nonzero(cells == OCCUPIED)
    at, side = floor.info.origin.position, floor.info.resolution
    places = np.column_stack([at.x + (columns + 0.5) * side, at.y + (rows + 0.5) * side])
    assert len(places) and np.abs(places - [1.02, 2.02 + 0.8 + robot.radius]).max() < side
    assert cells[int((2.4 - at.y) / side), int((1.02 - at.x) / side)] == FREE


def test_what_repeats_itself_takes_little_room(tmp_path):
    """Each floor is 230 kB, nearly all of it unknown."""
    log = McapLog(str(tmp_path / "log"))
    pipeline = Pipeline(MapId("r0", 1), RobotDescription(Camera(64, 48, 60.0, 60.0, 32.0, 24.0, 0.3)))
    for k in range(30):
        observation = Observation(k * 10**8, Odometry(0.0, 0.0), np.zeros((48, 64), np.uint8))
        log.step(observation, pipeline.step(observation), pipeline)
    assert not log.close()
    with AnyReader([tmp_path / "log"]) as reader:
        messages = sum(len(data) for _, _, data in reader.messages())
    assert messages > 3 * 230_000
    assert (tmp_path / "log" / "log.mcap").stat().st_size < messages / 5


def test_a_full_disk_ends_the_log_and_not_the_robot(tmp_path, monkeypatch):
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    log = McapLog(str(tmp_path / "log"))
    monkeypatch.setattr(log._topics, "send", full)
    pipeline = Pipeline(MapId("r0", 1), RobotDescription(Camera(64, 48, 60.0, 60.0, 32.0, 24.0, 0.3)))
    for k in range(3):
        observation = Observation(k * 10**8, Odometry(0.0, 0.0), np.zeros((48, 64), np.uint8))
        log.step(observation, pipeline.step(observation), pipeline)
    assert "No space left on device" in log.close()


def test_what_is_no_place_for_a_log_is_refused(drive: Path, tmp_path, capfd):
    output = complaint(capfd, "replay", drive, "--offline", "--data", tmp_path, "--mcap-log", drive)
    assert "--mcap-log" in output and "not empty" in output
    with pytest.raises(SettingsError, match=r"--mcap-log .*camera\.toml"):
        McapLog(str(drive / "camera.toml" / "x"))


def test_agents_in_processes_of_their_own_are_given_folders_for_their_logs(tmp_path, monkeypatch):
    """As `mapweave sim run --mcap-log` starts them."""
    scenario = load_scenario(scenario_path("office"), ["robots=2"])
    fleet = ProcessFleet(TrialStage(scenario, 1, tmp_path, AgentSettings(), mcap_log=True))
    started: list[list[str]] = []
    monkeypatch.setattr(fleet._children, "start", lambda name, arguments: started.append(arguments))
    fleet._start_agent("r1")
    (tmp_path / "mcap" / "r1.1").mkdir(parents=True)
    fleet._start_agent("r1")
    fleet.end()
    for words, folder in zip(started, ("r1.1", "r1.2"), strict=True):
        arguments = parser().parse_args(words)
        assert (arguments.mcap_log, arguments.rerun) == (str(tmp_path / "mcap" / folder), None)
