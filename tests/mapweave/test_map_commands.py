"""`mapweave map explain | unmerge | merge`, on files and against a real server process."""

import json
import re
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mapweave import MapFile, MapId, NodeId, read_map_file, write_map_file
from mapweave.cli import main
from mapweave.exit_status import FAILED, NO, USAGE
from mapweave.hybridmap.change import ChangeBody, NodePut
from mapweave.mapserver.map_files import merged_of
from mapweave.opened_map import OpenedMap
from mapweave.scenarios.children import Children, free_port
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.zenoh_bus import ZenohBus
from synthetic.maps import looking_around, map_tours, write_store
from synthetic.world import room

R0, R1, R2 = MapId("r0", 1), MapId("r1", 1), MapId("r2", 1)


def logs() -> dict[MapId, list[ChangeBody]]:
    """Two robots in one room, a third elsewhere."""
    rng = np.random.default_rng(8)
    here, there = room(0, 0, 5, 4, 700, rng), room(0, 0, 5, 4, 700, rng)
    tour = looking_around(4)
    return map_tours(here, {R0: tour, R1: tour}, rng) | map_tours(there, {R2: tour}, rng)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Each robot's own map, and the merged one last."""
    folder = tmp_path_factory.mktemp("maps")
    paths = []
    for map_id, changes in logs().items():
        paths.append(folder / f"{map_id.agent}.mapweave")
        write_map_file(paths[-1], MapFile("agent", str(map_id), tuple(changes)))
    merged = folder / "merged.mapweave"
    assert main(["map", "merge", *map(str, paths), "-o", str(merged)]) == 0
    return [*paths, merged]


Said = Callable[..., str]


@pytest.fixture
def said(capfd: pytest.CaptureFixture[str]) -> Said:
    """What a command that succeeds prints."""

    def run(*arguments: object) -> str:
        capfd.readouterr()
        assert main([str(a) for a in arguments]) == 0
        return capfd.readouterr().out

    return run


def links(path: Path) -> list[tuple[NodeId, NodeId]]:
    return [link.pair for link in merged_of(read_map_file(path)).links if not link.within]


def test_merging_prints_joined_and_separate_maps(files: list[Path], said: Said, tmp_path):
    out = said("map", "merge", *files[:3], "-o", tmp_path / "m.mapweave")
    assert "12 nodes, 3 maps, 2 components" in out and "r0.1 and r1.1 are one map now, by " in out
    assert "r0.1 and r2.1 are not one map: " in out
    values = json.loads(said("map", "merge", *files[:3], "-o", tmp_path / "m.mapweave", "--json"))
    assert values["maps"] == ["r0.1", "r1.1", "r2.1"] and values["components"] == 2
    assert len(values["apart"]) == 2
    assert values["links"] == len(links(files[3]))


def test_merging_in_steps_is_merging_at_once(files: list[Path], said: Said, tmp_path):
    said("map", "merge", files[1], files[2], "-o", tmp_path / "two.mapweave")
    said("map", "merge", tmp_path / "two.mapweave", files[0], "-o", tmp_path / "three.mapweave")
    assert (tmp_path / "three.mapweave").read_bytes() == files[3].read_bytes()


def test_how_maps_are_merged_can_be_chosen(files: list[Path], said: Said, tmp_path):
    path, out = tmp_path / "strict.toml", tmp_path / "m.mapweave"
    usual = said("map", "merge", *files[:3], "-o", out, "--json")
    path.write_text("[merge.consistency]\ngate = 1e-6\n")
    strict = said("map", "merge", *files[:3], "-o", out, "--json", "--settings", path)
    assert json.loads(strict)["links"] < json.loads(usual)["links"], "to a thousandth of a sigma few agree"
    path.write_text("[merge.consistency]\ngate = 'much'\n")
    assert main(["map", "merge", *map(str, files[:3]), "-o", str(out), "--settings", str(path)]) == 1


