"""The same drive in every format gives the same observations."""

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapweave.agent.drivers.replay import Replay
from mapweave.agent.recordings.camera_file import read_camera
from mapweave.agent.recordings.incomplete import Incomplete, NoOdometry
from mapweave.agent.recordings.opening import open_recording
from mapweave.agent.recordings.options import RecordingOptions
from mapweave.agent.recordings.video import video_images
from mapweave.hybridmap.errors import DeviceError
from mapweave.vision.equidistant import Equidistant
from mapweave.vision.lens import NO_DISTORTION, Lens
from tests.agent.recordings.conftest import BEGUN_NS, COUNT, STEP_NS, Drive
from tests.recordings import camera_toml, write_video

KNOWN = COUNT - 1
"""The odometry ends before the last image."""


def kitti(drive: Drive, folder: Path) -> None:
    (folder / "image_0").mkdir()
    for k, image in enumerate(drive.images):
        cv2.imwrite(str(folder / "image_0" / f"{k:06d}.png"), image)
    (folder / "times.txt").write_text("".join(f"{(s - BEGUN_NS) / 1e9:e}\n" for s in drive.stamps_ns))
    c = drive.camera
    (folder / "calib.txt").write_text(f"P0: {c.fx} 0 {c.cx} 0 0 {c.fy} {c.cy} 0 0 0 1 0\nP1: 1 0 0\n")


def euroc(drive: Drive, folder: Path) -> None:
    cam = folder / "mav0" / "cam0"
    (cam / "data").mkdir(parents=True)
    rows = ["#timestamp [ns],filename"]
    for image, stamp in zip(drive.images, drive.stamps_ns, strict=True):
        cv2.imwrite(str(cam / "data" / f"{stamp}.png"), image)
        rows.append(f"{stamp},{stamp}.png")
    (cam / "data.csv").write_text("\r\n".join(rows) + "\r\n")
    c = drive.camera
    (cam / "sensor.yaml").write_text(
        "sensor_type: camera\nresolution: [320, 240]\n"
        f"intrinsics: [{c.fx}, {c.fy}, {c.cx}, {c.cy}]  #fu, fv, cu, cv\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [0.0, 0.0, 0.0, 0.0]\n"
    )


