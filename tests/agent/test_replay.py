"""Recordings: a small one is written here, then read right, or refused in one line."""

import csv
import math
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mapweave import Command, MapId, Odometry, Pose2, read_camera
from mapweave.agent.drivers.replay import Replay
from mapweave.agent.mission import Carried
from mapweave.agent.pipeline import Pipeline
from mapweave.agent.recordings.opening import open_recording
from mapweave.agent.recordings.options import RecordingOptions
from mapweave.hybridmap.errors import DeviceError

COUNT = 14
TURNS = [0.0, *(0.01 * math.sin(k) for k in range(1, COUNT))]
STEPS = [0.0, *(0.02 + 0.001 * k for k in range(1, COUNT))]
CAMERA = """\
width = 320
height = 240
fx = 277.0
fy = 277
cx = 159.5
cy = 119.5
height_m = 0.3
forward_m = 0.05
distortion = [-0.1, 0.02, 0.001, 0.0, 0.0]
"""
SPLITS = """\
[[robot]]
name = "a"
first = 0
last = 6

[[robot]]
name = "b"
first = 2
last = 13
step = 3
"""


@pytest.fixture(scope="module")
def original(walls, tmp_path_factory) -> Path:
    """A recording of a curve."""
    folder = tmp_path_factory.mktemp("recordings") / "walk"
    (folder / "images").mkdir(parents=True)
    pose = Pose2()
    with (folder / "odometry.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["frame", "turn_rad", "forward_m"])
        for k, (forward, turn) in enumerate(zip(STEPS, TURNS, strict=True)):
            pose = pose @ Odometry(forward, turn).motion()
            # Not zero-padded: 2 comes before 10.
            cv2.imwrite(str(folder / "images" / f"frame{k}.png"), walls.render(pose))
            rows.writerow([k, repr(turn), repr(forward)])
    (folder / "images" / "notes.txt").write_text("not an image")
    (folder / "camera.toml").write_text(CAMERA)
    (folder / "times.txt").write_text("\n".join(f"{100 + 0.2 * k:.3f}" for k in range(COUNT)) + "\n")
    (folder / "splits.toml").write_text(SPLITS)
    (folder / "truth.csv").write_text("is for scoring and is never read")
    return folder


@pytest.fixture
def folder(original: Path, tmp_path: Path) -> Path:
    """A copy to spoil."""
    return Path(shutil.copytree(original, tmp_path / "walk"))


def everything(replay: Replay):
    """All observations, as a list."""
    return list(iter(replay.sense, None))


def test_recordings_are_replayed(folder, walls):
    replay = Replay(folder)
    observations = everything(replay)
    assert len(replay) == len(observations) == COUNT
    assert replay.sense() is None
    pose = Pose2()
    for k, observation in enumerate(observations):
        pose = pose @ observation.odometry.motion()
        assert observation.stamp_ns == round((100 + 0.2 * k) * 1e9)
        assert (observation.odometry.forward, observation.odometry.turn) == (STEPS[k], TURNS[k])
        assert np.array_equal(observation.image, walls.render(pose))
        assert len(observation.proximity) == 0
        assert not observation.bumped


def test_the_robot_is_described_by_its_camera(folder, opened):
    replay = opened(Replay(folder))
    description = replay.describe()
    camera = description.camera
    assert (camera.width, camera.height, camera.fx, camera.cx) == (320, 240, 277.0, 159.5)
    assert (camera.mount_height, camera.mount_forward) == (0.3, 0.05)
    assert description.distortion == (-0.1, 0.02, 0.001, 0.0, 0.0)
    assert description.ranger_bearings == ()
    assert (description.max_forward, description.max_turn) == (0.0, 0.0)
    assert description.tick == pytest.approx(0.2)
    assert Replay(folder, "b").describe().tick == pytest.approx(0.6)
    assert replay.act(Command(0.3, 0.3)) == Command()


def test_splits_add_up_the_odometry_of_skipped_frames(folder, walls):
    assert len(Replay(folder, "a")) == 7
    observations = everything(Replay(folder, "b"))
    frames = [2, 5, 8, 11]
    assert [o.stamp_ns for o in observations] == [round((100 + 0.2 * k) * 1e9) for k in frames]
    assert observations[0].odometry == Odometry(0.0, 0.0), "nothing has moved before the first"
    for before, frame, observation in zip(frames, frames[1:], observations[1:], strict=False):
        assert observation.odometry.forward == pytest.approx(sum(STEPS[before + 1 : frame + 1]))
        assert observation.odometry.turn == pytest.approx(sum(TURNS[before + 1 : frame + 1]))


def test_all_splits_with_all_steps_cover_the_same_way(folder):
    for step in range(1, 7):
        (folder / "splits.toml").write_text(f'[[robot]]\nname = "c"\nfirst = 1\nlast = 13\nstep = {step}\n')
        observations = everything(Replay(folder, "c"))
        last = range(1, 14, step)[-1]
        assert sum(o.odometry.forward for o in observations) == pytest.approx(sum(STEPS[2 : last + 1]))


def test_without_times_it_is_ten_frames_a_second(folder):
    (folder / "times.txt").unlink()
    stamps = [o.stamp_ns for o in everything(Replay(folder))]
    assert np.diff(stamps).tolist() == pytest.approx([1e8] * (COUNT - 1))


def test_only_one_robot_needs_the_splits(folder):
    (folder / "splits.toml").unlink()
    assert len(Replay(folder)) == COUNT
    (folder / "truth.csv").unlink()
    assert len(Replay(folder)) == COUNT


def test_the_lens_may_be_ideal_and_the_mount_simple(folder):
    path = folder / "camera.toml"
    path.write_text("\n".join(CAMERA.splitlines()[:7]))
    camera, distortion = read_camera(path)
    assert camera.mount_forward == 0.0
    assert distortion == (0.0,) * 5


def test_colour_is_made_grey(folder):
    path = folder / "images" / "frame0.png"
    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(path), cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR))
    assert np.array_equal(Replay(folder).sense().image, grey)


