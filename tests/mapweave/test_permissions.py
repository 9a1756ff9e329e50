"""Files and folders that the user may not use: one line says so, and what to do."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapweave.exit_status import FAILED
from tests.mapweave.command_line import CAMERA

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
    "a map": ["map", "show", "{secret}", "--no-picture"],
    "a map that is corrected": ["map", "retire", "r0.1", "--map", "{secret}"],
    "a map that is annotated": ["place", "add", "sink", "r0.1.1", "--map", "{secret}"],
    "a pose graph": ["map", "import", "{secret}", "--out", "x.g2o"],
    "a camera": ["relocalize", "{locked}/0.png", "--camera", "{secret}"],
    "an image": ["relocalize", "{secret}", "--camera", "{locked}/camera.toml"],
    "a bag": ["info", "{bag}"],
    "a video": ["replay", "{video}", "--camera", "{locked}/camera.toml", "--offline"],
    "a scenario": ["sim", "run", "{secret}"],
    "a plan": ["plan", "add", "{secret}", "--pair", "0,0=1,1", "--map", "{locked}/none.mapweave"],
    "a copy of a key": ["keys", "list", "--keys", "{hidden}"],
    "a picture": ["calibrate", "target", "--out", "{locked}/board.pdf"],
}


RUN = """
import json, os, sys, traceback
import mapweave.commands.calibrate_target
import mapweave.mapserver.server
import mapweave.processes.agent_process
from mapweave.cli import main

for number, words in enumerate(json.loads(sys.argv[1])):
    if not os.fork():
        os.chdir(str(number))
        os.dup2(os.open("stderr", os.O_CREAT | os.O_WRONLY), 2)
        try:
            status = main(words)
        except BaseException:
            traceback.print_exc()
            status = -1
        with open("status", "w") as file:
            file.write(str(status))
        sys.stderr.flush()
        os._exit(0)
    os.wait()
"""
"""Each command in a process of its own, in a folder of its own; what they import is imported once."""


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Path]]:
    folder = tmp_path_factory.mktemp("places")
    locked, secret = folder / "locked", folder / "secret.toml"
    locked.mkdir()
    secret.write_text("")
    cv2.imwrite(str(locked / "0.png"), np.full((48, 64), 90, np.uint8))
    (locked / "camera.toml").write_text(CAMERA)
    hidden = folder / "hidden"
    hidden.mkdir()
    (hidden / "fleet.json").write_text("{}")
    locked.chmod(0o555)
    bag, video = folder / "drive.mcap", folder / "drive.mp4"
    for one in (bag, video):
        one.touch()
    for one in (secret, bag, video):
        one.chmod(0)
    hidden.chmod(0)
    yield {"locked": locked, "secret": secret, "hidden": hidden, "bag": bag, "video": video}
    locked.chmod(0o755)
    hidden.chmod(0o755)


@pytest.fixture(scope="module")
def ended(places: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[int, str]]:
    """The exit status of each command, and what it printed on stderr."""
    if PLAIN and shutil.which("setpriv") is None:
        pytest.skip("needs setpriv")
    folder = tmp_path_factory.mktemp("commands")
    folders = [folder / str(number) for number in range(len(COMMANDS))]
    for one in folders:
        one.mkdir()
    words = [[word.format(**places) for word in command] for command in COMMANDS.values()]
    subprocess.run(
        [*PLAIN, sys.executable, "-c", RUN, json.dumps(words)], cwd=folder, timeout=120, check=True
    )
    return {
        name: (int((one / "status").read_text()), (one / "stderr").read_text())
        for name, one in zip(COMMANDS, folders, strict=True)
    }


@pytest.mark.parametrize("name", COMMANDS)
def test_what_the_user_may_not_do_is_one_line(
    name: str, places: dict[str, Path], ended: dict[str, tuple[int, str]]
):
    status, output = ended[name]
    (line,) = output.splitlines()
    assert WORDS in line and ADVICE in line and "Errno" not in line, line
    assert "copy it once more" not in line, "what cannot be read may be whole"
    assert any(str(place) in line for place in places.values())
    assert status == FAILED
