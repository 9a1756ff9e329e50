"""What robots have learned of their geometry on earlier drives, and will use at their next start."""

from collections.abc import Iterator
from pathlib import Path

from mapweave.doctor.finding import Finding, good, wrong

SUBJECT = "learned geometry"


def examine(data: Path) -> Iterator[Finding]:
    """One finding for each robot that has a file in the folder of its map."""
    from mapweave.agent.recordings.learned_file import read_learned
    from mapweave.hybridmap.errors import MapweaveError
    from mapweave.processes.agent_files import learned_path
    from mapweave.processes.learned_geometry import said

    for path in sorted(data.glob(learned_path(Path(), "*").name)):
        robot = path.name.removesuffix(learned_path(Path(), "").name)
        try:
            read = read_learned(path)
        except MapweaveError as error:
            yield wrong(SUBJECT, f"{error}; {robot} does not use it", f"rm {path}")
            continue
        if read is not None:
            yield good(SUBJECT, f"{robot}: {said(*read, path)}")