def test_a_recording_becomes_a_map(walls, folder):
    (folder / "camera.toml").write_text(CAMERA.replace("-0.1, 0.02, 0.001", "0, 0, 0").replace("0.05", "0.0"))
    pipeline = None
    replay = Replay(folder)
    pipeline = Pipeline(MapId("r0", 1), replay.describe())
    pipeline.set_mission(Carried())
    for observation in everything(replay):
        step = pipeline.step(observation)
    assert step.status.tracked > 60
    assert step.status.map_from_robot.x == pytest.approx(sum(STEPS), abs=0.03)


# What is missing or wrong


def replaced(name: str, *pairs: str):
    """Replaces text in a file of the recording."""

    def spoil(folder: Path) -> None:
        text = (folder / name).read_text()
        for old, new in zip(pairs[::2], pairs[1::2], strict=True):
            assert old in text
            text = text.replace(old, new, 1)
        (folder / name).write_text(text)

    return spoil


def written(name: str, data: str | bytes):
    """Replaces a file of the recording."""
    raw = data.encode() if isinstance(data, str) else data
    return lambda folder: (folder / name).write_bytes(raw)


def gone(name: str):
    """Removes a file or folder."""

    def spoil(folder: Path) -> None:
        path = folder / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    return spoil


def folder_at(name: str):
    """Puts a folder where a file should be."""

    def spoil(folder: Path) -> None:
        (folder / name).unlink()
        (folder / name).mkdir()

    return spoil


def single(folder: Path) -> None:
    """One image with its time and its row of odometry."""
    for path in sorted((folder / "images").glob("*.png"))[1:]:
        path.unlink()
    (folder / "times.txt").write_text("100\n")
    (folder / "odometry.csv").write_text("forward_m,turn_rad\n0,0\n")


