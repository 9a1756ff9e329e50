"""Whether an image continues the one before: on photographs, in the dark, and behind a person's back."""

import cv2
import numpy as np
import pytest
import skimage.data
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave import Camera, MapId, Observation, Odometry, Pose2
from mapweave.agent.mapping import image_acceptance
from mapweave.agent.mapping.kidnap_detection import FrameOverlap, KidnapDetector, relit, turned
from mapweave.agent.mapping.mapper import Mapper
from mapweave.vision.lens import Lens

HERE = Pose2(0.2, 0.1, 0.05)
NOTHING = np.zeros((0, 2))


@pytest.fixture
def continuity(description) -> KidnapDetector:
    return KidnapDetector(Lens(description.camera, description.distortion), description.camera)


@pytest.fixture(scope="module")
def elsewhere() -> np.ndarray:
    """(240, 320): another picture altogether."""
    return cv2.resize(cv2.cvtColor(skimage.data.chelsea(), cv2.COLOR_RGB2GRAY), (320, 240))


@pytest.mark.parametrize("turn", [-0.08, 0.0, 0.08])
def test_a_robot_that_drives_sees_the_same(walls, continuity, turn):
    there = HERE @ Pose2(0.03, 0.0, turn)
    assert (
        continuity.compare(walls.render(HERE), walls.render(there), turn, NOTHING, NOTHING)
        is FrameOverlap.SAME
    )


def test_a_robot_that_was_carried_off_does_not(walls, continuity, elsewhere):
    seen = walls.render(HERE)
    assert continuity.compare(seen, elsewhere, 0.0, NOTHING, NOTHING) is FrameOverlap.STRANGE
    assert continuity.compare(elsewhere, seen, 0.0, NOTHING, NOTHING) is FrameOverlap.STRANGE


def test_a_camera_that_faced_a_blank_wall_has_not_failed(walls, continuity):
    blank = np.full((240, 320), 128, np.uint8)
    assert continuity.compare(blank, walls.render(HERE), 0.0, NOTHING, NOTHING) is FrameOverlap.STRANGE


def test_in_the_dark_there_is_nothing(walls, continuity):
    seen = walls.render(HERE)
    dark = (seen * 0.02).astype(np.uint8)
    assert continuity.compare(seen, dark, 0.0, NOTHING, NOTHING) is FrameOverlap.BLANK
    assert continuity.compare(seen, relit(dark, seen), 0.0, NOTHING, NOTHING) is not FrameOverlap.SAME


def test_a_dazzled_camera_has_no_features(walls, continuity):
    seen = walls.render(HERE)
    dazzled = np.clip(seen.astype(int) * 8, 0, 255).astype(np.uint8)
    assert len(np.unique(dazzled)) > 10, "there is still something in it"
    assert continuity.compare(seen, dazzled, 0.0, NOTHING, NOTHING) is FrameOverlap.BLANK


def test_the_same_wall_from_further_back_is_not_the_same(walls, continuity):
    """Less than half of what was in view is found where it should be."""
    expected = np.random.default_rng(0).uniform([20, 20], [300, 220], (40, 2))
    result = expected.copy()
    result[16:] = np.nan
    assert (
        continuity.compare(walls.render(HERE), walls.render(HERE), 0.0, expected, result)
        is FrameOverlap.STRANGE
    )
    result[:28] = expected[:28] + 10.0
    assert (
        continuity.compare(walls.render(HERE), walls.render(HERE), 0.0, expected, result) is FrameOverlap.SAME
    )


