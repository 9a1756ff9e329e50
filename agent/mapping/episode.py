"""A mapping episode as behaviours see it, and what they may ask for. They never change the map themselves."""

from enum import Enum, auto
from typing import Protocol

from mapweave.agent.observation import Command
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian


class EpisodeRequest(Enum):
    """What a behaviour asks of the mapper; the pipeline hands it on."""

    BEGIN = auto()
    """Take the current image as the first anchor."""
    ADD_VIEW = auto()
    """Keep the current image as a further node, for example at the far end of a drive."""
    FINISH = auto()
    """End the episode: the image becomes the next anchor, its views become nodes in the next ticks."""


Move = Command | EpisodeRequest
"""What a behaviour does next. A command ends its tick."""


class Episode(Protocol):
    """What behaviours read of the mapper, see `mapweave.agent.mapping.mapper.Mapper`."""

    @property
    def map(self) -> HybridMap:
        """What was mapped so far."""

    @property
    def last(self) -> NodeId | None:
        """The node from which the map goes on; None before there is one, or if the robot is lost."""

    def finish_pending(self) -> None:
        """Put into the map what is left of the last episode."""

    @property
    def typical_depth(self) -> float:
        """Median depth of the last node's landmarks, m."""

    @property
    def started(self) -> bool:
        """Whether there is an anchor view to map from."""

    @property
    def anchored(self) -> int:
        """Features of the anchor view that are still tracked."""

    @property
    def anchor_features(self) -> int:
        """Features that the anchor view had."""

    @property
    def anchor_from_robot(self) -> Pose2:
        """Pose since the anchor view."""

    @property
    def map_from_robot(self) -> PoseGaussian:
        """Pose in the agent's map."""

    @property
    def bearings(self) -> Array:
        """(N,) rad, bearings of the tracks, positive to the left."""

    @property
    def converged_share(self) -> float:
        """Share of the filter's landmarks whose depth has converged; 0 without landmarks."""
