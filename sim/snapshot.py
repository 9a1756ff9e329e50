"""The simulation at one moment, for film and live view."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.limits import Name, Number, Stamp
from mapweave.hybridmap.pose import Pose2
from mapweave.sim.floorplan import Rectangle


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The view from above, and the robots' last images.

    Attributes:
        tick: ticks that are over.
        stamp_ns: the simulation's time.
        robots: `world_from_robot`, true, by name.
        actors: people and boxes that move, with what they are as names.
        furniture: of the floor plan as it is now.
        images: (H, W) grey, by robot, as its camera gave it last; None if it gave none.
    """

    tick: Number
    stamp_ns: Stamp
    robots: Mapping[Name, Pose2]
    actors: tuple[Rectangle, ...]
    furniture: tuple[Rectangle, ...]
    images: Mapping[Name, NDArray[np.uint8] | None]
