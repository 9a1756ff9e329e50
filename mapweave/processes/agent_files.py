"""The files that an agent writes beside its journal: one map file a map, and where the robot was."""

from pathlib import Path

from mapweave.hybridmap.ids import MapId, read_number


def map_path(folder: Path, map_id: MapId) -> Path:
    """Where an agent writes a map: one file a map, for example `r0.3.mapweave`."""
    return folder / f"{map_id}.mapweave"


def trajectory_path(folder: Path, map_id: MapId) -> Path:
    """Where an agent writes where it was at each observation, for example `r0.3.tum`."""
    return folder / f"{map_id}.tum"


def views_path(folder: Path, agent: str) -> Path:
    """Where an agent keeps images of its nodes, for example `r0.views/r0.3.17.jpg`."""
    return folder / f"{agent}.views"


def learned_path(folder: Path, agent: str) -> Path:
    """Where an agent keeps what it has learned of its geometry, for example `r0.learned.toml`."""
    return folder / f"{agent}.learned.toml"


def epochs_of_files(folder: Path, agent: str) -> list[int]:
    """Numbers of the maps of an agent that have a file in a folder."""
    numbers = (read_number(path.name.split(".")[1]) for path in folder.glob(f"{agent}.*.mapweave"))
    return [number for number in numbers if number is not None]