ODOMETRY = "frame,turn_rad,forward_m\n" + "0,0,0\n" * COUNT
POSES = "stamp_s,x_m,y_m,heading_rad\n" + "".join(f"{100 + k},0,0,0\n" for k in range(9))
WRONG = {
    "no recording": (gone("."), "no such folder"),
    "no images": (gone("images"), "images: no images there"),
    "images without a camera": (gone("camera.toml"), "must give the camera's intrinsics"),
    "camera is a folder": (folder_at("camera.toml"), "camera.toml"),
    "camera is no TOML": (written("camera.toml", "width = = 3"), "camera.toml"),
    "camera is no text": (written("camera.toml", b"\xff\xfe\x00"), "camera.toml"),
    "camera without focal length": (replaced("camera.toml", "fx = 277.0\n", ""), "'fx' is missing"),
    "camera without height": (replaced("camera.toml", "height_m = 0.3\n", ""), "'height_m' is missing"),
    "focal length is text": (replaced("camera.toml", "fx = 277.0", 'fx = "wide"'), "camera.toml"),
    "focal length is a list": (replaced("camera.toml", "fx = 277.0", "fx = [1]"), "camera.toml"),
    "focal length is negative": (replaced("camera.toml", "fx = 277.0", "fx = -1"), "focal lengths must be"),
    "focal length is infinite": (replaced("camera.toml", "fx = 277.0", "fx = inf"), "must be finite"),
    "width is infinite": (replaced("camera.toml", "width = 320", "width = inf"), "camera.toml"),
    "width is no number": (replaced("camera.toml", "width = 320", "width = nan"), "camera.toml"),
    "image too small": (replaced("camera.toml", "width = 320", "width = 3"), "out of range"),
    "lens of four": (replaced("camera.toml", ", 0.0, 0.0]", ", 0.0]"), "camera.toml"),
    "lens is one": (replaced("camera.toml", "[-0.1, 0.02, 0.001, 0.0, 0.0]", "0.1"), "camera.toml"),
    "lens is no number": (replaced("camera.toml", "0.02", "nan"), "camera.toml"),
    "camera with another key": (replaced("camera.toml", "forward_m", "foward_m"), "did you mean 'forward_m'"),
    "width is text": (replaced("camera.toml", "width = 320", 'width = "a"'), "width 'a' is no whole number"),
    "focal length is true": (replaced("camera.toml", "fx = 277.0", "fx = true"), "fx True is no number"),
    "lens of another name": (
        lambda folder: (folder / "camera.toml").write_text(
            "lens = 'fisheye'\n" + (folder / "camera.toml").read_text()
        ),
        "lens 'fisheye' is not known; it is radial-tangential or equidistant",
    ),
    "an image in two formats": (
        lambda folder: cv2.imwrite(
            str(next((folder / "images").iterdir()).with_suffix(".bmp")), np.zeros((240, 320), np.uint8)
        ),
        "are one image; keep one format",
    ),
    "odometry with a column twice": (
        written("odometry.csv", "forward_m,turn_rad,forward_m\n" + "0,0,9\n" * COUNT),
        "column 'forward_m' is there twice",
    ),
    "camera of deep lists": (written("camera.toml", "width = " + "[" * 5000), "camera.toml"),
    "camera with a long number": (replaced("camera.toml", "0.05", "9" * 400), "has too many digits"),
    "camera height in mm": (replaced("camera.toml", "height_m = 0.3", "height_m = 300"), "is in metres"),
    "one image": (single, "1 images are no drive; there must be two or more"),
    "no odometry": (gone("odometry.csv"), "14 images, but no odometry: give --odometry FILE"),
    "odometry is a folder": (folder_at("odometry.csv"), "odometry.csv"),
    "odometry is empty": (written("odometry.csv", ""), "0 rows for 14 images"),
    "odometry without a turn": (replaced("odometry.csv", "turn_rad", "turn"), "no column 'turn_rad'"),
    "odometry too long": (written("odometry.csv", ODOMETRY + "0,0,0\n"), "15 rows for 14 images"),
    "odometry with text": (written("odometry.csv", ODOMETRY.replace("0,0,0", "0,0,far", 1)), "'far' is no"),
    "odometry with a gap": (written("odometry.csv", ODOMETRY.replace("0,0,0", "0,0", 1)), "2: forward_m is"),
    "odometry not finite": (written("odometry.csv", ODOMETRY.replace("0,0,0", "0,0,nan", 1)), "one finite"),
    "odometry is no text": (written("odometry.csv", b"\xff\xfe\x00" * 9), "odometry.csv: is no text"),
    "odometry is an image": (written("odometry.csv", b"\x89PNG\r\n\x1a\n\0\0"), "odometry.csv: is no text"),
    "odometry of a sheet": (written("odometry.csv", ODOMETRY.replace(",", ";")), "separated by ';'; separ"),
    "poses of a sheet": (written("odometry.csv", POSES.replace(",", "\t")), "separated by '\\t'; separ"),
    "odometry with decimal commas": (
        written("odometry.csv", "forward_m,turn_rad\n" + "0,02,0,01\n" * COUNT),
        "line 2: more values than columns; write numbers with a point",
    ),
    "odometry in millimetres": (
        written("odometry.csv", "forward_m,turn_rad\n" + "1e5,0\n" * COUNT),
        "m/s: distances are in metres, and times in seconds",
    ),
    "odometry with a huge field": (written("odometry.csv", ODOMETRY + "1" * 200_000), "odometry.csv"),
    "a single time": (written("times.txt", "1\n"), "1 images are no drive; there must be two or more"),
    "no times": (written("times.txt", ""), "0 times for 14 images; there must be a line for each image"),
    "times too many": (written("times.txt", "\n".join(map(str, range(15)))), "15 times for 14 images; there"),
    "times go back": (written("times.txt", "\n".join(map(str, [*range(13), 3]))), "line 14: 3.0: times must"),
    "times with text": (written("times.txt", "noon"), "times.txt"),
    "times with a title": (written("times.txt", "seconds\n0.1\n0.2\n"), "line 1: 'seconds' is no time"),
    "times not finite": (written("times.txt", "nan " * COUNT), "ascend"),
    "times are no text": (written("times.txt", b"\xff" * 9), "times.txt: is no text in UTF-8; it must be"),
    "times are a folder": (folder_at("times.txt"), "times.txt"),
    "times before any clock": (written("times.txt", " ".join(str(k - 5) for k in range(COUNT))), "times.txt"),
    "times after all clocks": (written("times.txt", " ".join(f"{k}e200" for k in range(1, 15))), "times.txt"),
}  # fmt: skip
WRONG_SPLITS = {
    "no splits": (gone("splits.toml"), "it must describe robot 'b'"),
    "splits are no TOML": (written("splits.toml", "[[robot"), "splits.toml"),
    "splits are no text": (written("splits.toml", b"\xff\xfe"), "splits.toml"),
    "splits are a folder": (folder_at("splits.toml"), "splits.toml"),
    "splits without robots": (written("splits.toml", ""), "there are none"),
    "robots are no list": (written("splits.toml", "robot = 3"), "splits.toml"),
    "robots are texts": (written("splits.toml", 'robot = ["b"]'), "splits.toml"),
    "another robot": (replaced("splits.toml", '"b"', '"c"'), "no robot 'b'; there are a, c"),
    "a robot without a name": (replaced("splits.toml", 'name = "a"\n', ""), "splits.toml"),
    "a robot without an end": (replaced("splits.toml", "last = 13\n", ""), "robot 'b': 'last'"),
    "a robot past the end": (replaced("splits.toml", "last = 13", "last = 14"), "not within the 14 images"),
    "a robot before the start": (replaced("splits.toml", "first = 2", "first = -1"), "not within the 14"),
    "a robot without frames": (replaced("splits.toml", "first = 2", "first = 14"), "not within the 14"),
    "a robot that stands": (replaced("splits.toml", "step = 3", "step = 0"), "robot 'b'"),
    "a robot that goes back": (
        replaced("splits.toml", "step = 3", "step = -1", "first = 2", "first = 13", "last = 13", "last = 2"),
        "robot 'b'",
    ),
    "a frame that is text": (replaced("splits.toml", "first = 2", 'first = "x"'), "robot 'b'"),
    "splits of deep lists": (written("splits.toml", "robot = " + "[" * 5000), "splits.toml"),
    "a frame that is a list": (replaced("splits.toml", "first = 2", "first = [2]"), "robot 'b'"),
    "a frame that is infinite": (replaced("splits.toml", "first = 2", "first = inf"), "robot 'b'"),
    "a frame far away": (replaced("splits.toml", "last = 13", f"last = 1{'0' * 40}"), "not within the 14"),
    "half a frame": (replaced("splits.toml", "first = 2", "first = 2.5"), "robot 'b'"),
}
WRONG_IMAGES = {
    "an image of another size": (
        lambda folder: cv2.imwrite(str(folder / "images" / "frame2.png"), np.zeros((120, 160), np.uint8)),
        "160x120 px, but camera.toml gives 320x240",
    ),
    "an image that is none": (written("images/frame2.png", "no image"), "not an image that can be read"),
    "an empty image": (written("images/frame2.png", b""), "not an image that can be read"),
    "an image that vanished": (gone("images/frame2.png"), "frame2.png: no such file"),
}