def test_weak_points_of_a_smooth_wall_may_fade_at_once(walls, continuity, elsewhere):
    """Less than half of them are found, and the strongest corners all are."""
    expected = np.random.default_rng(0).uniform([20, 20], [300, 220], (23, 2))
    followed = expected.copy()
    followed[9:] = np.nan
    seen, on = walls.render(HERE), walls.render(HERE @ Pose2(0.02, 0.0, 0.0))
    # Brighter, so that it is not the image as a whole that is alike.
    on = cv2.convertScaleAbs(on, alpha=1.0, beta=15.0)
    assert continuity.compare(seen, on, 0.0, expected, followed) is FrameOverlap.SAME
    assert continuity.compare(seen, elsewhere, 0.0, expected, followed) is FrameOverlap.STRANGE
    assert continuity.compare(elsewhere, on, 0.0, expected, followed) is FrameOverlap.STRANGE


def test_where_hardly_anything_is_in_view_lost_tracks_tell_of_nothing(walls, continuity):
    """Tracks on a wall with four corners fade. What shows much more, or is clipped, is something else."""
    rng = np.random.default_rng(0)
    bare = np.clip(rng.normal(128, 1.5, (240, 320)), 0, 255).astype(np.uint8)
    bare[100:140, 200:240] = 60
    faded = cv2.GaussianBlur(bare, (0, 0), 2.0)
    expected = rng.uniform([20, 20], [300, 220], (15, 2))
    followed = np.full_like(expected, np.nan)
    assert continuity.compare(bare, faded, 0.0, expected, followed) is FrameOverlap.SAME
    assert continuity.compare(bare, walls.render(HERE), 0.0, expected, followed) is FrameOverlap.STRANGE
    black = np.zeros_like(bare)
    assert continuity.compare(bare, black, 0.0, expected, followed) is FrameOverlap.BLANK


def test_two_blank_walls_look_the_same(continuity):
    rng = np.random.default_rng(0)
    first, second = (np.clip(rng.normal(128, 2, (240, 320)), 0, 255).astype(np.uint8) for _ in range(2))
    assert continuity.compare(first, second, 0.0, NOTHING, NOTHING) is FrameOverlap.SAME


def test_tracks_decide_first(walls, continuity, elsewhere):
    """Where enough tracks should be in the image the corners are not asked."""
    expected = np.random.default_rng(0).uniform([20, 20], [300, 220], (40, 2))
    result = expected + 3.0
    assert continuity.compare(walls.render(HERE), elsewhere, 0.0, expected, result) is FrameOverlap.SAME
    result[6:] = np.nan
    seen = walls.render(HERE)
    assert continuity.compare(seen, seen, 0.0, expected, result) is FrameOverlap.STRANGE
    result = expected + 60.0
    assert continuity.compare(seen, seen, 0.0, expected, result) is FrameOverlap.STRANGE, (
        "other points than those"
    )


@settings(max_examples=50, deadline=None)
@given(st.floats(-0.4, 0.4), st.floats(2, 6), st.floats(-1.5, 1.5))
def test_turned_pixels_are_where_the_points_are(turn, ahead, aside):
    camera = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.3)
    point = np.array([[ahead, aside, 0.3]])
    after = camera.project(Pose2(0.0, 0.0, turn).inverse().apply(point))
    guess = turned(camera, camera.project(point), turn)
    assert guess[0, 0] == pytest.approx(after[0, 0], abs=1e-6)
    assert guess[0, 1] == pytest.approx(after[0, 1], abs=1e-6), "at the camera's height it is exact"


@pytest.mark.parametrize(("factor", "offset"), [(0.4, 0), (0.6, 20), (1.5, -20)])
def test_a_lamp_that_was_switched_is_seen_through(walls, factor, offset):
    seen = (walls.render(HERE) * 0.5 + 40).astype(np.uint8)
    dimmed = np.clip(seen * factor + offset, 0, 255).astype(np.uint8)
    assert np.abs(relit(dimmed, seen).astype(int) - seen).mean() < 2.5


# The same in a mapper that goes on


def watch(mapper: Mapper, images, forward: float = 0.0) -> None:
    for image in images:
        observation = Observation(0, Odometry(forward, 0.0), image)
        mapper.step(observation)
        if not mapper.started:
            mapper.begin(observation)


