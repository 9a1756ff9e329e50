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
        least_spread: likewise if they cover less than this share of the image's width.
        continuity: whether an image continues the one before.
        dispute: when wheels and images contradict each other.
        patience: images that show other things than they should, one after the other, before the robot
            takes itself for carried off. A person who walks by is gone by then.
        blank_patience: likewise images that show nothing: somebody has switched off the light.
    """

    tracker: TrackerSettings = field(default_factory=TrackerSettings)
    filter: FilterSettings = field(default_factory=FilterSettings)
    filtered: int = 36
    refill: int = 18
    hidden: OccludedTrackSettings = field(default_factory=OccludedTrackSettings)
    least_spread: float = 0.2
    continuity: KidnapDetectorSettings = field(default_factory=KidnapDetectorSettings)
    dispute: OdometryConsistencySettings = field(default_factory=OdometryConsistencySettings)
    patience: int = 30
    blank_patience: int = 100
