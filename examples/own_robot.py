"""A driver of your own: `mapweave agent r0 --settings robot.toml --robot examples/own_robot.py:OwnRobot`.

This robot's motor board takes `V left right` (mm/s), answers `R` with `R left right` (encoder steps), and
stops the wheels by itself 250 ms after the last `V`. A board that does not do so needs a `WheelGuard`.
The settings give `port` in `[robot.options]`, `[robot.camera]` and `[robot.geometry]`, see docs/drivers.md.
"""

from mapweave.agent.drivers.base import BaseReading, Wheels
from mapweave.agent.drivers.serial_base import SerialBase
from mapweave.agent.drivers.settings import Geometry, RobotSettings
from mapweave.agent.drivers.wheeled import WheeledRobot


class Board(SerialBase):
    geometry = Geometry(radius=0.12, axle=0.15, max_forward=0.3, max_turn=0.8)
    baud, metres_per_count = 57600, 0.0002

    def drive(self, speeds: Wheels) -> None:
        self.send(f"V {1000 * speeds.left:.0f} {1000 * speeds.right:.0f}")

    def read(self) -> BaseReading:
        return BaseReading(self.way(*self.ask("R", "R", 2)))


class OwnRobot(WheeledRobot):
    def __init__(self, settings: RobotSettings) -> None:
        super().__init__(Board(settings), settings)  # which adds camera, stamps and threads