def test_a_link_is_explained_and_drawn(files: list[Path], said: Said, tmp_path):
    pair = links(files[3])[0]
    picture = tmp_path / "pictures" / "link.png"
    out = said("map", "explain", *pair, "--map", files[3], "--draw", picture)
    for word in (
        "are linked: ", "b seen from a", "residuals", "in the map", "probability", "other links", "evidence",
    ):  # fmt: skip
        assert word in out
    image = cv2.imread(str(picture))
    assert image is not None and image.shape[1] > 1000
    # The first colours of the scale, that of lines with small residuals, are really there.
    blue, green, red = (image[..., k].astype(int) for k in range(3))
    assert ((blue - green > 40) & (red - green > 20)).sum() > 500
    values = json.loads(said("map", "explain", *pair[::-1], "--map", files[3], "--json"))
    assert values["standing"] == "linked" and len(values["shared"]) == len(values["residuals_px"])
    assert np.shape(values["a_from_b"]["covariance"]) == (3, 3)


def test_a_route_is_explained(files: list[Path], said: Said, capfd, tmp_path):
    start, goal = links(files[3])[0]
    values = json.loads(said("map", "route", start, goal, "--json", "--map", files[3]))
    assert values["found"] and values["hops"][0]["a"] == str(start) and values["hops"][-1]["b"] == str(goal)
    out = said("map", "route", start, goal, "--map", files[3])
    assert out.startswith(f"{start} to {goal}: the route is: {values['reason']}")
    assert len(out.splitlines()) == 1 + len(values["hops"])
    drawn = tmp_path / "pictures" / "way.png"
    out = said("map", "route", start, goal, "--map", files[3], "--draw", drawn)
    assert out.endswith(f"picture   {drawn}\n")
    image = cv2.imread(str(drawn))
    # Start and goal are gold, and nothing else is.
    assert image is not None and (np.abs(image.astype(int) - [0, 215, 255]).max(axis=2) < 8).sum() > 100
    barred = [word for one in links(files[3]) for word in ("--blocked", *map(str, one))]
    others = json.loads(said("map", "route", start, goal, *barred, "--json", "--map", files[3]))
    assert others["gaps"] and "reported as blocked" in others["gaps"][0]["words"]
    none = tmp_path / "none.png"
    assert main(["map", "route", "r0.1.1", "r2.1.1", "--map", str(files[3]), "--draw", str(none)]) == NO
    out, err = capfd.readouterr()
    assert f"{none} is not drawn: there is no way" in err and not none.exists()
    assert "there is no way: " in out and "r0.1 and r2.1 are not one map" in out
    assert main(["map", "route", "r0.1", "r2.1.1", "--map", str(files[3])]) == USAGE
    assert "r0.1 is a map: give one of its nodes" in capfd.readouterr().err


def test_places_are_named_beside_their_nodes(files: list[Path], said: Said, tmp_path):
    """Only the nodes were named: who had asked for `kitchen` could not see what was taken for it."""
    path = tmp_path / "m.mapweave"
    path.write_bytes(files[3].read_bytes())
    first, second = map(str, links(path)[0])
    said("place", "add", "kitchen", second, "--map", path)
    out = said("map", "route", "kitchen", first, "--map", path)
    assert out.startswith(f"kitchen ({second}) to {first}: the route is: ")
    out = said("map", "route", first, "kitchen", "--via", "kitchen", "--map", path)
    assert out.startswith(f"{first} to kitchen ({second}) via kitchen ({second}): ")
    for ends in (("kitchen", first), (first, "kitchen")):
        out = said("map", "explain", *ends, "--map", path)
        assert out.startswith(f"{first} and kitchen ({second}) are linked: ")


def test_maps_are_explained(files: list[Path], said: Said):
    values = json.loads(said("map", "explain", "--map", files[3], "--json"))["maps"]
    assert [(item["first"], item["second"], item["joined"]) for item in values] == [
        ("r0.1", "r2.1", False), ("r1.1", "r2.1", False), ("r0.1", "r1.1", True),
    ]  # fmt: skip
    assert "are one map: " in said("map", "explain", "r1.1", "r0.1", "--map", files[3])
    assert said("map", "explain", "--map", files[0]) == "there are no two maps\n"


