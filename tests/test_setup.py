"""`make setup` and `make audit` where something is missing, with scripts in the place of Python and tools."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.wire import test_codec

MAKEFILE = Path(__file__).parents[1] / "Makefile"

PYTHON = """#!/bin/sh
# Makes environments; those without pip where there is a file `lacking`, as Debian's without its package.
case "$2" in venv)
  mkdir -p "$3/bin"
  if test -e lacking; then what="No module named pip"; else what=""; fi
  printf '#!/bin/sh\\nwhat="%s"\\n. ./environment\\n' "$what" > "$3/bin/python"
  chmod +x "$3/bin/python"
  test -z "$what"
esac
"""

ENVIRONMENT = """
if test -n "$what"; then echo "$what" >&2; exit 1; fi
case "$*" in
  *install*) if test -e misconfigured; then echo "Configuration file could not be loaded." >&2; exit 1; fi;;
esac
case "$*" in
  *only-binary*)
    test -e offline && echo "WARNING: Retrying after connection broken" >&2
    test -e wheel || { echo "ERROR: No matching distribution found for pybullet" >&2; exit 1; };;
  *install*) if test -e offline; then exit 1; fi;;
esac
"""


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    shutil.copy(MAKEFILE, tmp_path)
    for name, text in (("python", PYTHON), ("environment", ENVIRONMENT)):
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o755)
    for name in ("pyproject.toml", "constraints.txt", "wheel"):
        (tmp_path / name).touch()
    return tmp_path


def _environment() -> dict[str, str]:
    """That of this process without what another make has put there."""
    return {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}


def setup(checkout: Path) -> tuple[int, str]:
    """Exit status and output."""
    ran = subprocess.run(
        ["make", "setup", f"PYTHON={checkout / 'python'}"],
        cwd=checkout, env=_environment(), capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    return ran.returncode, ran.stdout + ran.stderr


def test_an_environment_that_was_left_without_pip_is_completed(checkout: Path):
    """Debian's Python said which package to install. When that was there, make said: No module named pip."""
    (checkout / "lacking").touch()
    assert setup(checkout)[0] != 0
    (checkout / "lacking").unlink()
    status, said = setup(checkout)
    assert status == 0, said


def test_a_missing_network_is_not_taken_for_a_missing_wheel(checkout: Path):
    (checkout / "wheel").unlink()
    status, said = setup(checkout)
    assert status == 0 and "there is no wheel of pybullet" in said, said
    for path in checkout.glob(".venv/.installed*"):
        path.unlink()
    (checkout / "offline").touch()
    status, said = setup(checkout)
    assert status != 0 and "wheel" not in said, said


def test_settings_of_pip_that_cannot_be_read_are_not_taken_for_a_missing_wheel(checkout: Path):
    (checkout / "misconfigured").touch()
    status, said = setup(checkout)
    assert status != 0 and "could not be loaded" in said and "wheel" not in said, said


def test_the_property_that_is_run_once_before_all_tests_is_there():
    """Without one, each process of pytest looks for the constants of all modules, which takes two seconds."""
    (name,) = re.findall(r"-m pytest -k (\w+)", MAKEFILE.read_text(encoding="utf-8"))
    test = vars(test_codec)[name]
    assert test.is_hypothesis_test


@pytest.mark.slow
def test_what_was_skipped_is_said_in_one_line_for_each_reason():
    """Without a browser all tests are green; how many were left out, and why, must be seen.

    A process of its own runs them, as in `make test`, and another one says it.
    """
    tests = [f"tests/mapserver/http/{name}.py" for name in ("test_page_robots", "test_page_connection")]
    environment = {**os.environ, "PATH": ""}
    ran = subprocess.run(
        [sys.executable, "-m", "pytest", *tests, "-n", "1"],
        cwd=MAKEFILE.parent,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    (line,) = (line for line in ran.stdout.splitlines() if line.startswith("skipped "))
    count = sum((MAKEFILE.parent / name).read_text(encoding="utf-8").count("\ndef test_") for name in tests)
    assert line == f"skipped {count}: needs chromium and chromedriver on the PATH"


@pytest.mark.parametrize(("status", "found", "said", "words"), [
    (0, "", "No known vulnerabilities found", "no known vulnerabilities"),
    (1, "anyio 4.16.0 PYSEC-1", "Found 1 known vulnerability", "anyio 4.16.0 PYSEC-1"),
    (1, "", "Traceback:\n  a step\nProxyError: refused", "cannot be looked up: ProxyError: refused"),
], ids=["nothing", "found", "no-network"])  # fmt: skip
def test_an_audit_says_in_one_line_what_it_has_found_or_why_it_cannot(
    tmp_path, status: int, found: str, said: str, words: str
):
    """Without its service it printed fifty lines."""
    for name in ("pyproject.toml", "constraints.txt", "stamp", "audit/bin/pip-audit", "audit/.installed"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    tool = tmp_path / "audit" / "bin" / "pip-audit"
    (tmp_path / "audit" / "words").write_text(said)
    tool.write_text(f"#!/bin/sh\nprintf %s '{found}'\ncat audit/words >&2\nexit {status}\n")
    tool.chmod(0o755)
    ran = subprocess.run(
        ["make", "-f", MAKEFILE, "-s", "audit", "STAMP=stamp", "AUDIT=audit"],
        cwd=tmp_path, env=_environment(), capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert ran.returncode == (2 if status else 0)
    assert words in ran.stdout and len(ran.stdout.splitlines()) == 1
    assert "Traceback" not in ran.stderr
