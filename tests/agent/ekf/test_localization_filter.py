"""The localization filter: from nearly nowhere to the pose, a better map, and an honest account."""

import numpy as np
import pytest

from mapweave import Camera, Odometry, Pose2, PoseGaussian
from mapweave.agent.ekf.localization_filter import LocalizationFilter
from mapweave.agent.ekf.localization_state import LocalizationState
from mapweave.hybridmap.errors import InvalidValue
from synthetic.localization_run import try_start
from synthetic.mapping_run import AXLE, CAMERA, WHEEL_NOISE

AHEAD = Camera(320, 240, 277.0, 277.0, 160.0, 120.0, mount_height=0.3, mount_forward=0.1)
NOWHERE = (1.0, 1.0)
NO_LANDMARKS = np.zeros((0, 3)), np.zeros((0, 3, 3))


class World:
    """A node's landmarks with truth, as a map has them, and a robot that sees them."""

    def __init__(self, seed: int, camera: Camera = CAMERA, count: int = 25) -> None:
        self.rng = np.random.default_rng(seed)
        self.camera = camera
        self.ids = np.arange(count)
        depth = self.rng.uniform(1.5, 5.0, count)
        pixels = np.column_stack([self.rng.uniform(20, 300, count), self.rng.uniform(20, 220, count)])
        self.points = camera.back_project(pixels, depth)
        sigma = 0.03 * depth
        seen, known = (
            pixels + 0.7 * self.rng.normal(size=pixels.shape),
            depth + sigma * self.rng.normal(size=count),
        )
        self.mapped = camera.back_project(seen, known)
        ray = (self.mapped - [camera.mount_forward, 0.0, camera.mount_height]) / known[:, None]
        self.covariances = np.einsum("ni,nj,n->nij", ray, ray, sigma**2)
        self.covariances[:, [1, 2], [1, 2]] += (0.7 * known / 277.0)[:, None] ** 2
        self.true = Pose2(-0.3, 0.1, 0.1)

    def filter(self, prior: PoseGaussian) -> LocalizationFilter:
        return LocalizationFilter(
            self.camera, AXLE, WHEEL_NOISE, prior, self.ids, self.mapped, self.covariances
        )

    def near(self) -> PoseGaussian:
        sigmas = np.array([0.03, 0.03, 0.02])
        return PoseGaussian(
            self.true @ Pose2.from_vector(sigmas * self.rng.normal(size=3)), np.diag(sigmas**2)
        )

    def step(self, k: int) -> Odometry:
        odometry = Odometry(0.02 * np.sin(0.1 * k), 0.012 * np.cos(0.08 * k))
        ways = odometry.forward + 0.5 * AXLE * odometry.turn * np.array([1.0, -1.0])
        right, left = ways * (1 + WHEEL_NOISE * self.rng.normal(size=2))
        self.true = self.true @ Odometry(0.5 * (right + left), (right - left) / AXLE).motion()
        return odometry

    def see(self) -> np.ndarray:
        exact = self.camera.project(self.true.inverse().apply(self.points))
        pixels = exact + 0.7 * self.rng.normal(size=exact.shape)
        pixels[~self.camera.contains(exact)] = np.nan
        return pixels

    def drive(self, filter_: LocalizationFilter, steps: int) -> None:
        for k in range(steps):
            filter_.predict(self.step(k))
            filter_.update(self.ids, self.see())


def off(filter_: LocalizationFilter, world: World) -> np.ndarray:
    return np.abs((filter_.pose.mean.inverse() @ world.true).vector)


@pytest.mark.parametrize("camera", [CAMERA, AHEAD])
def test_from_a_metre_and_a_radian_wrong(camera: Camera):
    world = World(0, camera)
    prior = PoseGaussian.from_sigmas(world.true @ Pose2(-0.7, 0.9, 1.1), *NOWHERE)
    filter_ = world.filter(prior)
    assert not filter_.healthy
    assert "1.0 m" in filter_.reason
    world.drive(filter_, 20)
    assert filter_.healthy
    assert off(filter_, world)[:2].max() < 0.05
    assert off(filter_, world)[2] < 0.02


@pytest.mark.slow
def test_converges_consistently_over_random_starts():
    starts = [try_start(np.random.default_rng([6, k]), steps=40) for k in range(50)]
    assert np.mean([start.converged for start in starts]) >= 0.98
    # 150 degrees of freedom: 99.8 % of the averages lie in 2.0 to 4.2.
    assert 2.0 < np.mean([start.nees for start in starts]) < 4.2


def test_driving_makes_the_map_better():
    world = World(1)
    filter_ = world.filter(world.near())
    before = np.linalg.norm(world.mapped - world.points, axis=1)
    sigma_before = np.sqrt(world.covariances[:, 0, 0])
    world.drive(filter_, 200)
    known = filter_.landmarks_in_node()
    after = np.linalg.norm(known.points - world.points[known.ids], axis=1)
    assert np.sqrt(np.mean(after**2)) < 0.6 * np.sqrt(np.mean(before**2))
    assert (np.sqrt(known.covariances[:, 0, 0]) < sigma_before).all()
    misfit = np.einsum(
        "ni,nij,nj->n",
        known.points - world.points,
        np.linalg.inv(known.covariances),
        known.points - world.points,
    )
    assert misfit.mean() < 5.0