def test_unmerging_in_a_file_and_taking_it_back(files: list[Path], said: Said, tmp_path):
    path = tmp_path / "m.mapweave"
    path.write_bytes(files[3].read_bytes())
    out = said("map", "unmerge", "r0.1", "r1.1", "--because", "two kitchens", "--by", "anna", "--map", path)
    assert "r0.1 and r1.1 are not one map: undone with all links" in out and not links(path)
    assert "by anna on 20" in out and '"two kitchens"' in out
    assert json.loads(said("map", "show", path, "--no-picture", "--json"))["constraints"] == 1
    # A later merge with others applies it too.
    said("map", "merge", path, "-o", path)
    assert not links(path)
    out = said("map", "unmerge", "r1.1", "r0.1", "--undo", "--by", "bob", "--map", path)
    assert "are one map" in out and links(path) == links(files[3])
    out = said("map", "explain", "r0.1", "r1.1", "--map", path)
    assert "anna decided that they shall not" in out and "bob decided that they may be linked again" in out
    lines = said("map", "history", "--map", path).splitlines()
    kinds = [line.split("UTC  ")[1].split("  ")[0] for line in lines]
    assert kinds == ["constrained", "parted", "constrained", "joined"]
    assert all("anna" in line and "two kitchens" in line for line in lines[:2]) and "bob" in lines[2]
    # The history of a file is kept in files made of it, once.
    said("map", "merge", path, files[3], "-o", tmp_path / "again.mapweave")
    assert said("map", "history", "--map", tmp_path / "again.mapweave").splitlines() == lines
    assert said("map", "history", "--map", files[3]).startswith("no joins")
    pair = links(path)[0]
    said("map", "unmerge", *pair, "--map", path, "-o", tmp_path / "one.mapweave")
    assert links(tmp_path / "one.mapweave") == [other for other in links(path) if other != pair]


def test_what_a_correction_says_for_a_script_takes_it_back(files: list[Path], said: Said, tmp_path):
    path = tmp_path / "m.mapweave"
    path.write_bytes(files[3].read_bytes())
    checked = json.loads(said("map", "retire", "r1.1", "--check", "--json", "--map", path))
    assert checked["said"].startswith("only checked") and checked["number"] is None
    assert "(number 1)" in said("map", "retire", "r2.1", "--map", path).splitlines()[0]
    done = json.loads(said("map", "retire", "r1.1", "--json", "--map", path))
    assert done["said"].startswith("map r1.1 is retired") and done["number"] == 2 and not links(path)
    back = json.loads(said("map", "undo", done["number"], "--json", "--map", path))
    assert back["number"] == 3 and links(path) == links(files[3])
    apart = json.loads(said("map", "unmerge", "r0.1", "r1.1", "--json", "--map", path))
    assert apart["number"] == 4 and "r0.1 and r1.1 are not one map" in apart["said"]


def test_an_entry_that_was_taken_back_is_not_undone_again(files: list[Path], said: Said, tmp_path, capfd):
    path = tmp_path / "m.mapweave"
    path.write_bytes(files[3].read_bytes())
    for undo, who in (([], "anna"), (["--undo"], "bob"), ([], "carl")):
        said("map", "unmerge", "r0.1", "r1.1", *undo, "--by", who, "--map", path)
    before = path.read_bytes()
    assert main(["map", "undo", "1", "--map", str(path)]) == NO
    err = capfd.readouterr().err
    assert "constraint 1 was taken back already by bob on 20" in err and "number 3, by carl" in err
    assert path.read_bytes() == before, "what carl decided holds"


