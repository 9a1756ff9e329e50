"""Keeps the picture of a demo as `demo.png`. A demo takes minutes, so the pages' build does not run one.

python -m docs.site.demo_picture          # runs a demo first
python -m docs.site.demo_picture FOLDER   # the folder of one that has run, as `make demo` leaves out/demo
"""

import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

PATH = Path(__file__).parents[1] / "demo.png"


def keep(folder: Path, path: Path = PATH) -> None:
    """Take over the picture of a demo in which the lost robot arrived.

    Raises:
        ValueError: it did not.
        FileNotFoundError: there is no demo in the folder.
    """
    if not json.loads((folder / "report.json").read_text(encoding="utf-8"))["goal"]["reached"]:
        raise ValueError(f"{folder}: the lost robot has not arrived: the picture stays as it is")
    shutil.copyfile(folder / "map.png", path)


def main(arguments: Sequence[str]) -> None:
    """Run a demo, or take one that has run."""
    if arguments:
        keep(Path(arguments[0]))
        return
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, "-m", "mapweave", "demo", "--out", folder], check=True)
        keep(Path(folder))


if __name__ == "__main__":
    main(sys.argv[1:])
