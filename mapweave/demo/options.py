"""What a demo is asked to do."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mapweave.hybridmap.errors import SettingsError


@dataclass(frozen=True)
class DemoOptions:
    """Options of one demo.

    Attributes:
        seed: of the world, the start places, faults and noise.
        robots: how many map; the first is kidnapped.
        rooms: along the corridor.
        out: folder for everything that is made; earlier demos in it are replaced.
        film_every: simulated seconds between two frames of the film; 0 makes none.
        quiet: no progress on the terminal.
    """

    seed: int = 0
    robots: int = 3
    rooms: int = 3
    out: Path = Path("out/demo")
    film_every: float = 1.0
    quiet: bool = False

    def __post_init__(self) -> None:
        """Refuse too few or too many robots or rooms (SettingsError)."""
        if not 2 <= self.robots <= 16:
            raise SettingsError(f"--robots {self.robots}: the demo needs 2 to 16")
        if not 3 <= self.rooms <= 12:
            raise SettingsError(f"--rooms {self.rooms}: the demo needs 3 to 12")
        if self.seed < 0:
            raise SettingsError(f"--seed {self.seed}: use 0 or more")
