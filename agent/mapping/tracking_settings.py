"""How landmarks are followed between views."""

from __future__ import annotations

from dataclasses import dataclass, field

from mapweave.agent.ekf.settings import FilterSettings
from mapweave.agent.mapping.kidnap_detection import KidnapDetectorSettings
from mapweave.agent.mapping.odometry_consistency import OdometryConsistencySettings
from mapweave.agent.vision.occluded_tracks import OccludedTrackSettings
from mapweave.agent.vision.tracker import TrackerSettings


@dataclass(frozen=True)
class TrackingSettings:
    """How landmarks are followed.

    Attributes:
        tracker: of image points.
        filter: the mapping EKF.
        filtered: landmarks in the EKF; further tracks are triangulated against its trajectory.
        refill: with fewer left than this, further tracks are taken into the EKF: those that were chosen first
            may all be on the side that the robot turns away from.
        hidden: landmarks that somebody hides wait in the EKF, and are looked for where they should be.
        most_filtered: landmarks in the EKF, hidden ones and those that came in their stead included.
        least_filtered: with fewer landmarks in view the wheels are trusted alone.
        least_spread: likewise if they cover less than this share of the image's width.
        associate_px: a feature this near to a track is the same point.
        strikes: a track that the filter refuses this often in a row is given up.
        prior_spread: sigma of a new landmark's inverse depth, as a share of the expected one ...
        prior_near: ... but no less than this over the camera's height: a landmark may always be about as near
            as the floor. A robot before a bare wall would else take its nearness for a slip of the wheels.
        doubt: sigmas of triangulated depths are taken for so many times what they say
        most_chi2: and depths of tracks whose mean squared residual is above this, not at all; 1 is expected.
        continuity: whether an image continues the one before.
        dispute: when wheels and images contradict each other.
        patience: images that show other things than they should, one after the other, before the robot
            takes itself for carried off. A person who walks by is gone by then.
        blank_patience: likewise images that show nothing: somebody has switched off the light.
        dropped: images that may be missing, one after the other, before the robot should wait for the next.
        stale: m and rad; once the wheels have moved this much, nothing can be said of an image before.
    """

    tracker: TrackerSettings = field(default_factory=TrackerSettings)
    filter: FilterSettings = field(default_factory=FilterSettings)
    filtered: int = 36
    refill: int = 18
    hidden: OccludedTrackSettings = field(default_factory=OccludedTrackSettings)
    most_filtered: int = 54
    least_filtered: int = 5
    least_spread: float = 0.2
    associate_px: float = 1.5
    strikes: int = 3
    prior_spread: float = 0.6
    prior_near: float = 0.45
    doubt: float = 2.0
    most_chi2: float = 4.0
    continuity: KidnapDetectorSettings = field(default_factory=KidnapDetectorSettings)
    dispute: OdometryConsistencySettings = field(default_factory=OdometryConsistencySettings)
    patience: int = 30
    blank_patience: int = 100
    dropped: int = 3
    stale: tuple[float, float] = (0.4, 0.5)
