"""`--json`: one object, the last line on stdout, of every command whose answer a script reads."""

import json
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from mapweave import MapId, read_map_file
from mapweave.cli import main
from mapweave.doctor import camera
from mapweave.exit_status import USAGE
from synthetic.maps import looked_around, write_store
from tests.mapweave.command_line import commands, parsers
from tests.mapweave.test_find_devices import plugged, video  # noqa: F401
from tests.mapweave.test_record import driver  # noqa: F401

OTHERWISE = {
    "agent", "server", "router", "sim serve",  # processes: `--log-format json`
    "open", "drive",  # for a person
    "settings", "completion",  # files
}  # fmt: skip

Answer = Callable[..., dict[str, Any]]


@pytest.fixture
def answer(capsys: pytest.CaptureFixture[str]) -> Answer:
    """The object that a command prints, and nothing beside it."""

    def ask(*words: object, status: int = 0) -> dict[str, Any]:
        capsys.readouterr()
        assert main([*map(str, words), "--json"]) == status
        out = capsys.readouterr().out
        assert out.count("\n") == 1 and out.endswith("\n")
        values = json.loads(out)
        assert isinstance(values, dict)
        return values

    return ask


@pytest.fixture
def store(tmp_path: Path) -> Path:
    return write_store(tmp_path / "s0.sqlite", looked_around((MapId("r0", 1), MapId("r1", 1)), seed=8))


def test_every_command_has_it_but_for_processes_and_what_people_look_at():
    without = {words for words in commands(runnable=True) if "--json" not in parsers()[words].format_help()}
    assert without == OTHERWISE


def test_keys(answer: Answer, tmp_path):
    folder = ["--keys", tmp_path / "keys"]
    made = answer("keys", "init", "--fleet", "office", "--at", "10.0.0.1", *folder)
    assert (made["fleet"], made["profile"], made["folder"]) == ("office", "production", str(folder[1]))
    assert any("10.0.0.1" in endpoint for endpoint in made["endpoints"])
    key = answer("keys", "add", "anna", "--role", "operator", *folder)
    assert Path(key["file"]).is_file() and (key["name"], key["role"]) == ("anna", "operator")
    (anna,) = (one for one in answer("keys", "list", *folder)["identities"] if one["name"] == "anna")
    assert key["expires"][:10] == anna["expires"][:10]
    token = answer("keys", "token", "anna", *folder)
    assert token["name"] == "anna" and len(token["token"]) > 20
    copy = answer("keys", "bundle", "anna", "-o", tmp_path / "anna.key", *folder)
    assert copy == {"said": copy["said"], "file": str(tmp_path / "anna.key"), "name": "anna"}
    assert "void" in answer("keys", "revoke", "anna", "--tokens", *folder)["said"]
    assert answer("keys", "revoke", "anna", *folder)["name"] == "anna"


def test_maps(answer: Answer, store: Path, tmp_path):
    backup = answer("map", "backup", store, "-o", tmp_path / "copy.sqlite")
    assert backup["file"] == str(tmp_path / "copy.sqlite")
    assert backup["bytes"] == (tmp_path / "copy.sqlite").stat().st_size
    exported = answer("map", "export", store, "--format", "g2o", "-o", tmp_path / "a.g2o")
    assert (exported["files"], exported["component"]) == ([str(tmp_path / "a.g2o")], 0)
    assert (exported["nodes"], exported["left_out"]) == (8, 0)
    folder = tmp_path / "tum"
    exported = answer("map", "export", store, "--format", "tum", "-o", folder)
    assert exported["files"] == sorted(map(str, folder.iterdir()))


def test_recordings(answer: Answer, recording: Path, driver: str, tmp_path):  # noqa: F811
    out = tmp_path / "drive"
    nowhere = ["--robot", driver, "--connect", "tcp/127.0.0.1:1"]
    made = answer("record", "r0", "--out", out, "--lossless", *nowhere)
    assert (made["robot"], made["folder"], made["observations"], made["whole"]) == ("r0", str(out), 20, True)
    data = tmp_path / "data"
    played = answer("replay", recording, "--offline", "--data", data, "--name", "r7")
    assert (played["robot"], played["images"], played["played"], played["damage"]) == ("r7", 3, 3, [])
    (one,) = played["maps"]
    assert one["map"] == "r7.1" and read_map_file(Path(one["path"])).title == "r7.1"
    assert [
        one["map"] for one in answer("replay", recording, "--offline", "--data", data, "--name", "r7")["maps"]
    ] == ["r7.2"]


def test_devices(
    answer: Answer,
    plugged: Any,  # noqa: F811
    tmp_path,
    monkeypatch,
):
    devices, _ = plugged
    found = answer("find-port")
    assert [port["path"] for port in found["ports"]] == [f"{devices}/ttyACM3", f"{devices}/ttyUSB0"]
    assert found["unplugged"] == [] and found["ports"][1]["stable"] == ""
    monkeypatch.setattr(camera, "SECONDS", 1.0)
    file = video(tmp_path / "a.avi", (64, 48), 1)
    seen = answer("find-cameras", file, "-o", tmp_path / "frames")["cameras"][-1]
    assert (seen["source"], seen["width"], seen["height"], seen["fault"]) == (str(file), 64, 48, None)
    assert Path(seen["frame"]).is_file() and seen["images_per_second"] > 0.0
    target = tmp_path / "board.pdf"
    assert answer("calibrate", "target", "-o", target)["file"] == str(target) and target.is_file()


def test_portals(answer: Answer, monkeypatch):
    fleet = SimpleNamespace(portal_done=lambda robot: f"{robot} looks where it is")
    monkeypatch.setattr("mapweave.commands.portal.fleet_of", lambda _: nullcontext(fleet))
    assert answer("portal", "done", "r0") == {"said": "r0 looks where it is", "robot": "r0"}


def test_what_is_refused_prints_nothing_on_stdout(capsys, tmp_path):
    assert main(["keys", "add", "r0", "--at", "here", "--json", "--keys", str(tmp_path)]) == USAGE
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
