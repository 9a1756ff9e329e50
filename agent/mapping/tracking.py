"""Tracks and the mapping filter together: what ties the robot's motion to what it sees."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.arrays import among
from mapweave.agent.ekf.landmark_estimates import LandmarkEstimates
from mapweave.agent.ekf.mapping_filter import MappingFilter
from mapweave.agent.ekf.update_report import Health
from mapweave.agent.mapping.image_acceptance import ImageAcceptance
from mapweave.agent.mapping.initial_depth import initial_inverse_depths
from mapweave.agent.mapping.kidnap_detection import KidnapDetector, turned
from mapweave.agent.mapping.odometry_consistency import OdometryConsistency
from mapweave.agent.mapping.track_history import TrackHistory
from mapweave.agent.mapping.view import PendingKeyframe, RawImage, associate, even_choice
from mapweave.agent.observation import Observation, Odometry, RobotDescription
from mapweave.agent.settings import AgentSettings
from mapweave.agent.vision.occluded_tracks import OccludedTracks
from mapweave.agent.vision.template import HALF_PX, Templates
from mapweave.agent.vision.track_quality import RejectionCounter, TrackQuality
from mapweave.agent.vision.tracker import BORDER_PX, Tracker
from mapweave.hybridmap.pose import Array, PoseGaussian
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Features


class PredictionOffset:
    """Tracks that are followed and do not correct the filter: too few, or all in one corner.

    In between the wheels' error grows, and the filter's predictions of all tracks are off by a common motion.
    The motion from one image to the next it still predicts.
    """

    def __init__(self) -> None:
        """None: the filter is where the tracks are."""
        self.forget()

    def forget(self) -> None:
        """The filter is where the tracks are."""
        self._ids: NDArray[np.int64] = np.zeros(0, np.int64)
        self._aside: Array = np.zeros((0, 2))

    def note(self, ids: NDArray[np.int64], pixels: Array, expected: Array) -> None:
        """Take note of where tracks are and were not expected.

        Args:
            ids: (N,) tracks, each once.
            pixels: (N, 2) px, where they are.
            expected: (N, 2) px, where the filter has them; NaN where it has them nowhere.
        """
        order = np.argsort(ids)
        self._ids, self._aside = ids[order], np.nan_to_num((pixels - expected)[order])

    def aside(self, ids: NDArray[np.int64]) -> Array:
        """(N, 2) px, how far tracks are from where the filter expects them; zeros for those not noted."""
        out = np.zeros((len(ids), 2))
        if len(self._ids):
            place = self._ids.searchsorted(ids)
            matching = self._ids.take(place, mode="clip") == ids
            out[matching] = self._aside[place[matching]]
        return out


# The values between the stages of a step. A stage takes the value that only the stage before makes.


class FollowedImage(NamedTuple):
    """An accepted image, and the filter's landmarks that were not followed into it.

    Attributes:
        image: of the camera.
        lost: (N,) tracks.
        templates: their patches.
    """

    image: NDArray[np.uint8]
    lost: NDArray[np.int64]
    templates: Templates


class LiveTracks(NamedTuple):
    """Tracks in the image, and those that wait behind what hides them.

    Attributes:
        ids: (N,) of both.
    """

    ids: NDArray[np.int64]


class HeldTracks(NamedTuple):
    """Tracks in the image that the filter holds.

    Attributes:
        ids: (N,) of the tracks.
        pixels: (N, 2) px in the ideal image.
    """

    ids: NDArray[np.int64]
    pixels: Array


class EpisodeEstimate(NamedTuple):
    """What an episode has estimated so far; what is tracked later does not change it.

    Attributes:
        history: from where each track was seen.
        pose: `anchor_from_robot`.
        landmarks: of the filter, in robot.
    """

    history: TrackHistory
    pose: PoseGaussian
    landmarks: LandmarkEstimates


class Correction(NamedTuple):
    """How the filter was corrected by the tracks that it holds.

    Attributes:
        misses_px: (N, 2) px, innovations that were accepted.
        unused: tracks held, if they were too few to correct by; None if they were not.
    """

    misses_px: Array
    unused: int | None


NO_CORRECTION = Correction(np.zeros((0, 2)), None)


LEAST_SPREAD = 0.2
"""With landmarks that cover less than this share of the image's width the wheels are trusted alone."""
MOST_FILTERED = 54
"""Landmarks in the EKF, hidden ones and those that came in their stead included."""
LEAST_FILTERED = 5
"""With fewer landmarks in view the wheels are trusted alone."""
ASSOCIATE_PX = 1.5
"""A feature this near to a track is the same point."""
REFILL_SHARE = 0.5
"""With a smaller share of the landmarks left than this, further tracks are taken into the filter: those that
were chosen first may all be on the side that the robot turns away from. Without, 1.2 % instead of 0.06 % of
the ticks trust odometry although tracks are there (docs/decisions/tracking.md)."""
MOST_REFUSALS = 3
"""A track that the filter refuses this often in a row is given up: its place goes to one that fits. Maps of
KITTI 03 answer 73 instead of 69 % of the images (docs/decisions/tracking.md)."""