def test_retiring_a_map_in_a_file_and_taking_it_back(files: list[Path], said: Said, tmp_path):
    path = tmp_path / "m.mapweave"
    path.write_bytes(files[3].read_bytes())
    before = read_map_file(path)
    out = said("map", "retire", "r1.1", "--because", "rebuilt", "--by", "anna", "--map", path)
    assert "1 retired" in out and not links(path)
    left = read_map_file(path)
    assert {node.map for node in left.poses} == {R0, R2}
    assert len(left.changes) == len(before.changes) - len(links(files[3])), "nothing of the maps is lost"
    out = said("map", "explain", "r0.1", "r1.1", "--map", path)
    assert "not one map: map r1.1 is retired by anna on 20" in out and '"rebuilt"' in out
    out = said("map", "explain", "r0.1.1", "r1.1.1", "--map", path)
    assert "are not linked: map r1.1 is retired by anna" in out
    # The explanation says who did it, why, and how it comes back, once; other maps come first.
    why = '"rebuilt"; `mapweave map retire r1.1 --undo` brings it back'
    lines = said("map", "explain", "r0.1", "r1.1", "--map", path).splitlines()
    assert len(lines) == 1 and "not one map: map r1.1 is retired by anna on 20" in lines[0], lines
    assert lines[0].endswith(why)
    lines = said("map", "explain", "r0.1.1", "r1.1.1", "--map", path).splitlines()
    assert lines[0].endswith(why) and not any("anna" in line for line in lines[1:])
    assert said("map", "explain", "--map", path).startswith("r0.1 and r2.1 are not one map: no node")
    nodes = sorted(node for node in merged_of(before).poses if node.map == R1)
    said("map", "retire", *nodes, "--map", files[3], "-o", tmp_path / "nodes.mapweave")
    out = said("map", "explain", "r0.1", "r1.1", "--map", tmp_path / "nodes.mapweave")
    assert "not one map: no node of r1.1 is left: nodes r1.1.1, " in out and "--undo` brings them back" in out
    # A later merge with others applies it too.
    said("map", "merge", path, "-o", path)
    assert not links(path)
    said("map", "retire", "r1.1", "--undo", "--map", path)
    assert links(path) == links(files[3])
    assert "decided that it is in use again (map r1.1)" in said(
        "map", "explain", "r0.1", "r1.1", "--map", path
    )


def test_linking_in_a_file_and_taking_it_back(files: list[Path], said: Said, tmp_path, capfd):
    path = tmp_path / "m.mapweave"
    path.write_bytes(files[3].read_bytes())
    wrong = ["map", "link", "r0.1.1", "r2.1.3", "--map", str(path)]
    assert main(wrong) == NO
    error = capfd.readouterr().err
    assert "do not show one place: " in error and "--pose X,Y,DEGREES --because TEXT" in error
    assert main([*wrong, "--pose=-1,0.5,90"]) == NO
    assert capfd.readouterr().err.endswith(", needs a reason: --because TEXT\n")
    by_hand = [*wrong, "--pose=-1,0.5,90", "--because", "the same door", "--by", "anna"]
    only_checked = "only checked, nothing is changed: r0.1.1 and r2.1.3: linked by hand by anna"
    assert said(*by_hand, "--check").startswith(only_checked)
    assert path.read_bytes() == files[3].read_bytes(), "only checked"
    assert "1 component" in said(*by_hand)
    out = said("map", "explain", "r0.1.1", "r2.1.3", "--map", path)
    assert "are linked: linked by hand by anna" in out and "they see one place (r0.1.1 and r2.1.3)" in out
    out = said("map", "retire", "r0.1.3", "--map", path)
    assert "node r0.1.3 is retired by " in out and "1 retired node" in out
    out = said("map", "explain", "r0.1.3", "r1.1.1", "--map", path)
    assert "are not linked: node r0.1.3 is retired" in out
    assert [line.split()[0] for line in said("map", "undo", "--map", path).splitlines()] == ["1", "2"]
    said("map", "undo", "2", "--map", path)
    said("map", "undo", "1", "--map", path)
    assert said("map", "undo", "--map", path) == "no manual constraint holds\n"
    assert len(json.loads(said("map", "undo", "--json", "--map", path))["constraints"]) == 4
    content, before = read_map_file(path), read_map_file(files[3])
    assert content.changes == before.changes or links(path) == links(files[3])
    assert [str(node) for node in content.poses] == [str(node) for node in before.poses]