def refused(action) -> str:
    """The one line of a refusal."""
    with pytest.raises(DeviceError) as error:
        action()
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 500
    return str(error.value)


@pytest.mark.parametrize("case", WRONG)
def test_errors_are_reported_in_one_line(folder, case):
    spoil, message = WRONG[case]
    spoil(folder)
    words = refused(lambda: Replay(folder))
    assert message in words
    assert str(folder) in words


@pytest.mark.parametrize(("options", "words"), [
    (RecordingOptions(image_topic="/camera"), "has no topics: leave out --image-topic"),
    (RecordingOptions(camera_height=0.3), "is height_m of {folder}/camera.toml: leave out"),
])  # fmt: skip
def test_options_without_effect_are_refused(folder, options, words):
    """They were ignored: the map had another height than the person had said."""
    assert words.format(folder=folder) in refused(lambda: open_recording(folder, options))


@pytest.mark.parametrize("case", WRONG_SPLITS)
def test_errors_of_a_split_are_reported_in_one_line(folder, case):
    spoil, message = WRONG_SPLITS[case]
    spoil(folder)
    words = refused(lambda: Replay(folder, "b"))
    assert message in words
    assert str(folder / "splits.toml") in words


@pytest.mark.parametrize("case", WRONG_IMAGES)
def test_an_image_that_cannot_be_used_is_left_out_and_named(folder, case):
    """The wheels' way past it is kept."""
    spoil, message = WRONG_IMAGES[case]
    replay = Replay(folder)
    spoil(folder)
    observations = everything(replay)
    assert [o.stamp_ns for o in observations] == [
        round((100 + 0.2 * k) * 1e9) for k in range(COUNT) if k != 2
    ]
    assert sum(o.odometry.forward for o in observations) == pytest.approx(sum(STEPS))
    (words,) = replay.damage
    assert message in words and "frame2.png" in words and "1 of 14 images" in words


