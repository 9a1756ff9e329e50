"""Tracks and the mapping filter together: what ties the robot's motion to what it sees."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.ekf.landmark_estimates import LandmarkEstimates
from mapweave.agent.ekf.mapping_filter import MappingFilter
from mapweave.agent.ekf.triangulation import triangulate
from mapweave.agent.ekf.update_report import Health
from mapweave.agent.mapping.kidnap_detection import FrameOverlap, KidnapDetector, relit, turned
from mapweave.agent.mapping.odometry_consistency import OdometryConsistency
from mapweave.agent.mapping.prediction_offset import PredictionOffset
from mapweave.agent.mapping.track_history import TrackHistory
from mapweave.agent.mapping.view import View, associate, even_choice
from mapweave.agent.observation import Observation, Odometry, RobotDescription
from mapweave.agent.settings import AgentSettings
from mapweave.agent.vision.occluded_tracks import OccludedTracks
from mapweave.agent.vision.rejection_counter import RejectionCounter
from mapweave.agent.vision.template import HALF_PX, Templates
from mapweave.agent.vision.track_quality import TrackQuality
from mapweave.agent.vision.tracker import BORDER_PX, Tracker
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Features


class LostTracks(NamedTuple):
    """Landmarks of the filter that were not followed into an image.

    Attributes:
        ids: (N,) of the tracks.
        templates: what they looked like.
    """

    ids: NDArray[np.int64]
    templates: Templates


LEAST_SPREAD = 0.2
"""With landmarks that cover less than this share of the image's width the wheels are trusted alone."""
MOST_FILTERED = 54
"""Landmarks in the EKF, hidden ones and those that came in their stead included."""
LEAST_FILTERED = 5
"""With fewer landmarks in view the wheels are trusted alone."""
ASSOCIATE_PX = 1.5
"""A feature this near to a track is the same point."""
STRIKES = 3
"""A track that the filter refuses this often in a row is given up."""
PRIOR_SPREAD = 0.6
"""Sigma of a new landmark's inverse depth, as a share of the expected one."""
PRIOR_NEAR = 0.45
"""The same sigma is at least this over the camera's height: a landmark may always be about as near as the
floor. A robot before a bare wall would else take its nearness for a slip of the wheels."""
DOUBT = 2.0
"""Factor by which sigmas of triangulated depths are enlarged."""
MOST_CHI2 = 4.0
"""Triangulated depths of tracks whose mean squared residual is above this are not used; 1 is expected."""
DROPPED = 3
"""Images that may be missing, one after the other, before the robot should wait for the next."""
STALE = (0.4, 0.5)
"""Once the wheels have moved this much, nothing can be said of an image before, m and rad."""