@pytest.mark.parametrize(("arguments", "words", "status"), [
    (["explain", "r0.1.1"], "give two nodes or two maps, not 1", USAGE),
    (["explain", "r0.1.1", "r1.1"], "are a node and a map", USAGE),
    (["explain", "here", "there"], "'here' is no place of this map", NO),
    (["explain", "r0.1.1", "r9.1.1"], "there is no map r9.1; known are: r0.1, r1.1, r2.1", NO),
    (["explain", "r0.1.1", "r1.1.2"], "map r1.1 has no node 2; of its 4 nodes the nearest are 1, 3, 5, 7",
     NO),
    (["explain", "r0.1", "r1.1", "--draw", "x.png"], "--draw needs two nodes", USAGE),
    (["explain", "--draw", "x.png"], "--draw needs two nodes", USAGE),
    (["unmerge", "r0.1", "r2.1"], "no link joins r0.1 and r2.1: there is nothing to undo", NO),
    (["unmerge", "r0.1.3", "r0.1.1"], "joined by their robot's way (edge r0.1.2, ", NO),
    (["unmerge", "r0.1", "r9.1"], "there is no map r9.1; known are: r0.1, r1.1, r2.1", NO),
    (["unmerge", "r0.1.1", "r1.1.2"], "map r1.1 has no node 2; of its 4 nodes the nearest are 1, 3, 5, 7",
     NO),
    (["unmerge", "r0.1", "r0.1"], "two different maps", USAGE),
    (["retire", "r0.1", "r0.1.1"], "give one map (r0.1), or nodes", USAGE),
    (["retire", "r0.1.99"], "map r0.1 has no node 99", NO),
    (["retire", "--area", "r0.1.1", "0,0 1,0"], "3 to 64 corners", USAGE),
    (["retire", "r0.1.1", "--from", "7"], "r0.1.1 is a node: give its map, r0.1", USAGE),
    (["link", "r0.1.1", "r1.1.2"], "map r1.1 has no node 2", NO),
    (["link", "r0.1.1", "r2.1.1", "--undo"], "r0.1.1 and r2.1.1 are not linked by hand", NO),
    (["undo", "7"], "there is no constraint 7", NO),
    (["retire", "r9.1"], "there is no map r9.1; known are: r0.1, r1.1, r2.1", NO),
    (["retire", "r0.1", "--undo"], "map r0.1 is not retired", NO),
    (["unmerge", "r0.1", "r1.1", "--undo"], "no manual constraint keeps r0.1 and r1.1 apart", NO),
    (["unmerge", "r0.1", "r1.1", "--because", "a\nb"], "one printable line", USAGE),
])  # fmt: skip
def test_bad_input_is_reported_in_one_line(
    files: list[Path], capfd, arguments: list[str], words: str, status: int
):
    before = files[3].read_bytes()
    capfd.readouterr()
    assert main(["map", *arguments, "--map", str(files[3])]) == status
    out, err = capfd.readouterr()
    assert out == "" and len(err.splitlines()) == 1 and words in err
    assert files[3].read_bytes() == before and not Path("x.png").exists()