def test_a_recording_of_which_no_image_can_be_read_is_refused(folder):
    for path in (folder / "images").glob("*.png"):
        path.write_bytes(path.read_bytes()[:40])
    assert "not an image that can be read" in refused(Replay(folder).sense)


@given(share=st.floats(0.0, 1.0))
@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_odometry_that_is_cut_off_anywhere_is_used_up_to_there(original, folder, share):
    """Also in the middle of a number, which must not be read as another."""
    text = (original / "odometry.csv").read_bytes()
    (folder / "odometry.csv").write_bytes(text[: round(share * len(text))])
    whole = text[: round(share * len(text))].count(b"\n") - 1
    if whole < 2:
        refused(lambda: Replay(folder))
        return
    replay = Replay(folder)
    observations = everything(replay)
    # A file without the last line's end may be whole: then there is a row for each image.
    assert len(observations) in (whole, COUNT) and bool(replay.damage) == (len(observations) < COUNT)
    for k, observation in enumerate(observations[:whole]):
        assert (observation.odometry.forward, observation.odometry.turn) == (STEPS[k], TURNS[k])


@pytest.mark.parametrize("odometry", ["increments", "poses"])
@given(share=st.floats(0.0, 1.0))
@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_times_that_are_cut_off_anywhere_are_used_up_to_there(folder, odometry, share):
    """The first images have them; a number that is cut must not be read as another."""
    text = "".join(f"{100 + 0.2 * k:.6f}\n" for k in range(COUNT - 1))
    text = text[: round(share * len(text))]
    (folder / "times.txt").write_text(text)
    if odometry == "poses":
        (folder / "odometry.csv").write_text(POSES)
    whole = text.count("\n")
    if whole < 2:
        refused(lambda: Replay(folder))
        return
    replay = Replay(folder)
    stamps = [round((100 + 0.2 * k) * 1e9) for k in range(COUNT)]
    assert [o.stamp_ns for o in everything(replay)] == stamps[:whole]
    (words,) = replay.damage
    assert f"times for 14 images; the first {whole} images are used" in words


