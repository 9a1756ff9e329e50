"""Files and folders that the user may not use: one line says so, and what to do."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from mapweave.exit_status import FAILED

WORDS = "permission denied to user "
ADVICE = "give a place of your own, or change the owner or mode of this one (chown, chmod)"
PLAIN = [] if os.geteuid() else ["setpriv", "--bounding-set=-all", "--inh-caps=-all"]
"""Root may write everywhere but without its capabilities."""
COMMANDS = {
    "the store": ["server", "--data", "{locked}", "--listen", "tcp/127.0.0.1:0"],
    "a folder in it": ["server", "--data", "{locked}/new", "--listen", "tcp/127.0.0.1:0"],
    "keys": ["keys", "init", "--at", "10.0.0.5", "--keys", "{locked}/keys"],
    "a key file": ["status", "--keys", "{secret}"],
    "settings": ["agent", "r0", "--settings", "{secret}"],
    "a picture": ["calibrate", "target", "--out", "{locked}/board.pdf"],
}


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Path]]:
    folder = tmp_path_factory.mktemp("places")
    locked, secret = folder / "locked", folder / "secret.toml"
    locked.mkdir()
    secret.write_text("")
    locked.chmod(0o555)
    secret.chmod(0)
    yield {"locked": locked, "secret": secret}
    locked.chmod(0o755)


@pytest.mark.skipif(PLAIN != [] and shutil.which("setpriv") is None, reason="needs setpriv")
@pytest.mark.parametrize("name", COMMANDS)
def test_what_the_user_may_not_do_is_one_line(name: str, places: dict[str, Path], tmp_path: Path) -> None:
    words = [word.format(**places) for word in COMMANDS[name]]
    done = subprocess.run(
        [*PLAIN, sys.executable, "-m", "mapweave", *words],
        cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    (line,) = done.stderr.splitlines()
    assert WORDS in line and ADVICE in line and "Errno" not in line, line
    assert str(places["locked"]) in line or str(places["secret"]) in line
    assert done.returncode == FAILED