def test_of_an_older_and_a_newer_file_the_newer_counts(files: list[Path], said: Said, tmp_path, capfd):
    out, older, other = (tmp_path / name for name in ("m.mapweave", "older.mapweave", "other.mapweave"))
    content = read_map_file(files[0])
    nodes = [change for change in content.changes if isinstance(change, NodePut)]
    write_map_file(older, replace(content, changes=tuple(nodes[:3])))
    for order in ([files[0], older, files[1], files[2]], [files[2], older, files[1], files[0]]):
        words = said("map", "merge", *order, "-o", out)
        assert f"map r0.1 is taken from {files[0]}, since that in {older} is older" in words
        assert out.read_bytes() == files[3].read_bytes()
    # Yesterday's merged map and today's maps; the same map twice says nothing new.
    said("map", "merge", older, files[1], "-o", out)
    assert "since that in" in said("map", "merge", out, *files[:3], "-o", out)
    assert out.read_bytes() == files[3].read_bytes()
    assert "taken from" not in said("map", "merge", out, *files[:3], "-o", out)
    assert out.read_bytes() == files[3].read_bytes()
    moved = [NodePut(replace(change.node, stamp_ns=change.node.stamp_ns + 1)) for change in nodes]
    write_map_file(other, replace(content, changes=tuple(moved[:3])))
    for rival, words in ((other, "two maps of one name"), (older, "")):
        assert main(["map", "merge", str(files[0]), str(rival), "-o", str(tmp_path / "no")]) == bool(words)
        assert words in capfd.readouterr().err
    less = replace(content, changes=tuple(change for change in content.changes if change is not nodes[0]))
    write_map_file(other, less)
    assert main(["map", "merge", str(files[0]), str(other), "-o", str(tmp_path / "none")]) == 1
    assert "it cannot be decided which is newer" in capfd.readouterr().err
    assert not (tmp_path / "none").exists()


def test_a_time_window_that_ends_before_it_begins_is_named_as_it_was_given(capfd):
    """It was said in nanoseconds since 1970."""
    window = ["--from", "2026-03-01T12:00", "--until", "2026-03-01T11:00"]
    assert main(["map", "retire", "r0.1", *window]) == USAGE
    said = "--until 2026-03-01T11:00 is before --from 2026-03-01T12:00"
    assert capfd.readouterr().err == f"mapweave: {said}\n"


def test_mismatched_files_are_reported_in_one_line(files: list[Path], capfd, tmp_path):
    capfd.readouterr()
    out = tmp_path / "m.mapweave"
    assert main(["map", "unmerge", "r0.1", "r1.1", "--map", str(files[0])]) == 1
    assert "of kind agent, not merged" in capfd.readouterr().err
    assert main(["map", "unmerge", "r0.1", "r1.1", "-o", str(out)]) == USAGE
    assert "--out goes with --map" in capfd.readouterr().err


@contextmanager
def serving(folder: Path, port: int) -> Iterator[None]:
    """A real server process on a store that is there already."""
    endpoint = f"tcp/127.0.0.1:{port}"
    with Children(folder / "logs") as children:
        children.start("server", ["server", "--fleet", "why", "--listen", endpoint, "--data", str(folder)])
        with closing(ZenohBus(BusSettings(mode="client", endpoints=(endpoint,)))) as bus:
            end = time.monotonic() + 90
            while not bus.connected():
                children.check()
                assert time.monotonic() < end
                time.sleep(0.05)
        yield
        children.end("server")


