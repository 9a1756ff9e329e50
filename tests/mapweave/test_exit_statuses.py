"""Exit statuses of every command: a wrong command line is 2, an answer "no" is 4, a failure is 1."""

import argparse
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapweave import HybridMap, MapId, write_map_file
from mapweave.cli import main
from mapweave.exit_status import FAILED, NO, USAGE
from mapweave.hybridmap.manual_constraint import ManualConstraints
from mapweave.mapserver.map_files import map_file_of
from mapweave.offline_merge import merge_parts
from synthetic.maps import looked_around
from tests.mapweave.command_line import commands, parsers

CASES: dict[str, list[tuple[int, str]]] = {
    "demo": [(USAGE, "--seed -1"), (USAGE, "--robots 1"), (USAGE, "--rooms x")],
    "sim list": [(USAGE, "--seeds 3")],
    "sim run": [(USAGE, "nosuch"), (USAGE, "office --seed -1"), (USAGE, "office --set x"),
     (USAGE, "office --view 99999"), (FAILED, "{tmp}/none.toml")],
    "sim batch": [(USAGE, "nosuch"), (USAGE, "office --seeds 0"), (USAGE, "office --first -1")],
    "sim serve": [(USAGE, "nosuch"), (USAGE, "office --connect nowhere"), (USAGE, "office --listen nowhere"),
                  (USAGE, "office --set robots=-1")],
    "server": [(USAGE, "--listen nowhere"), (USAGE, "--name S0"), (USAGE, "--fleet a/b"), (USAGE, "--http x"),
     (USAGE, "--http 0.0.0.0:8080"), (USAGE, "--demo --data {tmp}"), (USAGE, "--store x"),
     (USAGE, "--lockstep --ray auto"), (FAILED, "--keys {tmp}/none"), (USAGE, "--keys '' --listen {free}"),
     (USAGE, "--http '' --listen {free}"),
     (FAILED, "--map {tmp}/none.mapweave --data {tmp}/server --listen {free}")],
    "router": [(USAGE, "--listen nowhere"), (USAGE, "--fleet a/b"), (FAILED, "--keys {tmp}/none")],
    "agent": [(USAGE, "R0"), (USAGE, "r0 --connect nowhere"), (USAGE, "r0 --body nowhere"),
     (USAGE, "r0 --seed -1"), (USAGE, "r0 --connect tcp/127.0.0.1:65536"), (USAGE, "r0 --epoch -1"),
     (USAGE, "r0 --metrics 99999"), (USAGE, "r0 --robot nosuch --connect {at}"),
     (USAGE, "r0 --robot create --lockstep --connect {at}"), (NO, "r0 --resume r0.1 --data {tmp}/agents"),
     (FAILED, "r0 --settings {tmp}/none.toml"), (FAILED, "r0 --record {map}/x --connect {at}"),
     (FAILED, "r0 --calibration {map} --connect {at}")],
    "drive": [(USAGE, "R0"), (USAGE, "r0 --speed 7")],
    "status": [(USAGE, "--connect nowhere"), (USAGE, "--connect tcp/127.0.0.1:99999999999"),
     (USAGE, "--fleet a/b"), (FAILED, "--connect {at}")],
    "go": [(USAGE, "R0 r0.1.1"), (USAGE, "'' r0.1.1 --connect {at}"), (USAGE, "r0 '' --connect {at}"),
     (USAGE, "r0 r0.1 --connect {at}"), (USAGE, "r0 r0.1.1 --wait --timeout 0"),
     (FAILED, "r0 home --connect {at}")],
    "explore": [(USAGE, "R0"), (USAGE, "'' --connect {at}"), (USAGE, "r0 --timeout x"),
     (FAILED, "r0 --connect {at}")],
    "stop": [(USAGE, ""), (USAGE, "r0 --all"), (USAGE, "R0"), (USAGE, "'' --connect {at}"),
     (FAILED, "r0 --connect {at}")],
    "missions": [(USAGE, "R0"), (USAGE, "'' --connect {at}"), (FAILED, "--connect {at}")],
    "place list": [(FAILED, "--map {tmp}/none.mapweave")],
    "place add": [(USAGE, "kitchen"), (USAGE, "kitchen r0.1.1 --radius -3 --map {map}"),
     (USAGE, "kitchen r0.1 --map {map} -o {out}"), (USAGE, "kitchen r0.1.1 --because {long} --map {map}"),
     (USAGE, "kitchen r0.1.1 --by {long} --map {map}"), (USAGE, "'' r0.1.1 --map {map}"),
     (NO, "kitchen r9.1.1 --map {map} -o {out}"), (FAILED, "kitchen r0.1.1 --map {tmp}/none.mapweave")],
    "place remove": [(USAGE, ""), (NO, "kitchen --map {map} -o {out}")],
    "plan add": [(USAGE, "office.png --pair x"), (USAGE, "office.png --pair r0.1=1,2 --map {map}"),
     (USAGE, "office.png --pair r0.1.1=1,2 --name '' --map {map}"),
     (FAILED, "{tmp}/none.png --pair r0.1.1=1,2 --map {map}")],
    "plan show": [(USAGE, "--connect nowhere"), (USAGE, "office -o plan.gif"), (NO, "office --map {map}"),
     (NO, "office -o {tmp}/plan.png --component 7 --map {planned}")],
    "plan export": [(USAGE, "office --format nosuch"), (NO, "office --format tf --map {map}"),
     (NO, "office --format tf --map {planned} --component 7")],
    "plan remove": [(USAGE, ""), (NO, "office --map {map} -o {out}")],
    "close": [(USAGE, "--connect {at}"), (USAGE, "r0.1.1 r0.1.1 --connect {at}"),
     (FAILED, "r0.1.1 --connect {at}"), (USAGE, "r0.1.1 --until 99:99 --map {map}"),
     (USAGE, "r0.1.1 r0.1.1 --map {map} -o {out}"), (USAGE, "r0.1 --map {map} -o {out}"),
     (USAGE, "r0.1.1 --name '' --map {map} -o {out}"), (NO, "r0.1.1 r0.1.999 --map {map} -o {out}")],
    "reopen": [(USAGE, ""), (NO, "kitchen --map {map} -o {out}")],
    "prefer": [(USAGE, "--connect {at}"), (USAGE, "--undo --connect {at}"),
     (USAGE, "r0.1.1 r0.1.3 --factor x"), (USAGE, "r0.1.1 r0.1.3 --factor 0.01 --map {map} -o {out}"),
     (USAGE, "r0.1.1 r0.1.3 --factor 2 --map {map} -o {out}"),
     (USAGE, "r0.1.1 --radius 1e4 --map {map} -o {out}"), (NO, "r0.1.1 r9.1.3 --map {map} -o {out}")],
    "avoid": [(USAGE, "--connect {at}"), (USAGE, "--undo --connect {at}"),
     (USAGE, "r0.1.1 r0.1.3 --factor x"), (USAGE, "r0.1.1 r0.1.3 --factor 1e9 --map {map} -o {out}"),
     (USAGE, "r0.1.1 r0.1.3 --factor nan --map {map} -o {out}"),
     (USAGE, "r0.1.1 r0.1.3 --factor 1 --map {map} -o {out}"), (NO, "r0.1.1 r9.1.3 --map {map} -o {out}")],
    "closures": [(USAGE, "--timeout 3"), (FAILED, "--map {tmp}/none.mapweave")],
    "floor": [(USAGE, "ground"), (USAGE, "'' r0.1.1 --map {map}"), (USAGE, "ground r0.1 --map {map}"),
     (NO, "ground r9.1.1 --map {map} -o {out}"), (USAGE, "ground 0,0 --near r0.1 --map {map}"),
     (NO, "ground 0,0 --near r9.1.1 --map {map}"), (NO, "ground 0,0 --plan none --map {map}")],
    "portal done": [(USAGE, "R0"), (FAILED, "r0 --connect {at}")],
    "keys init": [(USAGE, "--at host:99 --keys {tmp}/new"), (USAGE, "--fleet a/b --keys {tmp}/new"),
     (USAGE, "--server S0 --keys {tmp}/new"), (FAILED, "--keys {keys}")],
    "keys add": [(USAGE, "R0 --keys {keys}"), (USAGE, "r0 --days 0 --keys {keys}"), (USAGE, "r0 --role king"),
     (NO, "s0 --role robot --keys {keys}"), (FAILED, "r0 --keys {tmp}/none")],
    "keys token": [(USAGE, "s0 --days 0 --keys {keys}"), (NO, "nosuch --keys {keys}")],
    "keys list": [(FAILED, "--keys {tmp}/none")],
    "keys revoke": [(NO, "nosuch --keys {keys}"), (NO, "s0 --tokens --keys {keys}"),
                    (NO, "s0 --keys {keys}")],
    "keys bundle": [(NO, "nosuch -o {out} --keys {keys}"), (FAILED, "s0 -o {tmp}/none/x.toml --keys {keys}")],
    "robots": [(USAGE, "--robot create")],
    "doctor": [(USAGE, "--name R0"), (NO, "--offline --robot nosuch --data {tmp}")],
    "find-port": [(USAGE, "--timeout -1")],
    "find-cameras": [(USAGE, "--width 0"), (NO, "{tmp}/none.avi -o {tmp}/cameras")],
    "calibrate target": [(USAGE, "--paper a9"), (USAGE, "--squares x -o {out}"),
     (USAGE, "--square-mm -1 -o {out}"), (USAGE, "--square-mm 60 -o {out}"),
     (FAILED, "-o {tmp}/none/board.pdf")],
    "calibrate camera": [(USAGE, "{tmp} --squares x"), (USAGE, "{tmp} --height -3"), (USAGE, "--http 99999"),
     (USAGE, "{tmp} --settings {tmp}/none.toml"), (NO, "{images}"), (FAILED, "{tmp}/none.mp4")],
    "calibrate drive": [(USAGE, ""), (USAGE, "--robot create"), (USAGE, "--robot create --name R0"),
     (NO, "{recording} --calibration {tmp}"), (FAILED, "{tmp}/none")],
    "map show": [(USAGE, "{map} -o map.gif"), (NO, "{map} --component 99"), (NO, "{map} --component -1"),
     (FAILED, "{tmp}/none.mapweave")],
    "map diff": [(USAGE, "{map}"), (FAILED, "{map} {tmp}/none.mapweave")],
    "map backup": [(USAGE, "{map}"), (USAGE, "postgresql://db1/maps -o {tmp}/b"),
     (FAILED, "{map} -o {tmp}/b"), (FAILED, "{tmp}/none.sqlite -o {tmp}/b")],
    "map fetch": [(USAGE, ""), (USAGE, "{out} --connect nowhere"), (FAILED, "{out} --connect {at}")],
    "map explain": [(USAGE, "r0.1"), (USAGE, "r0.1.1 r1.1.1 --map {map} --draw x.gif"),
     (USAGE, "r0.1 r1.1 --timeout 9"), (USAGE, "r0.1 r0.1 --map {map}"), (USAGE, "r0.1.1 r0.1.1 --map {map}"),
     (NO, "r0.1.1 r9.1.1 --map {map}"), (FAILED, "--connect {at}")],
    "map route": [(USAGE, "r0.1.1"), (USAGE, "r0.1.1 r0.1.3 --draw x.gif"), (NO, "r0.1.1 r9.1.1 --map {map}"),
     (FAILED, "r0.1.1 r0.1.3 --connect {at}"), (USAGE, "0,0 r0.1.3 --near r0.1 --map {map}"),
     (NO, "0,0 r0.1.3 --near nowhere --map {map}")],
    "map history": [(USAGE, "--most 0 --map {map}"), (FAILED, "--connect {at}")],
    "map link": [(USAGE, "r0.1.1"), (USAGE, "r0.1.1 r1.1.1 --pose x --map {map} --check"),
     (USAGE, "r0.1.1 r1.1.1 --pose 1,0 --map {map} --check"),
     (USAGE, "r0.1.1 r1.1.1 --pose nan,0,0 --map {map} --check"),
     (USAGE, "r0.1.1 r1.1.1 --pose 2e4,0,0 --because x --map {map} --check"),
     (USAGE, "r0.1.1 r1.1.1 --pose 0,0,1e308 --because x --map {map} --check"),
     (NO, "r0.1.1 r9.1.1 --map {map} --check")],
    "map unmerge": [(USAGE, "r0.1 r1.1.1 --map {map} -o {out}"), (USAGE, "r0.1 r0.1 --map {map}"),
     (NO, "r0.1 r9.1 --map {map} -o {out}")],
    "map retire": [(USAGE, "--map {map}"), (USAGE, "r0.1 --because {long} --map {map}"),
     (USAGE, "r0.1 --from '' --map {map} -o {out}"), (USAGE, "r0.1 --until ' ' --map {map} -o {out}"),
     (NO, "r9.1 --map {map} -o {out}")],
    "map undo": [(USAGE, "x"), (NO, "7 --map {map} -o {out}")],
    "map portal list": [(FAILED, "--map {tmp}/none.mapweave")],
    "map portal add": [(USAGE, "lift r0.1.1 r1.1.1 --kind nosuch"),
     (USAGE, "lift r0.1.1 r0.1.1 --kind lift --map {map}"),
     (NO, "lift 0,0 r1.1.1 --kind lift --near nowhere --map {map}"),
     (NO, "lift 0,0 r1.1.1 --kind lift --plan none --map {map}"),
     (USAGE, "'' r0.1.1 r1.1.1 --kind lift --map {map}"), (USAGE, "lift r0.1 r1.1.1 --kind lift --map {map}"),
     (USAGE, "lift r0.1.1 r1.1.1 --kind lift --note {long} --map {map}"),
     (NO, "lift r0.1.1 r9.1.1 --kind lift --map {map} -o {out}")],
    "map portal remove": [(USAGE, ""), (NO, "lift --map {map} -o {out}")],
    "map pin": [(USAGE, "r0.1.1 x --map {map} -o {out}"), (USAGE, "r0.1 --map {map} -o {out}"),
     (NO, "r9.1.1 --map {map} -o {out}")],
    "map merge": [(USAGE, "{map}"), (FAILED, "{tmp}/none.mapweave -o {out}")],
    "map extract": [(FAILED, "{tmp}/none.sqlite -o {tmp}/maps")],
    "map from-photos": [(USAGE, "{tmp} --spacing -1 -o {out}"), (FAILED, "{tmp}/none --spacing 1 -o {out}")],
    "map export": [(USAGE, "{map} --format nosuch -o {out}"),
     (NO, "{map} --format g2o -o {out} --component 99"), (NO, "{map} --format g2o -o {out} --component -1"),
     (NO, "{map} --format g2o -o {out} --plan office"),
     (NO, "{planned} --format g2o -o {out} --plan office --component 7"),
     (FAILED, "{tmp}/none --format g2o -o {out}")],
    "map import": [(USAGE, "{tmp}/in.g2o -o {tmp}/x.mapweave"), (FAILED, "{tmp}/none.g2o -o {tmp}/x.g2o")],
    "open": [(USAGE, "{map} --http x"), (FAILED, "{tmp}/none.mapweave")],
    "record": [(USAGE, "R0 -o {tmp}/drive"), (USAGE, "r0 --robot nosuch -o {tmp}/drive --connect {at}"),
     (FAILED, "r0 -o {tmp}/drive --connect {at}")],
    "replay": [(USAGE, "{recording} --name R0"), (FAILED, "{tmp}/none --offline"),
     (FAILED, "{recording} --offline --data {tmp}/replay --calibration {map}")],
    "info": [(USAGE, ""), (FAILED, "{tmp}/none")],
    "relocalize": [(USAGE, "{map}"), (USAGE, "{images}/0.png --draw x.gif"),
     (NO, "{images}/0.png --map {map}"), (FAILED, "{tmp}/none.png"),
     (FAILED, "{images}/0.png --connect {at}")],
    "eval relocalize": [(FAILED, "{tmp}/none")],
    "eval replay": [(FAILED, "{tmp}/none")],
    "eval merge": [(USAGE, "{recording} --robots 0"), (FAILED, "{tmp}/none")],
    "settings": [(USAGE, "x")],
    "completion": [(USAGE, "nosuch")],
}  # fmt: skip


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The merged map of two robots in one room."""
    logs = looked_around((MapId("r0", 1), MapId("r1", 1)), seed=8)
    merged = merge_parts({name: HybridMap(log) for name, log in logs.items()}, ManualConstraints())
    path = tmp_path_factory.mktemp("map") / "merged.mapweave"
    write_map_file(path, map_file_of(merged))
    return path


@pytest.fixture(scope="module")
def planned(written: Path) -> Path:
    """The same map with the plan `office` under its one component."""
    path, image = written.with_name("planned.mapweave"), written.with_name("office.png")
    cv2.imwrite(str(image), np.full((400, 400), 90, np.uint8))
    pairs = [("0,0", "50,350"), ("2,0", "150,350"), ("2,2", "150,250"), ("0,2", "50,250")]
    given = [word for place, pixel in pairs for word in ("--pair", f"{place}={pixel}")]
    assert main(["plan", "add", str(image), *given, "--map", str(written), "-o", str(path)]) == 0
    return path


def test_every_command_is_tried():
    assert set(CASES) == set(commands(runnable=True))


@pytest.mark.parametrize("command", CASES)
def test_a_command_ends_with_the_status_of_what_was_wrong(
    command: str, written: Path, planned: Path, recording: Path, closed: str, tmp_path, capfd
):
    keys = tmp_path / "keys"
    if command.startswith("keys"):
        assert main(["keys", "init", "--keys", str(keys)]) == 0
    values = {
        "tmp": tmp_path, "map": written, "out": tmp_path / "out.mapweave", "keys": keys, "at": closed,
        "planned": planned, "long": 301 * "x", "free": "tcp/127.0.0.1:0", "recording": recording,
        "images": recording / "images",
    }  # fmt: skip
    for status, arguments in CASES[command]:
        line = f"{command} {arguments}".format(**values)
        capfd.readouterr()
        try:
            ended = main(shlex.split(line))
        except SystemExit as exit_:
            ended = exit_.code  # argparse's own
        said = capfd.readouterr().err
        assert ended == status, f"{line}: {said}"
        # An answer "no" may be all of stdout.
        assert len(said.splitlines()) == 1 or (status == NO and not said), f"{line}: {said}"


def test_one_word_is_one_thing_in_all_commands():
    """Of options that many commands have."""
    shapes: dict[str, set[tuple[object, ...]]] = {}
    for words, parser in parsers().items():
        for action in parser._actions:
            for option in action.option_strings:
                shape = action.nargs, action.metavar, getattr(action.type, "__name__", None)
                if option in ("--json", "-o", "--out", "--map", "--timeout", "--because", "--by", "--check"):
                    shapes.setdefault(option, set()).add(shape[:1] if option in ("-o", "--out") else shape)
            if {"-o", "--out"} & {*action.option_strings}:
                assert {"-o", "--out"} == {*action.option_strings}, words
            assert not {"--patience", "--to", "--picture"} & {*action.option_strings}, words
        assert isinstance(parser, argparse.ArgumentParser)
    for option in ("--json", "-o", "--timeout", "--because", "--by", "--check"):
        assert len(shapes[option]) == 1, f"{option}: {shapes[option]}"