@pytest.mark.slow
def test_the_error_of_the_maps_own_pixels_is_not_averaged_away():
    """The vertical slopes are the same in each image: as white noise they made the pose's NEES 60."""
    nees = []
    for seed in range(12):
        world = World(100 + seed)
        filter_ = world.filter(world.near())
        world.drive(filter_, 120)
        nees.append(filter_.pose.mahalanobis2(world.true))
    assert np.mean(nees) < 6.5


def test_seeing_nothing_grows_the_covariance_and_ends_health():
    world = World(5)
    filter_ = world.filter(world.near())
    world.drive(filter_, 20)
    before = filter_.pose.covariance.trace()
    for k in range(5):
        filter_.predict(world.step(k))
        report = filter_.update(world.ids, np.full((25, 2), np.nan))
        assert not report.healthy
    assert filter_.pose.covariance.trace() > before
    assert not filter_.healthy
    assert "in view" in filter_.reason
    world.drive(filter_, 5)
    assert filter_.healthy


def test_a_few_good_among_wrong_tracks_are_named():
    world = World(6)
    filter_ = world.filter(world.near())
    world.drive(filter_, 10)
    filter_.predict(world.step(0))
    pixels = world.see()
    wrong = np.flatnonzero(np.isfinite(pixels[:, 0]))[2:]
    pixels[wrong] = world.rng.uniform((0, 0), (320, 240), (len(wrong), 2))
    before = filter_.state
    report = filter_.update(world.ids, pixels)
    assert not report.healthy
    assert report.reason.endswith(f"of {len(wrong) + 2} landmarks agree")
    # Two of so many prove nothing: none is accepted.
    assert not report.accepted.any()
    assert filter_.state is before


def test_kidnapped_while_blind_is_found_again():
    world = World(7)
    filter_ = world.filter(world.near())
    world.drive(filter_, 20)
    world.true = world.true @ Pose2(-0.5, 0.3, -0.25)
    world.drive(filter_, 12)
    assert filter_.healthy
    assert off(filter_, world)[:2].max() < 0.06
    assert filter_.pose.mahalanobis2(world.true) < 20.0


def test_wrong_tracks_do_not_move_the_pose():
    world = World(8)
    clean, spoiled = world.filter(world.near()), None
    spoiled = world.filter(clean.pose)
    shift = world.rng.uniform(-25, 25, (7, 2))
    for k in range(60):
        odometry = world.step(k)
        pixels = world.see()
        clean.predict(odometry)
        clean.update(world.ids, pixels)
        bad = pixels.copy()
        bad[:7] += shift if k > 20 else 0.0
        spoiled.predict(odometry)
        report = spoiled.update(world.ids, bad)
    assert not report.accepted[:7].any()
    assert off(spoiled, world)[:2].max() < off(clean, world)[:2].max() + 0.01


def test_ids_come_only_once():
    world = World(9)
    world.ids[1] = world.ids[0]
    with pytest.raises(InvalidValue, match="only once"):
        world.filter(world.near())


def test_a_landmark_that_the_node_cannot_have_seen_is_left_out():
    world = World(9)
    world.mapped[3] = -5.0, 0.0, 0.3
    filter_ = world.filter(world.near())
    assert set(filter_.ids) == set(np.delete(world.ids, 3))
    assert np.isnan(filter_.predict_pixels(world.ids[3:4])).all()


def test_prior_keeps_its_convention():
    """A right perturbation round-trips for any heading."""
    prior = PoseGaussian(
        Pose2(1.0, 2.0, 2.2), np.array([[0.04, 0.01, 0.0], [0.01, 0.02, 0.003], [0.0, 0.003, 0.01]])
    )
    np.testing.assert_allclose(
        LocalizationState.of_prior(prior, *NO_LANDMARKS).pose.covariance, prior.covariance, atol=1e-15
    )


@pytest.mark.parametrize("scale", [0.8, 1.25])
def test_wheels_give_the_scale_of_a_photograph(scale):
    """All points, and the prior's way, are off together; a drive later the pose is right, and knows it."""
    squared = []
    for seed in range(8):
        world = World(seed)
        centre = np.array([world.camera.mount_forward, 0.0, world.camera.mount_height])
        mapped = centre + scale * (world.mapped - centre)
        prior = PoseGaussian.from_sigmas(
            Pose2(scale * world.true.x, scale * world.true.y, world.true.heading), 0.01, 0.01
        )
        far = (scale - 1.0) * np.array([world.true.x, world.true.y])
        located = LocalizationFilter(
            world.camera, AXLE, WHEEL_NOISE, prior, world.ids, mapped, scale**2 * world.covariances, 0.3
        )
        # The prior says that it may be off by so much.
        assert located.pose.mahalanobis2(world.true) < 16.3
        assert np.linalg.norm(far) > 0.05
        for k in range(60):
            located.predict(world.step(k))
            located.update(world.ids, world.see())
        squared.append(located.pose.mahalanobis2(world.true))
        assert located.pose.mean.distance(world.true) < 0.03
    assert np.mean(squared) < 6.0, "3 is expected"