toml_values = st.one_of(
    st.integers(-(2**70), 2**70).map(str),
    st.floats().map(lambda x: repr(x)),
    st.sampled_from(['"x"', "true", "[]", "[1, 2]", "{}", "1979-05-27", '""', "[0.1, 0.1, 0.1, 0.1, 1e999]"]),
)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(st.sampled_from(["width", "height", "fx", "cx", "height_m", "forward_m", "distortion"]), toml_values)
def test_any_camera_file_is_read_or_refused(tmp_path, name, value):
    path = tmp_path / "camera.toml"
    lines = [line for line in CAMERA.splitlines() if not line.startswith(f"{name} ")]
    path.write_text("\n".join([*lines, f"{name} = {value}"]))
    try:
        camera, distortion = read_camera(path)
    except DeviceError as error:
        assert str(error).startswith(str(path))
        assert "\n" not in str(error)
    else:
        assert np.isfinite(distortion).all()
        assert np.isfinite([camera.fx, camera.cx, camera.mount_height]).all()


@pytest.mark.parametrize("row", ["0,1e9", "1e300,0", "0,-1e300"])
def test_a_row_of_odometry_that_is_no_motion_ends_the_drive(folder, row):
    """It is no reason for a traceback: encoders that overflow are recorded as they count."""
    rows = ["0.02,0.01"] * COUNT
    rows[8] = row
    (folder / "odometry.csv").write_text("\n".join(["forward_m,turn_rad", *rows, ""]))
    replay = Replay(folder)
    assert len(replay) == 8
    assert [o.odometry.forward for o in iter(replay.sense, None)][1:] == [0.02] * 7
    (line,) = replay.damage
    assert line.startswith(
        f"{folder}: odometry of image 8, counted from 0, is no motion since the one before"
    )
    assert line.endswith("what comes before is used")


def test_values_without_a_column_are_left_out_where_they_are_empty(folder):
    """As a comma at the end of each line leaves them."""
    (folder / "odometry.csv").write_text("forward_m,turn_rad\n" + "0.02,0.01,\n" * COUNT)
    assert open_recording(folder).increments[1:] == pytest.approx(np.array([[0.02, 0.01]] * (COUNT - 1)))


def test_spaces_behind_commas_belong_to_no_name_and_no_number(folder):
    (folder / "odometry.csv").write_text("forward_m, turn_rad\n" + "0.02, 0.01\n" * COUNT)
    assert open_recording(folder).increments[1:] == pytest.approx(np.array([[0.02, 0.01]] * (COUNT - 1)))