@pytest.mark.slow
def test_a_restarted_server_keeps_manual_constraints(files: list[Path], said: Said, tmp_path):
    write_store(tmp_path / "s0.sqlite", logs())
    port = free_port()
    at = ["--fleet", "why", "--connect", f"tcp/127.0.0.1:{port}"]
    with serving(tmp_path, port):
        end = time.monotonic() + 90
        while "r0.1 and r1.1 are one map: " not in said_or_refused(said, "map", "explain", *at):
            assert time.monotonic() < end, "the server has not merged"
        pair = links(files[3])[0]
        # The same numbers from the server, once it has merged all, as from the file merged without one.
        offline = json.loads(said("map", "explain", *pair, "--json", "--map", files[3]))

        def content(answer: dict[str, Any]) -> tuple[object, ...]:
            return answer["shared"], answer["reason"], [w["a"] for w in answer["other_links"]]

        while content(served := json.loads(said("map", "explain", *pair, "--json", *at))) != content(offline):
            assert time.monotonic() < end, "the server explains otherwise"
        assert served["probability"] == pytest.approx(offline["probability"], rel=1e-4)
        ways = [
            json.loads(said("map", "route", *pair, "--json", *where)) for where in (("--map", files[3]), at)
        ]
        said("map", "route", *pair, "--draw", tmp_path / "way.png", *at)
        assert (tmp_path / "way.png").stat().st_size > 10_000
        assert ways[0]["found"] and [hop["b"] for hop in ways[0]["hops"]] == [h["b"] for h in ways[1]["hops"]]
        out = said("map", "unmerge", "r0.1", "r1.1", "--because", "two kitchens", "--by", "anna", *at)
        assert "r0.1 and r1.1 are not one map: undone with all links" in out
    logged = (tmp_path / "logs" / "server.log").read_text()
    assert re.search(r"^\d{4}-\d\d-\d\d \d\d:\d\d:\d\d r0.1 and r1.1 are no longer one map: ", logged, re.M)
    with serving(tmp_path, port):
        end = time.monotonic() + 90
        while "r0.1 and r1.1 are not one map: undone with all links" not in (
            out := said_or_refused(said, "map", "explain", "r0.1", "r1.1", *at)
        ):
            assert time.monotonic() < end, out
        assert "two kitchens" in out
        out = said("map", "unmerge", "r0.1", "r1.1", "--undo", *at)
        assert "r0.1 and r1.1 are one map: " in out
        history = json.loads(said("map", "history", "--json", *at))["history"]
        # What the first server saw, too; a restarted server does not report joined maps again.
        assert [event["kind"] for event in history] == [
            "joined", "constrained", "parted", "constrained", "joined",
        ]  # fmt: skip
        assert "two kitchens" in history[1]["words"] and "two kitchens" in history[2]["words"]
        assert [event["stamp_ns"] for event in history] == sorted(event["stamp_ns"] for event in history)
        lines = said("map", "history", "--most", "2", *at).splitlines()
        assert len(lines) == 3 and lines[0] == "(3 older ones: --most)" and history[-1]["words"] in lines[2]
    log = "".join(path.read_text() for path in (tmp_path / "logs").iterdir())
    assert "r0.1 and r1.1 are no longer one map: " in log


def said_or_refused(text: Said, *arguments: object) -> str:
    """A server that has only just started knows no maps yet."""
    try:
        return text(*arguments)
    except AssertionError:
        return "known are: none"


@pytest.mark.parametrize("late", ["retire", "place"])
def test_two_commands_on_one_file_at_once_lose_nothing_of_each_other(
    files: list[Path], tmp_path, said: Said, capfd, monkeypatch, late: str
):
    """The second one reads the file before the first one has written it."""
    path = tmp_path / "both.mapweave"
    path.write_bytes(files[-1].read_bytes())
    first, *others = sorted(merged_of(read_map_file(path)).poses)
    second = {
        "retire": ["map", "retire", str(first), "--map", str(path)],
        "place": ["place", "add", "sink", str(first), "--map", str(path)],
    }[late]

    def meanwhile(merge: Callable[..., Any]) -> Callable[..., Any]:
        def merged(*arguments: Any, **options: Any) -> Any:
            monkeypatch.undo()
            said("place", "add", "door", others[0], "--map", path)
            return merge(*arguments, **options)

        return merged

    for name in ("merged", "merged_again"):
        monkeypatch.setattr(OpenedMap, name, meanwhile(getattr(OpenedMap, name)))
    assert main(second) == FAILED
    output = capfd.readouterr()
    assert output.err == (
        f"mapweave: {path}: another command has written it meanwhile, and it is kept: say it again\n"
    )
    assert not output.out
    assert said(*second)
    kept = read_map_file(path)
    names = [annotation.name for annotation in kept.annotations]
    assert names == ["door", "sink"] if late == "place" else names == ["door"] and len(kept.constraints) == 1
    assert [one.name for one in tmp_path.iterdir()] == [path.name]
