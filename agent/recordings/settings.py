"""The `[recording]` table of a settings file: what a bag's topics are."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RecordingSettings:
    """Which topics of a bag are the robot's; other recordings have none. The command line overrides it.

    Attributes:
        image_topic: images; empty takes the topic with most.
        odometry_topic: odometry; empty takes the most likely topic, by its type and name.
        camera_info_topic: calibration of the camera; empty takes the topic beside the images.
    """

    image_topic: str = ""
    odometry_topic: str = ""
    camera_info_topic: str = ""
