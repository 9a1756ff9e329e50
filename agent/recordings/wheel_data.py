"""How a robot's wheels err, in the `custom_data` of a bag's metadata.yaml: no standard message has it."""

from collections.abc import Mapping
from dataclasses import dataclass

import msgspec

from mapweave.agent.observation import Length, RobotDescription
from mapweave.hybridmap.limits import Share
from mapweave.wire.conversion import convert

KEYS = {"axle": "mapweave.axle_m", "wheel_noise": "mapweave.wheel_noise", "side_slip": "mapweave.side_slip"}
"""Key by field."""


@dataclass(frozen=True, slots=True)
class WheelModel:
    """What the filters must know of wheels; see RobotDescription.

    Attributes:
        axle: distance between the wheels, m.
        wheel_noise: standard deviation of a wheel's way, as a share of the way.
        side_slip: standard deviation of the slip aside in a step, as a share of the way.
    """

    axle: Length
    wheel_noise: Share
    side_slip: Share


def wheel_data(description: RobotDescription) -> dict[str, str]:
    """What goes into the metadata of a robot's recording."""
    return {key: repr(float(getattr(description, field))) for field, key in KEYS.items()}


def wheels_of(custom_data: object) -> WheelModel | None:
    """The wheels that the metadata of a bag give; None if they do not.

    Args:
        custom_data: from strings to strings, as it was read.

    Raises:
        ValueError: a value is missing, is no number, or cannot be right.
    """
    if not isinstance(custom_data, Mapping) or not custom_data.keys() & set(KEYS.values()):
        return None
    try:
        values = {field: float(custom_data[key]) for field, key in KEYS.items()}
        return convert(values, WheelModel)  # type: ignore[no-any-return]
    except KeyError as missing:
        raise ValueError(f"its metadata.yaml lacks {missing.args[0]}") from None
    except (TypeError, ValueError, msgspec.ValidationError):
        given = ", ".join(f"{key} {custom_data[key]!r}" for key in KEYS.values())
        raise ValueError(f"its metadata.yaml gives what no wheels can have: {given}") from None
