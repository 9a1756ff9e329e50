"""What behaviours may ask of the mapper: they never change the map themselves."""

from enum import Enum, auto

from mapweave.agent.observation import Command


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
