"""ARCHITECTURE.md names files that are there."""

import re
from pathlib import Path, PurePath

ROOT = Path(__file__).parents[1]
FILE = re.compile(r"`([\w./-]+\.(?:py|js|toml))`")


def missing(row: str) -> list[str]:
    """What a row names that is not there: a bare name is in the folder of one that it names before."""
    lost, folders = list[str](), [""]
    for name in FILE.findall(row):
        places = [PurePath(name), *(PurePath(folder, name) for folder in folders)]
        found = [place for place in places if (ROOT / place).is_file()]
        if found:
            folders.append(str(found[0].parent))
        else:
            lost.append(name)
    return lost


def test_every_file_that_it_names_is_there():
    page = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    assert len(FILE.findall(page)) > 300
    assert not [name for row in page.splitlines() for name in missing(row)]


def test_the_drawing_has_the_names_of_files_and_folders():
    page = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    drawing = page.partition("## Data flow\n\n```\n")[2].partition("```")[0]
    names = re.findall(r"[\w/]+\.py|\b[a-z]+/(?!\w)", drawing)
    assert len(names) > 15
    assert not [
        name
        for name in names
        if not [*ROOT.glob(f"*/{name}"), *ROOT.glob(f"*/*/{name}")] and not (ROOT / name).exists()
    ]
