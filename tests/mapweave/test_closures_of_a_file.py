"""`mapweave close` and `reopen` of a map file: which entry of the record is meant."""

import json
from pathlib import Path
from typing import Any

from mapweave import MapId, read_map_file
from mapweave.cli import main
from mapweave.exit_status import NO
from mapweave.hybridmap.annotation import Annotations, Closure
from synthetic.maps import looked_around, write_store


def map_of(robot: str, folder: Path) -> Path:
    store, path = (
        write_store(folder / "s0.sqlite", looked_around([MapId(robot, 1)], seed=8)),
        folder / "a.mapweave",
    )
    assert main(["map", "merge", str(store), "-o", str(path)]) == 0
    return path


def closed(path: Path) -> int:
    return len(Annotations(read_map_file(path).annotations).in_force(Closure))


def test_a_second_way_of_a_long_named_robot_reopens_no_first(tmp_path):
    """Names of two nodes were cut to the 64 characters of a name, and were one."""
    robot = "a-robot-with-a-very-long-name-32"
    path = map_of(robot, tmp_path)
    first, second, third = (f"{robot}.1.{number}" for number in (1, 3, 5))
    assert main(["close", first, second, "--map", str(path)]) == 0
    assert main(["close", first, third, "--map", str(path)]) == 0
    assert closed(path) == 2
    assert main(["reopen", second, first, "--map", str(path)]) == 0
    assert main(["reopen", second, first, "--map", str(path)]) == NO
    assert closed(path) == 1


def test_a_way_is_open_when_it_was_reopened_whichever_end_was_named_first(tmp_path):
    path, ends = map_of("r0", tmp_path), ["r0.1.1", "r0.1.3"]
    for there in (ends, ends[::-1]):
        assert main(["close", *there, "--map", str(path)]) == 0
        assert main(["reopen", *ends, "--map", str(path)]) == 0
        assert closed(path) == 0
    assert main(["close", *ends, "--map", str(path)]) == 0
    assert main(["close", *ends[::-1], "--map", str(path), "--name", " ".join(ends[::-1])]) == 0
    assert main(["reopen", *ends, "--map", str(path)]) == 0
    assert closed(path) == 0


def test_what_a_retirement_leaves_without_effect_is_named(tmp_path, capfd):
    """Closures were listed as closed, and no longer held."""
    path = map_of("r0", tmp_path)
    at = ["--map", str(path)]
    assert main(["close", "r0.1.1", "r0.1.3", *at]) == 0
    assert main(["avoid", "r0.1.5", "--radius", "0.1", *at]) == 0
    capfd.readouterr()
    assert main(["map", "retire", "r0.1.1", "--check", *at]) == 0
    assert capfd.readouterr().out.endswith("; without effect as long as it holds: closure r0.1.1 r0.1.3\n")
    assert main(["closures", *at]) == 0
    assert "without effect" not in capfd.readouterr().out
    assert main(["map", "retire", "r0.1", *at]) == 0
    lost = "without effect as long as it holds: closure r0.1.1 r0.1.3, preference r0.1.5"
    assert lost in capfd.readouterr().out
    assert main(["closures", *at]) == 0
    lines = capfd.readouterr().out.splitlines()
    assert all("; without effect: node r0.1." in line and "is retired by" in line for line in lines)
    assert len(lines) == 2
    # What has none already is not named again.
    assert main(["map", "retire", "r0.1", "--undo", *at]) == 0
    assert "without effect" not in capfd.readouterr().out


def test_what_a_person_says_is_said_again_for_a_script(tmp_path, capfd):
    at = ["--map", str(map_of("r0", tmp_path)), "--json"]

    def said(*words: str) -> dict[str, Any]:
        capfd.readouterr()
        assert main([*words, *at]) == 0
        out: dict[str, Any] = json.loads(capfd.readouterr().out)
        return out

    assert said("floor", "list") == {"floors": []}
    assert said("floor", "ground", "r0.1.3")["said"].startswith("floor r0.1 is on floor ground")
    (entry,) = said("floor", "list")["floors"]
    assert entry["name"] == "r0.1" and entry["body"]["label"] == "ground"
    assert said("close", "r0.1.1", "r0.1.3", "--until", "2099-01-01")["said"].startswith("closure ")
    assert said("reopen", "r0.1.1", "r0.1.3")["said"].startswith("closure ")
    assert said("prefer", "r0.1.1", "r0.1.3")["said"].startswith("preference ")
    assert said("place", "add", "kitchen", "r0.1.3")["said"].startswith("place kitchen is node r0.1.3")
    assert said("place", "remove", "kitchen")["said"].startswith("place kitchen")
    assert main(["floor", "list", *at[:2]]) == 0
    assert capfd.readouterr().out.startswith("floor r0.1 is on floor ground")


def test_links_between_floors_are_named_only_where_there_are_two(tmp_path, capfd):
    """With one label in all, it was said that links between floors fall."""
    store = write_store(tmp_path / "s0.sqlite", looked_around([MapId("r0", 1), MapId("r1", 1)], seed=8))
    path = tmp_path / "a.mapweave"
    assert main(["map", "merge", str(store), "-o", str(path)]) == 0

    def said(*words: str) -> str:
        capfd.readouterr()
        assert main(["floor", *words, "--map", str(path)]) == 0
        return capfd.readouterr().out

    assert "links between floors" not in said("ground", "r0.1.1")
    assert "links between floors fall when" in said("first", "r1.1.1", "--because", "twin rooms")
    assert "links between floors may stand again when" in said("--undo", "r1.1.1")
    assert "links between floors" not in said("--undo", "r0.1.1")