def tum_rgbd(drive: Drive, folder: Path) -> None:
    (folder / "rgb").mkdir()
    rows = ["# color images", "# timestamp filename"]
    for image, stamp in zip(drive.images, drive.stamps_ns, strict=True):
        name = f"{stamp // 10**9}.{stamp % 10**9 // 1000:06d}"
        cv2.imwrite(str(folder / "rgb" / f"{name}.png"), cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
        rows.append(f"{name} rgb/{name}.png")
    (folder / "rgb.txt").write_text("\n".join(rows) + "\n")
    (folder / "groundtruth.txt").write_text("is never read\n")


def four_seasons(drive: Drive, folder: Path) -> None:
    cam = folder / "undistorted_images" / "cam0"
    cam.mkdir(parents=True)
    rows = []
    for image, stamp in zip(drive.images, drive.stamps_ns, strict=True):
        cv2.imwrite(str(cam / f"{stamp}.png"), image)
        rows.append(f"{stamp} {stamp // 10**9}.{stamp % 10**9:09d} 8.5")
    (folder / "times.txt").write_text("\n".join(rows) + "\n")


def folder_with_poses(drive: Drive, folder: Path) -> None:
    (folder / "images").mkdir()
    for k, image in enumerate(drive.images):
        cv2.imwrite(str(folder / "images" / f"{k}.png"), image)
    (folder / "times.txt").write_text("".join(f"{s // 10**9}.{s % 10**9:09d}\n" for s in drive.stamps_ns))


CAMERA_TOML = camera_toml()


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    """A camera file."""
    path = tmp_path / "camera.toml"
    path.write_text(CAMERA_TOML)
    return path


def test_what_a_camera_file_lacks_is_named_with_what_to_do(tmp_path):
    """A robot's settings file was refused as a camera without a width, which it has in a table."""
    path = tmp_path / "robot.toml"
    path.write_text(f'[robot]\ndriver = "arduino"\n[robot.camera]\n{CAMERA_TOML}')
    with pytest.raises(DeviceError, match=r"'width' is missing: .* below \[robot.camera\] into a file"):
        read_camera(path)
    path.write_text(CAMERA_TOML.replace("height_m = 0.3\n", ""))
    with pytest.raises(DeviceError, match=r"'height_m' is missing; .* fx, fy, cx, cy \(px\) and height_m$"):
        read_camera(path)


@pytest.mark.parametrize(
    "write", [kitti, euroc, tum_rgbd, four_seasons, folder_with_poses], ids=lambda f: f.__name__
)
def test_a_drive_is_read_as_it_was(write, drive: Drive, poses_file: Path, camera: Path, tmp_path):
    folder = tmp_path / "sequence"
    folder.mkdir()
    write(drive, folder)
    if write is kitti:
        # Its times begin at 0.
        text = poses_file.read_text().splitlines()
        rows = [line.split(" ", 1) for line in text[1:]]
        poses_file.write_text("".join(f"{float(t) - BEGUN_NS / 1e9:.6f} {rest}\n" for t, rest in rows))
    replay = Replay(folder, options=RecordingOptions(camera=camera, odometry=poses_file))
    assert replay.describe().camera == drive.camera
    assert len(replay) == KNOWN
    assert any("1 of 9 images have no odometry" in note for note in replay.recording.notes)
    seen = list(iter(replay.sense, None))
    for k, observation in enumerate(seen):
        assert np.array_equal(observation.image, drive.images[k])
        assert observation.odometry.forward == pytest.approx(drive.increments[k, 0], abs=1e-5)
        assert observation.odometry.turn == pytest.approx(drive.increments[k, 1], abs=1e-5)
    gaps = np.diff([observation.stamp_ns for observation in seen])
    assert np.abs(gaps - STEP_NS).max() <= 1000


def test_kitti_and_euroc_say_what_camera_it_is_but_not_how_high(drive: Drive, poses_file: Path, tmp_path):
    euroc(drive, tmp_path)
    with pytest.raises(DeviceError, match="--camera-height"):
        open_recording(tmp_path, RecordingOptions(odometry=poses_file))
    recording = open_recording(tmp_path, RecordingOptions(odometry=poses_file, camera_height=0.3))
    assert recording.camera == drive.camera


def test_a_first_image_that_is_missing_is_left_out_as_any_other(drive: Drive, poses_file: Path, tmp_path):
    euroc(drive, tmp_path)
    data = tmp_path / "mav0" / "cam0" / "data"
    (data / f"{drive.stamps_ns[0]}.png").unlink()
    replay = Replay(tmp_path, options=RecordingOptions(odometry=poses_file, camera_height=0.3))
    assert replay.describe().camera == drive.camera
    assert len(list(iter(replay.sense, None))) == KNOWN - 1
    (line,) = replay.damage
    assert f"{drive.stamps_ns[0]}.png: no such file (left out, 1 of {KNOWN} images)" in line
    for image in data.iterdir():
        image.unlink()
    with pytest.raises(DeviceError, match=r"no such file$"):
        open_recording(tmp_path, RecordingOptions(odometry=poses_file, camera_height=0.3))


def test_an_excerpt_of_kitti_has_the_times_that_its_images_are_named_by(drive: Drive, tmp_path):
    """times.txt and calib.txt are of the whole sequence; images 3 to 6 are there."""
    kitti(drive, tmp_path)
    for k in {*range(COUNT)} - {3, 4, 5, 6}:
        (tmp_path / "image_0" / f"{k:06d}.png").unlink()
    with pytest.raises(NoOdometry, match="KITTI odometry, 4 images") as found:
        open_recording(tmp_path, RecordingOptions(camera_height=0.3))
    recording = found.value.recording
    assert np.abs(recording.stamps_ns - (np.array(drive.stamps_ns[3:7]) - BEGUN_NS)).max() <= 1000
    assert np.array_equal(recording.read(0), drive.images[3])
    for k in (3, 4, 5, 6):
        (tmp_path / "image_0" / f"{k:06d}.png").rename(tmp_path / "image_0" / f"left{k}.png")
    with pytest.raises(DeviceError, match=r"9 times for 4 images; .* the number of its line"):
        open_recording(tmp_path, RecordingOptions(camera_height=0.3))


@pytest.mark.parametrize(
    ("write", "calibration"), [(kitti, "calib.txt"), (euroc, "mav0/cam0/sensor.yaml")], ids=["kitti", "euroc"]
)
@pytest.mark.parametrize("text", [None, "intrinsics: [fx: 277.0]\nP0: 1\n"], ids=["missing", "another form"])
def test_the_calibration_of_others_is_not_needed_beside_a_camera_file(
    write, calibration: str, text: str | None, drive: Drive, poses_file: Path, camera: Path, tmp_path
):
    folder = tmp_path / "sequence"
    folder.mkdir()
    write(drive, folder)
    (folder / calibration).unlink()
    if text is not None:
        (folder / calibration).write_text(text)
    with pytest.raises(NoOdometry) as found:
        open_recording(folder, RecordingOptions(camera=camera))
    assert found.value.recording.camera == drive.camera
    with pytest.raises(DeviceError) as refused:
        open_recording(folder, RecordingOptions(camera_height=0.3))
    assert calibration.split("/")[-1] in str(refused.value) or "give --camera FILE" in str(refused.value)


def test_kitti_without_times_is_ten_images_a_second(drive: Drive, tmp_path):
    kitti(drive, tmp_path)
    (tmp_path / "times.txt").unlink()
    with pytest.raises(NoOdometry) as found:
        open_recording(tmp_path, RecordingOptions(camera_height=0.3))
    assert np.abs(np.diff(found.value.recording.stamps_ns) - 10**8).max() <= 1
    assert not found.value.recording.timed
    (tmp_path / "image_0").rename(tmp_path / "image_l")
    with pytest.raises(DeviceError, match="it needs image_0 or image_2"):
        open_recording(tmp_path)


def test_images_may_lie_in_the_folder_itself(drive: Drive, tmp_path):
    for k, image in enumerate(drive.images):
        cv2.imwrite(str(tmp_path / f"{k}.png"), image)
    with pytest.raises(Incomplete, match=r"no camera.toml; .* give --camera FILE"):
        open_recording(tmp_path)
    (tmp_path / "camera.toml").write_text(CAMERA_TOML)
    with pytest.raises(NoOdometry, match=f"folder of images, {COUNT} images") as found:
        open_recording(tmp_path)
    assert np.array_equal(found.value.recording.read(COUNT - 1), drive.images[-1])
    # What lies beside images/ is no image of the recording.
    (tmp_path / "images").mkdir()
    with pytest.raises(DeviceError, match=r"images: no images there"):
        open_recording(tmp_path)


def test_a_fisheye_of_euroc_becomes_an_ideal_camera(drive: Drive, poses_file: Path, tmp_path):
    euroc(drive, tmp_path)
    sensor = tmp_path / "mav0" / "cam0" / "sensor.yaml"
    text = sensor.read_text().replace("radial-tangential", "equidistant")
    sensor.write_text(text.replace("[0.0, 0.0, 0.0, 0.0]", "[-0.02, 0.004, -0.003, 0.0005]"))
    options = RecordingOptions(odometry=poses_file, camera_height=0.3)
    recording = open_recording(tmp_path, options)
    c = drive.camera
    lens = Equidistant(c.fx, c.fy, c.cx, c.cy, (-0.02, 0.004, -0.003, 0.0005))
    ideal = lens.ideal(320, 240, 0.3)
    assert (recording.camera, recording.distortion) == (ideal, NO_DISTORTION)
    assert np.array_equal(recording.read(0), Lens(ideal, lens).rectified(drive.images[0]))
    assert any("rectified to" in note for note in recording.notes)
    # Kalibr's camera.toml by hand gives the same.
    camera = tmp_path / "own" / "camera.toml"
    camera.parent.mkdir()
    camera.write_text(CAMERA_TOML + 'lens = "equidistant"\ndistortion = [-0.02, 0.004, -0.003, 0.0005]\n')
    assert read_camera(camera) == (ideal, lens)
    sensor.write_text(text.replace("[0.0, 0.0, 0.0, 0.0]", "[-0.9, 0.0, 0.0, 0.0]"))
    with pytest.raises(DeviceError, match=r"sensor.yaml: camera: an equidistant lens .* folds"):
        open_recording(tmp_path, options)
    sensor.write_text(text.replace("equidistant", "omni"))
    with pytest.raises(DeviceError, match="lens model omni is not supported; radial-tangential and equid"):
        open_recording(tmp_path, options)


def test_odometry_that_is_slower_than_the_images_is_named(drive: Drive, poses_file: Path, tmp_path):
    """Poses 3 s apart on a curve were taken for odometry of another clock, without a word of them."""
    euroc(drive, tmp_path)
    options = RecordingOptions(odometry=poses_file, camera_height=0.3)
    assert not any("straight" in note for note in open_recording(tmp_path, options).notes)
    head, *rows = poses_file.read_text().splitlines(keepends=True)
    poses_file.write_text(head + "".join(rows[::12]))
    image, pose = STEP_NS * 1e-9, 3 * STEP_NS * 1e-9
    line = f"odometry has a pose every {pose:.2g} s, images come every {image:.2g} s: straight ways between"
    assert line in open_recording(tmp_path, options).notes


def test_lists_of_sensor_yaml_may_have_a_line_each(drive: Drive, poses_file: Path, tmp_path):
    euroc(drive, tmp_path)
    sensor, options = (
        tmp_path / "mav0" / "cam0" / "sensor.yaml",
        RecordingOptions(odometry=poses_file, camera_height=0.3),
    )
    brackets = open_recording(tmp_path, options)
    c = drive.camera
    sensor.write_text(
        f"intrinsics:\n- {c.fx}\n- {c.fy}\n- {c.cx}\n- {c.cy}\ndistortion_model: radial-tangential\n"
        "distortion_coefficients:\n  - 0.0\n  - -1.0e-9\n  - 0.0\n  - 0.0\nresolution:\n- 320\n- 240\n"
    )
    lines = open_recording(tmp_path, options)
    assert lines.camera == brackets.camera
    assert lines.distortion == (0.0, -1e-9, 0.0, 0.0, 0.0)


def test_a_table_of_other_columns_names_both_kinds_that_are_read(drive: Drive, tmp_path):
    folder_with_poses(drive, tmp_path)
    (tmp_path / "odometry.csv").write_text("timestamp,x,y,theta\n0.0,0.0,0.0,0.0\n")
    with pytest.raises(
        DeviceError, match="must have forward_m, turn_rad, or as poses stamp_s, x_m, y_m, head"
    ):
        open_recording(tmp_path)


def test_without_odometry_nothing_is_guessed(drive: Drive, tmp_path):
    euroc(drive, tmp_path)
    with pytest.raises(DeviceError, match="EuRoC, 9 images, but no odometry: give --odometry FILE"):
        open_recording(tmp_path, RecordingOptions(camera_height=0.3))


def test_a_video_is_read_frame_by_frame_and_again_from_the_start(drive: Drive, camera: Path, tmp_path):
    path = write_video(tmp_path / "walk.avi", drive.images, 5.0)
    assert video_images(path).damage == ""
    with pytest.raises(DeviceError, match="video, 9 images, but no odometry"):
        open_recording(path, RecordingOptions(camera=camera))
    rows = [f"{0.2 * k},{p.x!r},{p.y!r},{p.heading!r}" for k, p in enumerate(drive.poses)]
    path.with_suffix(".csv").write_text("\n".join(["stamp_s,x_m,y_m,heading_rad", *rows]) + "\n")
    recording = open_recording(path, RecordingOptions(camera=camera))
    assert np.abs(recording.increments - drive.increments).max() < 1e-9
    for k in (0, 3, 8, 2):
        error = np.abs(recording.read(k).astype(int) - drive.images[k])
        assert error.mean() < 3.0, "not the same frame"


@pytest.mark.parametrize(("name", "codec", "share", "says"), [
    ("walk.avi", "MJPG", 0.999, "the file ends before its index"),
    ("walk.avi", "MJPG", 0.3, "the file ends before its index"),
    ("walk.mkv", "mp4v", 0.6, "its header says 9.0 s"),
    ("walk.webm", "VP80", 1.0, ""),
])  # fmt: skip
def test_a_video_that_was_cut_off_says_so(
    name: str, codec: str, share: float, says: str, drive: Drive, camera: Path, tmp_path
):
    path = write_video(tmp_path / name, drive.images, 1.0, codec)
    path.write_bytes(path.read_bytes()[: round(share * path.stat().st_size)])
    with pytest.raises(NoOdometry) as caught:
        open_recording(path, RecordingOptions(camera=camera))
    recording = caught.value.recording
    assert recording.damage == (
        (f"{path}: cut off after {len(recording)} frames, {len(recording) - 1:.1f} s: {says}",)
        if says
        else ()
    )


def test_a_video_in_no_container_says_that_its_times_are_assumed(drive: Drive, camera: Path, tmp_path):
    """As a camera of a Raspberry Pi is recorded; such files were refused."""
    path = tmp_path / "walk.mjpeg"
    path.write_bytes(b"".join(cv2.imencode(".jpg", image)[1].tobytes() for image in drive.images))
    with pytest.raises(NoOdometry) as caught:
        open_recording(path, RecordingOptions(camera=camera))
    recording = caught.value.recording
    assert len(recording) == COUNT and not recording.timed and not recording.damage
    assert "25 images a second are assumed" in recording.notes[0]


def test_a_transport_stream_is_a_video(drive: Drive, camera: Path, tmp_path):
    path = write_video(tmp_path / "walk.ts", drive.images, 5.0, "mp4v")
    with pytest.raises(NoOdometry) as caught:
        open_recording(path, RecordingOptions(camera=camera))
    recording = caught.value.recording
    assert recording.timed and not recording.damage and np.diff(recording.stamps_ns).tolist() == [STEP_NS] * 8


def test_a_video_that_ends_within_its_header_is_one_line(drive: Drive, tmp_path, capfd):
    """A second reader of OpenCV, which reads no more of it, added a line of its own."""
    path = write_video(tmp_path / "walk.avi", drive.images, 1.0)
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(DeviceError, match="no video that can be read"):
        video_images(path)
    # Commands silence OpenCV's log, which is no part of that line.
    assert "Unexpected element" not in capfd.readouterr().err


def test_an_avi_whose_last_frames_cannot_be_read_says_how_long_it_should_be(drive: Drive, tmp_path):
    """As a card's bad sectors leave it: as long as it was, with an index."""
    path = write_video(tmp_path / "walk.avi", drive.images, 1.0)
    data, half = path.read_bytes(), path.stat().st_size // 2
    path.write_bytes(data[:half] + bytes(len(data) - half))
    images = video_images(path)
    assert len(images.stamps_ns) < COUNT
    assert images.damage.endswith(
        f"cut off after {len(images.stamps_ns)} frames, "
        f"{len(images.stamps_ns) - 1:.1f} s: its header says 9.0 s"
    )


def test_a_camera_that_stops_is_named(drive: Drive, poses_file: Path, camera: Path, tmp_path):
    """The wheels go on for seven seconds. The map is of what was seen."""
    folder = tmp_path / "sequence"
    folder.mkdir()
    tum_rgbd(drive, folder)
    last = poses_file.read_text().splitlines()[-1].split(" ", 1)
    at = drive.stamps_ns[-1] / 1e9 + 7.0
    poses_file.write_text(poses_file.read_text() + f"{at:.9f} {last[1]}\n")
    recording = open_recording(folder, RecordingOptions(camera=camera, odometry=poses_file))
    assert len(recording) == COUNT
    assert recording.notes == ("the camera is silent for 7.0 s, 1.6 s after its first image",)


def test_odometry_that_begins_again_at_zero_goes_on(drive: Drive, tmp_path):
    """A base that is started again counts from zero: the way back was taken for driven, and tore the map."""
    folder_with_poses(drive, tmp_path)
    (tmp_path / "camera.toml").write_text(CAMERA_TOML)
    again = [*drive.poses[:5], *(drive.poses[5].inverse() @ pose for pose in drive.poses[5:])]
    rows = zip(drive.stamps_ns, again, strict=True)
    (tmp_path / "odometry.csv").write_text(
        "stamp_s,x_m,y_m,heading_rad\n"
        + "".join(f"{s // 10**9}.{s % 10**9:09d},{p.x!r},{p.y!r},{p.heading!r}\n" for s, p in rows)
    )
    recording = open_recording(tmp_path)
    assert "set back to zero once, first 1.0 s after its first pose" in " ".join(recording.notes)
    assert recording.increments[5] == pytest.approx((0.0, 0.0))
    others = [k for k in range(COUNT) if k != 5]
    assert recording.increments[others] == pytest.approx(drive.increments[others], abs=1e-6)


@pytest.mark.parametrize(("scale", "way", "words"), [
    (1e3, 0.02, "every 100 s: times must be in seconds"), (1.0, 0.02, ""), (1e3, 2.0, ""), (1e3, 0.0, ""),
])  # fmt: skip
def test_times_in_milliseconds_are_named(scale: float, way: float, words: str, drive: Drive, tmp_path):
    folder_with_poses(drive, tmp_path)
    (tmp_path / "camera.toml").write_text(CAMERA_TOML)
    (tmp_path / "times.txt").write_text("".join(f"{scale * 0.1 * k:g}\n" for k in range(COUNT)))
    (tmp_path / "odometry.csv").write_text("forward_m,turn_rad\n" + f"{way:g},0\n" * COUNT)
    notes = " ".join(open_recording(tmp_path).notes)
    assert words in notes and bool(notes) is bool(words)


def test_odometry_of_another_clock_is_refused(drive: Drive, poses_file: Path, tmp_path):
    kitti(drive, tmp_path)
    with pytest.raises(DeviceError, match="do not overlap: they must be of one clock"):
        open_recording(tmp_path, RecordingOptions(odometry=poses_file, camera_height=1.65))


@pytest.mark.parametrize(("text", "words"), [
    ("1 2 3\n", "line 1: a pose is `stamp x y z qx qy qz qw`"),
    ("", "0 poses; there must be two or more"),
    ("1 0 0 0 0 0 0 1\n2 nan 0 0 0 0 0 1\n", "line 2: all numbers must be finite"),
    ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 0\n", "line 2: a quaternion of zeros is none"),
    ("1 0 0 0 0 0 0 1\n1e10 0 0 0 0 0 0 1\n", "times are seconds since 1970 or since the start"),
    ("# only a comment\n1 0 0 0 0 0 0 1\n", "1 poses"),
])  # fmt: skip
def test_wrong_poses_are_refused_in_one_line(text: str, words: str, drive: Drive, tmp_path):
    kitti(drive, tmp_path)
    (tmp_path / "odometry.txt").write_text(text)
    with pytest.raises(DeviceError) as error:
        open_recording(tmp_path, RecordingOptions(camera_height=1.65))
    assert words in str(error.value) and "\n" not in str(error.value)


def test_poses_that_go_back_in_time_are_sorted_and_said(
    drive: Drive, poses_file: Path, camera: Path, tmp_path
):
    folder = tmp_path / "sequence"
    folder.mkdir()
    tum_rgbd(drive, folder)
    options = RecordingOptions(camera=camera, odometry=poses_file)
    before = open_recording(folder, options)
    comment, *lines = poses_file.read_text().splitlines()
    lines[4:6] = lines[5], lines[4], lines[4]
    poses_file.write_text("\n".join([comment, *lines]) + "\n")
    after = open_recording(folder, options)
    assert np.array_equal(after.increments, before.increments)
    assert after.notes == (
        f"{poses_file}: stamps go back once, first at pose 5: sorted by time",
        f"{poses_file}: 1 poses have the stamp of another one: left out",
        *before.notes,
    )


@pytest.mark.parametrize("name", ["odometry.txt", "odometry.csv"])
def test_poses_that_a_disk_has_damaged_are_used_up_to_there(name: str, drive: Drive, camera: Path, tmp_path):
    """As a loss of power leaves them: the last block is zero, or another file's."""
    folder = tmp_path / "sequence"
    folder.mkdir()
    tum_rgbd(drive, folder)
    rows = [(stamp / 1e9, 0.1 * k) for k, stamp in enumerate(drive.stamps_ns)]
    lines = [f"{at:.3f} {x} 0 0 0 0 0 1" for at, x in rows]
    if name.endswith("csv"):
        lines = ["stamp_s,x_m,y_m,heading_rad", *(f"{at:.3f},{x},0,0" for at, x in rows)]
    whole = "\n".join(lines[:6]) + "\n"
    for rest in (bytes(512), b"17\xff\xfe" * 99):
        (tmp_path / name).write_bytes(whole.encode() + rest)
        recording = open_recording(folder, RecordingOptions(camera=camera, odometry=tmp_path / name))
        assert len(recording) in (5, 6)
        words = f"{tmp_path / name}: line 7: is no text; the poses before it are used"
        assert recording.damage == (words,)


@pytest.mark.parametrize("height", [1650.0, -0.1, float("nan")])
def test_a_height_in_another_unit_is_refused(height: float, drive: Drive, tmp_path):
    euroc(drive, tmp_path)
    with pytest.raises(
        DeviceError, match=r"^--camera-height: camera: height_m is .*; it is in metres, from 0"
    ):
        open_recording(tmp_path, RecordingOptions(camera_height=height))


@pytest.mark.parametrize("name", ["notes.txt", "walk.mp4", "walk.mcap", "walk.bag", "walk.db3"])
def test_what_is_no_recording_is_refused_in_one_line(name: str, tmp_path):
    path = tmp_path / name
    path.write_bytes(struct.pack("<8I", *range(8)))
    with pytest.raises(DeviceError) as error:
        open_recording(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["a.mp4", "a.avi", "a.bag", "a.mcap", "a.db3", "a.txt"])
def test_an_empty_file_is_named_as_such(name: str, tmp_path):
    """Of a copy that has failed it was said that the index of an MP4 is lost, or how a bag begins."""
    path = tmp_path / name
    path.touch()
    with pytest.raises(DeviceError) as refusal:
        open_recording(path)
    assert str(refusal.value) == f"{path}: the file is empty"


def test_files_of_an_editor_of_windows(drive: Drive, tmp_path):
    """Such editors begin a file with an invisible mark, and end lines with CR LF."""
    folder = tmp_path / "drive"
    folder.mkdir()
    folder_with_poses(drive, folder)
    (folder / "camera.toml").write_text(CAMERA_TOML)
    rows = [f"{stamp / 1e9:.3f},{0.1 * k},0,0\n" for k, stamp in enumerate(drive.stamps_ns)]
    (folder / "odometry.csv").write_text("stamp_s,x_m,y_m,heading_rad\n" + "".join(rows))
    before = open_recording(folder)
    files = [path for path in folder.iterdir() if path.is_file()]
    assert {"camera.toml", "odometry.csv", "times.txt"} <= {path.name for path in files}
    for path in files:
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    after = open_recording(folder)
    assert after.camera == before.camera
    assert np.array_equal(after.stamps_ns, before.stamps_ns)
    assert np.array_equal(after.increments, before.increments)
    (folder / "odometry.csv").write_bytes(
        b"\xef\xbb\xbfforward_m,turn_rad\r\n" + b"0.1,0.0\r\n" * len(drive.images)
    )
    assert open_recording(folder).increments[1] == pytest.approx([0.1, 0.0])


def test_files_of_macos_beside_the_images_are_none(drive: Drive, tmp_path):
    """Each was taken for an image, and each second image was left out."""
    folder_with_poses(drive, tmp_path)
    for path in list((tmp_path / "images").iterdir()):
        (tmp_path / "images" / f"._{path.name}").write_bytes(b"\0\5\x16\7")
    (tmp_path / "camera.toml").write_text(CAMERA_TOML)
    (tmp_path / "odometry.csv").write_text("forward_m,turn_rad\n" + "0.1,0.0\n" * len(drive.images))
    replay = Replay(tmp_path)
    assert len(replay) == len(drive.images) and replay.damage == []


def test_a_folder_around_or_in_a_recording_names_it(drive: Drive, tmp_path):
    """Archives of benchmarks unpack to several levels: there was only a list of all formats."""
    third, hall, images = tmp_path / "k/sequences/03", tmp_path / "e/MH_01", tmp_path / "i/data"
    for place in (third, hall, images):
        place.mkdir(parents=True)
    kitti(drive, third)
    euroc(drive, hall)
    cv2.imwrite(str(images / "0.png"), drive.images[0])
    (tmp_path / "camera.toml").touch()
    for given, named in (
        (tmp_path / "k", third),
        (tmp_path / "e", hall),
        (tmp_path / "i", images),
        (hall / "mav0", hall),
        (hall / "mav0/cam0", hall / "mav0/cam0/data"),
    ):
        with pytest.raises(DeviceError, match=f"{given}: not a recording, but {named} is; one is"):
            open_recording(given)


def test_a_bag_that_is_packed_as_a_whole_says_what_to_give(tmp_path):
    path = tmp_path / "walk_0.db3.zstd"
    path.write_bytes(b"(\xb5/\xfd")
    with pytest.raises(DeviceError, match=r"give its folder with metadata.yaml, or unpack it with `unzstd`"):
        open_recording(path)


def test_a_sequence_of_euroc_without_calibration_asks_for_the_camera(drive: Drive, tmp_path):
    """As TUM VI is published. Nothing was said of what is in it, nor of --camera."""
    euroc(drive, tmp_path)
    (tmp_path / "mav0/cam0/sensor.yaml").unlink()
    with pytest.raises(Incomplete, match="--camera FILE") as caught:
        open_recording(tmp_path)
    assert caught.value.recording is not None and len(caught.value.recording) == COUNT


@pytest.mark.parametrize("folder", ["s/Calibration", "calibration"])
def test_the_calibration_of_4seasons_is_found(folder: str, drive: Drive, poses_file: Path, tmp_path):
    """It is an archive of its own: within the sequence (benchmark for relocalization), else beside it."""
    (sequence := tmp_path / "s").mkdir()
    four_seasons(drive, sequence)
    file = tmp_path / folder / "undistorted_calib_0.txt"
    file.parent.mkdir()
    c = drive.camera
    file.write_text(
        f"Pinhole {c.fx} {c.fy} {c.cx} {c.cy} 0\n{c.width} {c.height}\ncrop\n{c.width} {c.height}\n"
    )
    recording = open_recording(sequence, RecordingOptions(camera_height=c.mount_height, odometry=poses_file))
    camera = recording.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (c.fx, c.fy, c.cx, c.cy)
    assert recording.distortion == NO_DISTORTION
    file.write_text("EquiDistant 1 2 3 4 5 6 7 8\n")
    with pytest.raises(DeviceError, match=r"must be `Pinhole fx fy cx cy 0`; else give --camera FILE"):
        open_recording(sequence, RecordingOptions(camera_height=0.3, odometry=poses_file))


@pytest.mark.parametrize("name", ["radtan", "radialtangential", "plumb_bob"])
def test_a_lens_model_has_other_names_in_other_tools(name: str, drive: Drive, poses_file: Path, tmp_path):
    """Those of Kalibr, OKVIS and ROS, in a sensor.yaml that was made with them."""
    euroc(drive, tmp_path)
    file = tmp_path / "mav0/cam0/sensor.yaml"
    text = (
        file.read_text().replace("radial-tangential", name).replace("[0.0, 0.0, 0.0, 0.0]", "[0.1, 0, 0, 0]")
    )
    file.write_text(text)
    options = RecordingOptions(camera_height=0.3, odometry=poses_file)
    assert open_recording(tmp_path, options).distortion == (0.1, 0.0, 0.0, 0.0, 0.0)
