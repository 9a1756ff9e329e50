"""The list of what Mapweave is installed with, as `make sbom` writes it."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_the_sbom_lists_every_pinned_package_and_is_the_same_each_time(tmp_path: Path) -> None:
    tools = Path(sys.executable).parent
    if shutil.which("make") is None or not (tools / "cyclonedx-py").exists():
        pytest.skip("needs make, and the extra `audit`")
    made = [tmp_path / "first" / "sbom.json", tmp_path / "second" / "sbom.json"]
    for path in made:
        command = ["make", "-o", "setup", "sbom", f"BIN={tools}", f"SBOM={path}"]
        subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    assert made[0].read_bytes() == made[1].read_bytes()
    content = json.loads(made[0].read_text())
    assert content["bomFormat"] == "CycloneDX" and content["metadata"]["component"]["name"] == "mapweave"
    pinned = [
        line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line
    ]
    listed = {(component["name"], component["version"]) for component in content["components"]}
    assert listed == {(name, version) for name, version in pinned} and len(pinned) > 50
