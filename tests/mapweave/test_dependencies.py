"""What Mapweave is installed with: the list of it, as `make sbom` writes it, and what it must not be."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.programs import python

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_the_sbom_lists_every_pinned_package_and_is_the_same_each_time(tmp_path):
    tools = Path(sys.prefix) / "audit"
    if shutil.which("make") is None or not (tools / ".installed").exists():
        pytest.skip("needs make, and what `make sbom` installs")
    made = [tmp_path / "first" / "sbom.json", tmp_path / "second" / "sbom.json"]
    for path in made:
        command = ["make", "-o", str(tools / ".installed"), "sbom", f"AUDIT={tools}", f"SBOM={path}"]
        subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    assert made[0].read_bytes() == made[1].read_bytes()
    content = json.loads(made[0].read_text())
    assert content["bomFormat"] == "CycloneDX" and content["metadata"]["component"]["name"] == "mapweave"
    pinned = [
        line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line
    ]
    listed = {(component["name"], component["version"]) for component in content["components"]}
    assert listed == {(name, version) for name, version in pinned} and len(pinned) > 50


@pytest.mark.slow
def test_ray_is_imported_without_a_grammar_of_addresses():
    """It takes 1.6 s of 3; a node of a cluster that has no 15 s for its processes does not start."""
    pytest.importorskip("ray", reason="needs the extra `cluster`")
    code = "import ray, sys; print('rfc3987_syntax' in sys.modules)"
    assert python("-c", code, check=True, timeout=None).stdout == "False\n"