class Tracking:
    """Follows image points and filters an even choice of them.

    Attributes:
        history: where each track was seen from.
        acceptance: which images are accepted.
    """

    def __init__(self, description: RobotDescription, lens: Lens, settings: AgentSettings) -> None:
        """Start with nothing in view."""
        self.history = TrackHistory()
        self._camera, self._lens = description.camera, lens
        self._settings = settings.tracking
        self._pixel_sigma = settings.filter.pixel_sigma
        self._tracker = Tracker(lens)
        self._hidden = OccludedTracks()
        self._prediction_offset = PredictionOffset()
        d = description
        self._filter = MappingFilter(d.camera, d.axle, d.wheel_noise, settings.filter, d.side_slip)
        self.acceptance = ImageAcceptance(KidnapDetector(lens, description.camera))
        self._dispute = OdometryConsistency()
        self._rejections = RejectionCounter(MOST_REFUSALS)
        self._correction = NO_CORRECTION
        self._expected_depth = 1.0
        self._next_track = self._first_new = 1
        self._turned_before = 0.0

    @property
    def ids(self) -> NDArray[np.int64]:
        """(N,) tracks alive."""
        return self._tracker.ids

    @property
    def pixels(self) -> Array:
        """(N, 2) px in the ideal image, where they are."""
        return self._tracker.pixels

    @property
    def raw_tracks(self) -> tuple[NDArray[np.int64], Array]:
        """(N,) ids of the tracks alive, and (N, 2) px where they are in the real image."""
        return self._tracker.ids, self._tracker.raw

    @property
    def report(self) -> TrackQuality:
        """Quality of the tracks after the last accepted image."""
        tracker = self._tracker
        return TrackQuality.of(self._camera, tracker.pixels, tracker.ages, self._correction.misses_px)

    @property
    def pose(self) -> PoseGaussian:
        """`anchor_from_robot`."""
        return self._filter.pose

    @property
    def turned(self) -> float:
        """How far the robot has turned since the tracks began, by the filter, rad, but for whole turns."""
        return self._turned_before + self._filter.pose.mean.heading

    @property
    def health(self) -> tuple[Health, str]:
        """What holds the pose up, and in words what is wrong; empty if nothing is."""
        filter_health, images, unused = self._filter.health, self.acceptance, self._correction.unused
        if images.missing or images.strange or images.blank:
            return filter_health
        if unused is None:
            # Images came, but showed nothing to go by; a new view's landmarks are seen in the next.
            return (Health.GOOD, "") if filter_health[0] is Health.NO_IMAGE else filter_health
        if not unused:
            return Health.BLIND, "no landmark in view"
        return Health.FEW, f"{unused} landmarks in view are too few or too near to each other to go by"

    @property
    def contradicted(self) -> bool:
        """Whether the last image contradicts the wheels: the next ones will show which is true."""
        return self._dispute.contradicting > 0

    @property
    def disputed(self) -> bool:
        """Whether wheels and images contradict each other for so long that the pose is lost."""
        return self._dispute.disputed

    @property
    def converged_share(self) -> float:
        """Share of the filter's landmarks whose depth has converged; 0 without landmarks."""
        converged = self._filter.converged()
        return float(converged.mean()) if len(converged) else 0.0

    def doubt_lever(self, error: float) -> None:
        """Know that the camera may stand so far from where it is assumed on the robot, m."""
        self._dispute.lever_error = error

    def landmarks(self) -> LandmarkEstimates:
        """The filter's landmarks, in robot."""
        return self._filter.landmarks()

    @property
    def estimate(self) -> EpisodeEstimate:
        """All that nodes are made of."""
        return EpisodeEstimate(self.history.snapshot(), self.pose, self.landmarks())

    def step(self, observation: Observation) -> None:
        """Predict by the wheels, follow the tracks, correct by what they show.

        Each stage takes the value of the stage before, so their order is fixed.
        """
        self._predict(observation.odometry)
        followed = self._follow(self.acceptance.new_image(observation))
        if followed is None:
            return
        alive = self._seek_hidden(followed)
        held = self._hold(alive)
        self._correction = self._correct(held)
        self._dispute.compare(self._filter.pose.mean)
        self._refill()
        self._note_prediction_offset(self._correction)
        self.remember()

    def remember(self, force: bool = False) -> None:
        """Note from where the tracks are seen now, if the robot has moved or it is forced."""
        self.history.record(self._filter.pose.mean, self._tracker.ids, self._tracker.pixels, force)

    def take(
        self, observation: Observation, features: Features, anchor_from_view: PoseGaussian
    ) -> PendingKeyframe:
        """Make a view of an image that was just tracked, and match its features with tracks."""
        tracks = associate(features, self._tracker.ids, self._tracker.raw, ASSOCIATE_PX)
        image = None if observation.image is None else RawImage(observation.image, self._lens)
        return PendingKeyframe(
            observation.stamp_ns, anchor_from_view, features, tracks, observation.proximity, image
        )

    def follow(self, view: PendingKeyframe) -> None:
        """Make tracks of a view's features that have none; `fill` is to come before the next step."""
        new = view.tracks < 0
        ids = np.arange(self._next_track, self._next_track + int(new.sum()), dtype=np.int64)
        self._first_new, self._next_track = self._next_track, self._next_track + len(ids)
        view.tracks[new] = ids
        self._tracker.add(ids, view.features.raw[new])
        self._rejections.forget()
        self._correction = self._correction._replace(unused=None if len(ids) else 0)

    def fill(self, expected_depth: float) -> None:
        """Give the filter an even choice of the tracks that the last view has begun.

        Args:
            expected_depth: of a landmark of which nothing is known, from now on, m.
        """
        self._expected_depth = expected_depth
        self._fill(self._first_new)
        self.remember(force=True)

    def reanchor(self) -> PoseGaussian:
        """Restart at the present pose; returns `old_anchor_from_new`."""
        moved = self._filter.reanchor()
        self._turned_before += moved.mean.heading
        self._dispute.settle()
        self.history.reanchor(moved.mean, self._tracker.ids)
        return moved

    # The stages of a step, in order.

    def _predict(self, odometry: Odometry) -> None:
        """Move by the wheels."""
        self._filter.predict(odometry)
        self._dispute.step(odometry)
        self.acceptance.predict(odometry.motion())

    def _follow(self, image: NDArray[np.uint8] | None) -> FollowedImage | None:
        """Follow the tracks into a new image; None without an accepted one: then they stay."""
        if image is None:
            return None
        ids, templates = self._tracker.ids, self._tracker.templates
        tracker = self.acceptance.followed(self._tracker, image, self._expected())
        if tracker is None:
            return None
        self._tracker = tracker
        lost = ~among(ids, tracker.ids) & among(ids, self._filter.ids)
        return FollowedImage(image, ids[lost], templates.chosen(lost))

    def _seek_hidden(self, followed: FollowedImage) -> LiveTracks:
        """Hide landmarks just lost, and find others again."""
        self._hidden.take(followed.lost, followed.templates)
        self._hidden.keep(among(self._hidden.ids, self._filter.ids))
        if len(self._hidden.ids):
            expected = self._filter.predict_pixels(self._hidden.ids)
            # What has left the view, or is leaving it, is not hidden.
            margin = BORDER_PX + HALF_PX
            inner = np.array([self._camera.width, self._camera.height]) - margin
            inside: NDArray[np.bool_] = np.asarray(((expected >= margin) & (expected < inner)).all(axis=1))
            self._hidden.keep(inside)
            redetected, raw, patches = self._hidden.seek(followed.image, self._lens.distort(expected[inside]))
            if len(redetected):
                self._tracker.add(redetected, raw, patches)
        return LiveTracks(np.concatenate([self._tracker.ids, self._hidden.ids]))

    def _hold(self, alive: LiveTracks) -> HeldTracks:
        """Take landmarks that are gone out of the filter, for good.

        What they have taught is in the pose already.
        """
        self._filter.remove(self._filter.ids[~among(self._filter.ids, alive.ids)])
        held = among(self._tracker.ids, self._filter.ids)
        return HeldTracks(self._tracker.ids[held], self._tracker.pixels[held])

    def _correct(self, held: HeldTracks) -> Correction:
        """Correct the filter, if the tracks are enough for that; those that it refuses often are given up."""
        if not self._trusted(held.pixels):
            return Correction(NO_CORRECTION.misses_px, len(held.ids))
        update = self._filter.update(held.ids, held.pixels)
        refused = self._rejections.judge(held.ids, update.accepted)
        self._filter.remove(refused)
        self._tracker.keep(~among(self._tracker.ids, refused))
        return Correction(update.innovations_px[update.accepted], None)

    def _refill(self) -> None:
        """When few landmarks are left in view, let further tracks take their place."""
        if len(self._filter.ids) - len(self._hidden.ids) < REFILL_SHARE * self._settings.filtered:
            self._fill()

    def _note_prediction_offset(self, correction: Correction) -> None:
        """While the wheels are trusted alone, note how far the tracks are from where the filter has them."""
        if correction.unused is None:
            self._prediction_offset.forget()
            return
        ids = self._tracker.ids
        self._prediction_offset.note(ids, self._tracker.pixels, self._filter.predict_pixels(ids))

    # What the stages are made of.

    def _fill(self, first: int = 0) -> None:
        """Give the filter an even choice of the tracks that it does not hold, from a first one on."""
        s, held = self._settings, len(self._filter.ids)
        room = min(s.filtered - held + len(self._hidden.ids), MOST_FILTERED - held)
        inside = among(self._tracker.ids, self._filter.ids)
        candidates = ~inside & (self._tracker.ids >= first)
        if room <= 0 or not candidates.any():
            return
        ids, pixels = self._tracker.ids[candidates], self._tracker.pixels[candidates]
        chosen = even_choice(pixels, self._tracker.pixels[inside], room)
        inverse_depths, sigmas = initial_inverse_depths(
            ids[chosen],
            self.history,
            self._camera,
            self.pose.mean,
            self._expected_depth,
            self._pixel_sigma,
        )
        self._filter.add(ids[chosen], pixels[chosen], inverse_depths, sigmas)

    def _expected(self) -> Array:
        """(N, 2) px where the tracks should be now: by the filter, else by the turn alone."""
        expected = turned(self._camera, self._tracker.pixels, self.acceptance.moved.heading)
        ids = self._tracker.ids
        if len(self._filter.ids):
            rows = self._filter.predict_pixels(ids) + self._prediction_offset.aside(ids)
            hit = self._camera.contains(rows)
            expected[hit] = rows[hit]
        return expected

    def _trusted(self, pixels: Array) -> bool:
        """Whether landmarks are enough, and far enough apart, to correct the wheels.

        A few points in one corner may all lie on the same edge, slide along it together and agree.
        """
        spread = float(np.ptp(pixels[:, 0])) if len(pixels) else 0.0
        return len(pixels) >= LEAST_FILTERED and spread >= LEAST_SPREAD * self._camera.width
