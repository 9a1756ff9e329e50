"""Events of a simulated world and its robots, made from tables of a scenario file."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from msgspec import Meta

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.limits import Coordinate
from mapweave.storage.settings_file import build

LONGEST = 1e6
"""No event takes longer, s."""
Duration = Annotated[float, Meta(ge=0.1, le=LONGEST)]
"""s."""


@dataclass(frozen=True)
class Kidnap:
    """A robot is picked up and put down elsewhere; its encoders do not notice.

    Either `x` and `y`, or `near` another robot, or a `room` give the place: then the place and, if none
    is given, the heading come from the seed.

    Attributes:
        robot: name.
        x: m, in world.
        y: m, in world.
        heading: rad.
        near: name of a robot, beside which it is put.
        room: name of a room of the floor plan.
    """

    robot: str
    x: Coordinate | None = None
    y: Coordinate | None = None
    heading: Coordinate | None = None
    near: str = ""
    room: str = ""

    def __post_init__(self) -> None:
        """Refuse none, and more than one, of x with y, near and room (InvalidValue)."""
        point = self.x is not None and self.y is not None
        half = (self.x is None) != (self.y is None)
        if half or point + bool(self.near) + bool(self.room) != 1:
            raise InvalidValue("kidnap: say where, by x and y, or near = a robot, or room = its name")


@dataclass(frozen=True)
class Light:
    """All lamps change.

    Attributes:
        factor: brightness afterwards, 1 as at the beginning.
        seconds: how long the change takes, s.
    """

    factor: Annotated[float, Meta(ge=0.0, le=20.0)]
    seconds: Annotated[float, Meta(ge=0.0, le=LONGEST)] = 0.0


@dataclass(frozen=True)
class Walk:
    """A person or thing goes to and fro for a while, then leaves.

    Attributes:
        what: "person" or "box".
        near: name of a robot: the path leads past its camera, 1 to 2.5 m ahead where there is room.
        path: ((x m, y m), ...) in world, instead of `near`.
        speed: m/s.
        seconds: for how long, s.
    """

    what: str = "person"
    near: str = ""
    path: tuple[tuple[Coordinate, Coordinate], ...] = ()
    speed: Annotated[float, Meta(ge=0.01, le=2.0)] = 0.7
    seconds: Duration = 15.0

    def __post_init__(self) -> None:
        """Refuse an unknown kind, no path or two, and too short or long a path (InvalidValue)."""
        if self.what not in ("person", "box"):
            raise InvalidValue(f"walk: what = {self.what!r}; known are person, box")
        if bool(self.near) == bool(self.path):
            raise InvalidValue("walk: say where, by near = a robot or by path = [[x, y], ...]")
        if self.path and not 2 <= len(self.path) <= 1000:
            raise InvalidValue("walk: a path has 2 to 1000 points")


@dataclass(frozen=True)
class MoveFurniture:
    """Some furniture moves to other places.

    Attributes:
        share: of the pieces, more than 0.
    """

    share: Annotated[float, Meta(ge=1e-3, le=1.0)] = 0.3


WAYS_TO_FAIL: dict[str, dict[str, tuple[float, float, float]]] = {
    "camera": {"drop": (0, 0, 0), "blocked": (0, 0, 255), "freeze": (0, 0, 0)},
    "encoders": {
        "zero": (0, 0, 0), "zero_left": (0, 0, 0), "zero_right": (0, 0, 0),
        "spike": (0.3, -100, 100), "scale": (0.1, -1, 10),
    },
    "rangers": {"spike": (0.1, 0, 1), "drop": (0, 0, 0)},
    "bumper": {"stuck": (0, 0, 0), "dead": (0, 0, 0)},
}  # fmt: skip
"""By sensor and way: the amount if none is given, and the least and the largest."""


@dataclass(frozen=True)
class Fail:
    """A sensor fails for a while.

    - camera: `drop` no frames, `blocked` something covers the lens (`amount` its grey level), `freeze` the
      same image again and again.
    - encoders: `zero` neither wheel counts, `zero_left`, `zero_right`; `spike` one jump of `amount` m ahead;
      `scale` both count `amount` too much, as a share.
    - rangers: `spike` a share `amount` of the readings is short at random; `drop` all read their maximum.
    - bumper: `stuck` always pressed, `dead` never.

    Attributes:
        robot: name.
        sensor: camera, encoders, rangers or bumper.
        how: see above.
        seconds: how long, s.
        amount: see above.
    """

    robot: str
    sensor: str
    how: str
    seconds: Duration = 5.0
    amount: float | None = None

    def __post_init__(self) -> None:
        """Refuse an unknown sensor or way to fail, and an amount out of range (InvalidValue)."""
        if self.sensor not in WAYS_TO_FAIL:
            raise InvalidValue(f"fail: no sensor {self.sensor!r}; there are {', '.join(WAYS_TO_FAIL)}")
        ways = WAYS_TO_FAIL[self.sensor]
        if self.how not in ways:
            raise InvalidValue(
                f"fail: {self.sensor} cannot fail by how = {self.how!r}; known are {', '.join(ways)}"
            )
        least, most = ways[self.how][1:]
        if self.amount is not None and not least <= self.amount <= most:
            raise InvalidValue(f"fail: amount is {self.amount:g}, must be between {least:g} and {most:g}")

    @property
    def size(self) -> float:
        """The amount, or the default."""
        return WAYS_TO_FAIL[self.sensor][self.how][0] if self.amount is None else self.amount


SimEvent = Kidnap | Light | Walk | MoveFurniture | Fail

KINDS: dict[str, type[SimEvent]] = {
    "kidnap": Kidnap,
    "light": Light,
    "walk": Walk,
    "move_furniture": MoveFurniture,
    "fail": Fail,
}
"""By the `do` of an event's table."""


def parse_event(table: Mapping[str, Any], where: str = "event") -> SimEvent:
    """Make an event from its table: `do` names the kind, the rest are its fields.

    Raises:
        InvalidValue: an unknown kind, or a value out of range.
        SettingsError: an unknown field, or a value of the wrong kind.
    """
    values = dict(table)
    kind = values.pop("do", None)
    if not isinstance(kind, str) or kind not in KINDS:
        raise InvalidValue(f"{where}: do = {kind!r}; known are {', '.join(KINDS)}")
    return build(KINDS[kind], values, f"{where}: {kind}")
