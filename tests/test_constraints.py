"""constraints.txt pins what every Python that the project promises can install."""

import re
import tomllib
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path

from packaging.specifiers import SpecifierSet

ROOT = Path(__file__).parents[1]


def test_what_is_pinned_installs_on_the_oldest_python():
    """Debian 12 and Raspberry Pi OS have Python 3.11.2: a release for 3.11.5 alone made `make demo` fail."""
    promised = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["requires-python"]
    oldest = f"{promised.removeprefix('>=')}.0"
    checked = 0
    for name, version in re.findall(r"^(\S+)==(\S+)$", (ROOT / "constraints.txt").read_text(), re.MULTILINE):
        try:
            installed = metadata(name)
        except PackageNotFoundError:
            continue
        if installed["Version"] == version:
            needs = installed.get("Requires-Python", "")
            assert SpecifierSet(needs).contains(oldest), f"{name} {version} needs Python {needs}"
            checked += 1
    assert checked > 10


def test_all_files_promise_the_same_python():
    """README, the package's metadata and `make`; mypy checks for the oldest one."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    oldest = project["project"]["requires-python"].removeprefix(">=")
    named = re.findall(r"Python :: (3\.\d+)", "\n".join(project["project"]["classifiers"]))
    assert (named[0], project["tool"]["mypy"]["python_version"]) == (oldest, oldest)
    readme = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    tried = " and ".join(named[1:])
    assert f"Python {oldest} or newer. Each change is tested on {oldest}; {tried} have been tried" in readme
    assert f"Mapweave needs Python {oldest} or newer" in (ROOT / "Makefile").read_text()