@pytest.fixture
def mapper(walls, description, monkeypatch) -> Mapper:
    """It has seen the walls for a moment."""
    monkeypatch.setattr(image_acceptance, "PATIENCE", 10)
    monkeypatch.setattr(image_acceptance, "BLANK_PATIENCE", 30)
    mapper = Mapper(MapId("r0", 1), description)
    watch(mapper, [walls.render(HERE)] * 3)
    assert mapper.tracked > 40
    return mapper


@pytest.mark.parametrize("what", ["dark", "occluded", "grey", "missing", "dimmed"])
def test_passing_objects_leave_the_tracks_alone(walls, mapper, elsewhere, what):
    seen = walls.render(HERE)
    between = {
        "dark": (seen * 0.02).astype(np.uint8),
        "occluded": elsewhere,
        "grey": np.full_like(seen, 90),
        "missing": None,
        "dimmed": (seen * 0.5).astype(np.uint8),
    }[what]
    tracked = mapper.tracked
    watch(mapper, [between] * 9)
    assert mapper.doubtful == (what != "dimmed")
    assert bool(mapper.doubt) == mapper.doubtful
    watch(mapper, [seen] * 2)
    assert not mapper.doubtful
    assert mapper.started
    assert mapper.tracked > 0.9 * tracked
    assert mapper.anchor_from_robot.distance(Pose2()) < 0.01


@pytest.mark.parametrize("frozen", [False, True])
def test_a_camera_that_hangs_stops_the_robot_and_not_its_wheels(walls, mapper, frozen):
    """The same image again while the wheels turn is not a new image: else it would refute the wheels."""
    image = walls.render(HERE) if frozen else None
    watch(mapper, [image] * 3, forward=0.01)
    assert not mapper.doubtful, "a dropped image now and then is nothing to stop for"
    watch(mapper, [image] * 2, forward=0.01)
    assert mapper.doubt == "the camera gives no new image"
    watch(mapper, [image] * 200)
    assert mapper.doubtful
    assert mapper.started
    assert mapper.anchor_from_robot.distance(Pose2(0.05)) < 1e-6
    watch(mapper, [walls.render(HERE @ Pose2(0.05))] * 3)
    assert not mapper.doubtful
    assert mapper.tracked > 40
    assert mapper.anchor_from_robot.distance(Pose2(0.05)) < 0.01


def test_a_lasting_change_means_that_the_robot_was_moved(mapper, elsewhere):
    watch(mapper, [elsewhere] * 9)
    assert mapper.started
    watch(mapper, [elsewhere] * 3)
    assert mapper.tracked > 40
    assert mapper.anchored == mapper.tracked
    assert mapper.anchor_from_robot == Pose2()
    assert not mapper.doubtful, "without a node there is nothing to lose: it began again"


def test_a_robot_that_drives_on_blindly_is_not_taken_for_carried_off(mapper, elsewhere):
    """Its wheels have moved so far that nothing of the old image need be in view."""
    watch(mapper, [elsewhere] * 30, forward=0.08)
    assert mapper.started
    assert mapper.anchor_from_robot.x == pytest.approx(30 * 0.08, abs=0.2)


def test_a_few_tracks_that_are_lost_at_once_leave_it_to_the_corners(walls, continuity, elsewhere):
    """A robot near a smooth wall lost ten of twelve tracks in one frame, and took itself for carried off."""
    seen, on = walls.render(HERE), walls.render(HERE @ Pose2(0.02, 0.0, 0.01))
    expected = np.random.default_rng(0).uniform([20, 20], [300, 220], (12, 2))
    result = expected.copy()
    result[2:] = np.nan
    assert continuity.compare(seen, on, 0.01, expected, result) is FrameOverlap.SAME
    assert continuity.compare(seen, elsewhere, 0.01, expected, result) is FrameOverlap.STRANGE
    assert (
        continuity.compare(seen, (on * 0.3).astype(np.uint8), 0.01, expected, result) is not FrameOverlap.SAME
    )
