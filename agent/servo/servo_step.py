"""What a servo decides in one tick."""

from dataclasses import dataclass
from typing import Literal

from mapweave.agent.observation import Command

State = Literal["driving", "turning", "retreating", "arrived", "stuck"]
"""What the robot does: `stuck` means that no way is known now; the caller may try something else."""


@dataclass(frozen=True, slots=True)
class ServoStep:
    """One tick of `Servo` or `OdometryDrive`.

    Attributes:
        command: for the wheels.
        state: what the robot does.
        law: 0 to 4 while one of the paper's five laws drives (charts 1 to 5), None otherwise.
        reason: why, in words.
    """

    command: Command
    state: State
    law: int | None
    reason: str