class Tracking:
    """Follows image points and filters an even choice of them.

    An image that shows nothing of what the image before leads to expect is not believed: the tracks wait
    where they were last seen, for the light to come back or somebody to step aside. If that does not happen
    while the wheels stand, the robot was carried off.

    Attributes:
        history: where each track was seen from.
        strange: how many images in a row were not believed because they show other things.
        blank: likewise because they show nothing.
        missing: how many images in a row did not come, or came a second time.
    """

    def __init__(self, description: RobotDescription, lens: Lens, settings: AgentSettings) -> None:
        """Start with nothing in view."""
        self.history = TrackHistory()
        self._camera, self._lens = description.camera, lens
        self._settings = settings.tracking
        self._pixel_sigma = settings.filter.pixel_sigma
        self._anchored = settings.tracker.anchored
        self._tracker = Tracker(lens, settings.tracker)
        self._hidden = OccludedTracks()
        self._unheld = PredictionOffset()
        d = description
        self._filter = MappingFilter(d.camera, d.axle, d.wheel_noise, settings.filter, d.side_slip)
        # Two images are compared by points that live for one step: nothing to hold them to.
        once = replace(settings.tracker, anchored=False)
        self._continuity = KidnapDetector(lens, description.camera, once)
        self.strange = self.blank = self.missing = 0
        self._dispute = OdometryConsistency()
        self._believed: NDArray[np.uint8] | None = None
        self._since_believed = Pose2()
        self._misses_px: Array = np.zeros((0, 2))
        self._strikes = RejectionCounter(STRIKES)
        self._unused: int | None = None
        self._expected_depth = 1.0
        self._next_track = 1

    @property
    def ids(self) -> NDArray[np.int64]:
        """(N,) tracks alive."""
        return self._tracker.ids

    @property
    def pixels(self) -> Array:
        """(N, 2) px in the ideal image, where they are."""
        return self._tracker.pixels

    @property
    def report(self) -> TrackQuality:
        """What the tracks are worth after the last image that was believed."""
        tracker = self._tracker
        return TrackQuality.of(self._camera, tracker.pixels, tracker.ages, tracker.held, self._misses_px)

    @property
    def pose(self) -> PoseGaussian:
        """`anchor_from_robot`."""
        return self._filter.pose

    @property
    def health(self) -> tuple[Health, str]:
        """What holds the pose up, and in words what is wrong; empty if nothing is."""
        told = self._filter.health
        if self.missing or self.strange or self.blank:
            return told
        if self._unused is None:
            # Images came, but showed nothing to go by; a new view's landmarks are seen in the next.
            return (Health.GOOD, "") if told[0] is Health.NO_IMAGE else told
        if not self._unused:
            return Health.BLIND, "no landmark in view"
        return Health.FEW, f"{self._unused} landmarks in view are too few or too near to each other to go by"

    @property
    def doubtful(self) -> bool:
        """Whether the last image was not believed, or the last images were missing."""
        return bool(self.strange or self.blank) or self.missing > DROPPED

    @property
    def disputed(self) -> bool:
        """Whether wheels and images tell stories since the anchor that cannot both be true."""
        return self._dispute.with_filter(self._filter.pose.mean)

    @property
    def carried_off(self) -> bool:
        """Whether images have shown something else for so long that the robot must be elsewhere."""
        return self.strange >= self._settings.patience or self.blank >= self._settings.blank_patience

    @property
    def converged_share(self) -> float:
        """Share of the filter's landmarks whose depth has converged; 0 without landmarks."""
        converged = self._filter.converged()
        return float(converged.mean()) if len(converged) else 0.0

    def landmarks(self) -> LandmarkEstimates:
        """The filter's landmarks, in robot."""
        return self._filter.landmarks()

    def step(self, observation: Observation) -> None:
        """Predict by the wheels, follow the tracks, correct by what they show.

        Each stage takes what the one before gives: what was lost on the way into the image, what is alive
        after hidden landmarks were sought, which of that the filter holds, and whether it was corrected.
        """
        self._predict(observation.odometry)
        image = self._new_image(observation)
        if image is None:
            return
        lost = self._follow(image)
        if lost is None:
            return
        alive = self._seek_hidden(image, lost)
        corrected = self._correct(self._held(alive))
        if len(self._filter.ids) - len(self._hidden.ids) < self._settings.refill:
            self._fill()
        self._note_unheld(corrected)
        self.remember()

    def remember(self, force: bool = False) -> None:
        """Note from where the tracks are seen now, if the robot has moved or it is forced."""
        self.history.record(self._filter.pose.mean, self._tracker.ids, self._tracker.pixels, force)

    def take(self, observation: Observation, features: Features, anchor_from_view: PoseGaussian) -> View:
        """Make a view of an image that was just tracked, and tell which of its features are tracks."""
        tracks = associate(features, self._tracker.ids, self._tracker.raw, ASSOCIATE_PX)
        return View(observation.stamp_ns, anchor_from_view, features, tracks, observation.proximity)

    def follow(self, view: View, expected_depth: float) -> None:
        """Make tracks of a view's features that have none, and give the filter an even choice of them."""
        new = view.tracks < 0
        ids = np.arange(self._next_track, self._next_track + int(new.sum()), dtype=np.int64)
        self._next_track += len(ids)
        view.tracks[new] = ids
        self._tracker.add(ids, view.features.raw[new])
        self._strikes.forget()
        self._expected_depth = expected_depth
        self._unused = None if len(ids) else 0
        self._fill(first=int(ids[0]) if len(ids) else self._next_track)
        self.remember(force=True)

    def reanchor(self) -> PoseGaussian:
        """Begin anew from here; returns `old_anchor_from_new`."""
        moved = self._filter.reanchor()
        self._dispute.settle()
        self.history.reanchor(moved.mean, self._tracker.ids)
        return moved

    # The stages of a step, in order.

    def _predict(self, odometry: Odometry) -> None:
        """Move by the wheels."""
        self._filter.predict(odometry)
        self._dispute.step(odometry)
        self._since_believed = self._since_believed @ odometry.motion()

    def _new_image(self, observation: Observation) -> NDArray[np.uint8] | None:
        """The image, unless none came or the last one came again."""
        if observation.image is None or self._frozen(observation.image):
            self.missing += self._believed is not None
            return None
        self.missing = 0
        return observation.image

    def _follow(self, image: NDArray[np.uint8]) -> LostTracks | None:
        """Follow the tracks into an image; None if it is not believed: then they stay where they were."""
        ids, templates = self._tracker.ids, self._tracker.templates
        believed, moved, (way, turn) = self._believed, self._since_believed, STALE
        if believed is None or np.hypot(moved.x, moved.y) > way or abs(moved.heading) > turn:
            self._tracker.track(image, self._expected())
        else:
            sight = self._see(image, believed)
            if (
                sight is not FrameOverlap.SAME
                and self._see(relit(image, believed), believed) is FrameOverlap.SAME
            ):
                # The next image will be in the same light as this one really is.
                self._tracker.relight(image)
            elif sight is not FrameOverlap.SAME:
                self.strange += sight is FrameOverlap.STRANGE
                self.blank += sight is FrameOverlap.BLANK
                return None
        self.strange = self.blank = 0
        self._believed, self._since_believed = image, Pose2()
        lost = ~np.isin(ids, self._tracker.ids) & np.isin(ids, self._filter.ids)
        return LostTracks(ids[lost], templates.chosen(lost))

    def _seek_hidden(self, image: NDArray[np.uint8], lost: LostTracks) -> NDArray[np.int64]:
        """Hide landmarks just lost, find others again; returns the ids of all that are tracked or hidden."""
        if self._anchored:
            self._hidden.take(lost.ids, lost.templates)
        self._hidden.keep(np.isin(self._hidden.ids, self._filter.ids))
        if len(self._hidden.ids):
            expected = self._filter.predict_pixels(self._hidden.ids)
            # What has left the view, or is leaving it, is not hidden.
            margin = BORDER_PX + HALF_PX
            far_in = np.array([self._camera.width, self._camera.height]) - margin
            inside: NDArray[np.bool_] = np.asarray(((expected >= margin) & (expected < far_in)).all(axis=1))
            self._hidden.keep(inside)
            found, raw, patches = self._hidden.seek(image, self._lens.distort(expected[inside]))
            if len(found):
                self._tracker.add(found, raw, patches)
        return np.concatenate([self._tracker.ids, self._hidden.ids])

    def _held(self, alive: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(N,) which tracks the filter holds. A landmark that is gone is taken out of it, and stays out.

        What it has taught is in the pose already.
        """
        self._filter.remove(self._filter.ids[~np.isin(self._filter.ids, alive)])
        return np.isin(self._tracker.ids, self._filter.ids)

    def _correct(self, held: NDArray[np.bool_]) -> bool:
        """Correct the filter by the tracks that it holds; returns whether they were enough for that."""
        ids, pixels = self._tracker.ids[held], self._tracker.pixels[held]
        trusted = self._trusted(pixels)
        self._misses_px = np.zeros((0, 2))
        self._unused = None if trusted else len(pixels)
        if trusted:
            update = self._filter.update(ids, pixels)
            self._misses_px = update.innovations_px[update.accepted]
            refused = self._strikes.judge(ids, update.accepted)
            self._filter.remove(refused)
            self._tracker.keep(~np.isin(self._tracker.ids, refused))
        return trusted

    def _note_unheld(self, corrected: bool) -> None:
        """While the wheels are trusted alone, note how far the tracks are from where the filter has them."""
        ids, pixels = self._tracker.ids, self._tracker.pixels
        if corrected:
            ids, pixels = ids[:0], pixels[:0]
        self._unheld.note(ids, pixels, self._filter.predict_pixels(ids))

    # What the stages are made of.

    def _fill(self, first: int = 0) -> None:
        """Give the filter an even choice of the tracks that it does not hold, from a first one on."""
        s, held = self._settings, len(self._filter.ids)
        room = min(s.filtered - held + len(self._hidden.ids), MOST_FILTERED - held)
        inside = np.isin(self._tracker.ids, self._filter.ids)
        candidates = ~inside & (self._tracker.ids >= first)
        if room <= 0 or not candidates.any():
            return
        ids, pixels = self._tracker.ids[candidates], self._tracker.pixels[candidates]
        chosen = even_choice(pixels, self._tracker.pixels[inside], room)
        inverse_depths, sigmas = self._first_depths(ids[chosen])
        self._filter.add(ids[chosen], pixels[chosen], inverse_depths, sigmas)

    def _first_depths(self, ids: NDArray[np.int64]) -> tuple[Array, Array]:
        """(N,) inverse depths 1/m with which tracks come into the filter, and their sigmas.

        Tracks that were followed outside of it are triangulated against its trajectory. Its errors enter all
        of them alike, which their covariances do not know.
        """
        inverse_depths = np.full(len(ids), 1.0 / self._expected_depth)
        nearest = PRIOR_NEAR / max(self._camera.mount_height, 0.05)
        sigmas = np.maximum(PRIOR_SPREAD * inverse_depths, nearest)
        poses, pixels = self.history.sightings(ids)
        if len(poses) >= 2:
            solved = triangulate(poses, pixels, self._camera, self._pixel_sigma, self.pose.mean.vector)
            better = DOUBT * np.sqrt(solved.ray_covariances[:, 2, 2])
            fits = (solved.chi2 < MOST_CHI2) & (better < sigmas)
            inverse_depths[fits], sigmas[fits] = solved.rays[fits, 2], better[fits]
        return inverse_depths, sigmas

    def _frozen(self, image: NDArray[np.uint8]) -> bool:
        """Whether an image is the last one again, to the last grey level, although the wheels have moved.

        Only an image with nothing in it is the same from everywhere.
        """
        moved = self._since_believed
        stands = max(abs(moved.x), abs(moved.y), abs(moved.heading)) < 1e-3
        if stands or self._believed is None or not np.array_equal(image, self._believed):
            return False
        return int(image.min()) < int(image.max())

    def _see(self, image: NDArray[np.uint8], believed: NDArray[np.uint8]) -> FrameOverlap:
        """Follow the tracks into an image; if it does not continue the one before, they stay behind."""
        tracker, expected = copy.copy(self._tracker), self._expected()
        tracker.track(image, expected)
        found = np.full(expected.shape, np.nan)
        found[np.isin(self._tracker.ids, tracker.ids)] = tracker.pixels
        turn = self._since_believed.heading
        sight = self._continuity.compare(believed, image, turn, expected, found)
        if sight is FrameOverlap.SAME:
            self._tracker = tracker
        return sight

    def _expected(self) -> Array:
        """(N, 2) px where the tracks should be now: by the filter, else by the turn alone."""
        expected = turned(self._camera, self._tracker.pixels, self._since_believed.heading)
        ids = self._filter.ids
        if len(ids):
            order = np.argsort(ids)
            place = np.clip(np.searchsorted(ids[order], self._tracker.ids), 0, len(ids) - 1)
            rows = self._filter.predict_pixels()[order[place]] + self._unheld.aside(self._tracker.ids)
            hit = (ids[order][place] == self._tracker.ids) & self._camera.contains(rows)
            expected[hit] = rows[hit]
        return expected

    def _trusted(self, pixels: Array) -> bool:
        """Whether landmarks are enough, and far enough apart, to correct the wheels.

        A few points in one corner may all lie on the same edge, slide along it together and agree.
        """
        spread = float(np.ptp(pixels[:, 0])) if len(pixels) else 0.0
        return len(pixels) >= LEAST_FILTERED and spread >= LEAST_SPREAD * self._camera.width
