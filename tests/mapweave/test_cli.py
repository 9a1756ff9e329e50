"""The command line: help for everything, and one line on stderr for each error."""

import json
import re

import pytest

from mapweave.cli import main
from mapweave.exit_status import FAILED, NO, USAGE
from tests.mapweave.command_line import commands, complaint
from tests.programs import mapweave, python

pytestmark = pytest.mark.usefixtures("signals", "simulator")


@pytest.mark.parametrize("command", commands())
def test_every_command_has_help(command, capfd):
    with pytest.raises(SystemExit) as ended:
        main([*command.split(), "--help"])
    assert ended.value.code == 0
    out = capfd.readouterr().out
    assert f"usage: mapweave {command}" in out
    assert len(out.splitlines()) > 5
    usage, _, rest = out.partition("\n\n")
    for option in re.findall(r"\bwith\s+(--[a-z-]+)", rest):
        assert option in usage, f"{option} is none of its options"


@pytest.mark.parametrize("arguments", [
    [], ["agent"], ["agent", "r0", "--mission", "fly"], ["demo", "--robots", "many"], ["map"], ["replay"],
    ["relocalize"], ["server", "--port", "1"],
])  # fmt: skip
def test_a_wrong_use_is_one_line_that_names_the_help(arguments, capfd):
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == USAGE
    command = " ".join(["mapweave", *arguments[:1]])
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith(f"{command}: ") and line.endswith(f"; see `{command} --help`")


@pytest.mark.parametrize(("arguments", "meant"), [
    ("serve", "did you mean `mapweave server`?"),
    ("map shw office.mapweave", "did you mean `mapweave map show`?"),
    ("fly", "`mapweave --help` lists them"),
    ("server --store maps.sqlite", "a file needs no --store: it is in the folder of --data"),
    ("place add hall r0.1.1 --radius nan", "--radius nan: give metres, more than 0 and less than 10000"),
    ("place add hall r0.1.1 --radius -1", "--radius -1: give metres, more than 0 and less than 10000"),
    ("go r0 1.0 0.5", "goal '1.0': this is a map; a position has a comma and no blank, as 3.1,-2.0"),
    ("go r0 r1.3", "goal 'r1.3': this is a map: give one of its nodes, r1.3.1 for example"),
])  # fmt: skip
def test_what_is_wrong_is_answered_with_what_is_right(arguments, meant, capfd):
    assert complaint(capfd, *arguments.split(), status=USAGE).endswith(meant)


# Names and numbers


@pytest.mark.parametrize("name", ["R0", "a b", "", "r0/1", "*", "ä", "x" * 33, "-x"])
def test_names_that_cannot_be_in_a_key(name, capfd, recording, closed, tmp_path):
    output = complaint(capfd, "agent", "--", name, status=USAGE)
    assert "use 1 to 32 of a-z" in output
    if name:
        assert "use 1 to 32 of a-z" in complaint(
            capfd, "agent", "r0", "--connect", closed, f"--fleet={name}", status=USAGE
        )
        assert "use 1 to 32 of a-z" in complaint(
            capfd, "replay", recording, "--offline", f"--name={name}", status=USAGE
        )
        data = tmp_path / "data"
        output = complaint(
            capfd, "server", "--listen", closed, f"--name={name}", "--data", data, status=USAGE
        )
        assert "use 1 to 32 of a-z" in output
        assert not data.exists(), "nothing is left behind"


@pytest.mark.parametrize("arguments", ["--robots=1", "--rooms=99", "--seed=-1"])
def test_demos_out_of_range(arguments, capfd, tmp_path):
    output = complaint(capfd, "demo", arguments, "--out", tmp_path, status=USAGE)
    assert arguments.replace("=", " ") in output


@pytest.mark.parametrize(("arguments", "words"), [
    (["office", "--seed", "-1"], "--seed -1: use 0 or more"),
    (["office", "--set", "robots=0"], "robots must be a whole number, 1 to 16"),
    (["office", "--set", "robots=17"], "office.toml with --set robots=17: robots must be a whole number"),
    (["office", "--set", "world.rooms=0"], "rooms"),
    (["office", "--set", "world.kind=castle"], "no kind of world 'castle'"),
    (["office", "--set", "robots"], "write key=value"),
    (["ofice"], "no scenario 'ofice'"),
    (["nowhere.toml"], "nowhere.toml: no such file"),
])  # fmt: skip
def test_scenarios_that_cannot_be_run(arguments, words, capfd, closed, tmp_path):
    for what in (["run", "--out", tmp_path / "out"], ["serve", "--connect", closed]):
        status = FAILED if words.endswith("no such file") else USAGE
        assert words in complaint(capfd, "sim", what[0], *arguments, *what[1:], status=status)
    assert not (tmp_path / "out" / "agents").exists()


@pytest.mark.slow
def test_a_batch_names_its_failures(capfd, tmp_path):
    path = tmp_path / "two.toml"
    path.write_text(
        'robots = 1\n[world]\nkind = "arena"\n[[events]]\nat = 1.0\ndo = "wait"\n[expect]\nnodes = 77\n'
    )
    arguments = ["sim", "batch", path, "--seeds", 2, "--first", 4, "--one-process", "--out", tmp_path / "out"]
    assert main([str(a) for a in arguments]) == NO
    output = capfd.readouterr()
    assert "seed 4: nodes is" in output.err
    assert "seed 5: nodes is" in output.err
    assert main([str(a) for a in [*arguments, "--json"]]) == NO
    values = json.loads(capfd.readouterr().out.strip().splitlines()[-1])
    assert values == json.loads((tmp_path / "out" / "batch.json").read_text())
    assert "seeds" in complaint(capfd, "sim", "batch", path, "--seeds", 0, status=USAGE)
    assert "--first -1: use 0 or more" in complaint(capfd, "sim", "batch", path, "--first", -1, status=USAGE)


def test_a_trial_prints_one_json_object(capfd, tmp_path):
    path = tmp_path / "one.toml"
    path.write_text(
        'robots = 1\n[world]\nkind = "arena"\n[[events]]\nat = 1.0\ndo = "wait"\n[expect]\ncollisions = 0\n'
    )
    arguments = [
        "sim", "run", str(path), "--one-process", "--out", str(tmp_path / "out"), "--json", "--seed", "9",
    ]  # fmt: skip
    assert main(arguments) == 0
    output = capfd.readouterr()
    assert "wait" in output.err, "its progress, beside what a script reads"
    printed = json.loads(output.out.strip().splitlines()[-1])
    assert (printed["passed"], printed["seed"], printed["scenario"]) == (True, 9, "one")
    assert printed["figures"]["sim_s"] == 1.0
    assert json.loads((tmp_path / "out" / "figures.json").read_text())["figures"] == printed["figures"]


def test_a_live_view_at_no_port_starts_no_fleet(capfd, tmp_path):
    for port in (-1, 65536):
        output = complaint(
            capfd, "sim", "run", "office", f"--view={port}", "--out", tmp_path / "out", status=USAGE
        )
        assert f"--view {port}: a port is 0 to 65535" in output
    assert not (tmp_path / "out").exists()


def test_an_epoch_out_of_range(capfd, recording, tmp_path, closed):
    for epoch in (-1, 2**60):
        data = tmp_path / f"agent{epoch}"
        output = complaint(
            capfd, "agent", "r0", "--connect", closed, "--data", data, f"--epoch={epoch}", status=USAGE
        )
        assert "epoch" in output and not data.exists(), "before any body is waited for"
        data = tmp_path / str(epoch)
        output = complaint(capfd, "replay", recording, "--offline", "--data", data, f"--epoch={epoch}")
        assert "epoch" in output


# As processes


def test_a_failing_process_prints_one_line_and_ends(tmp_path):
    done = mapweave("map", "show", tmp_path / "nothing.mapweave")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == f"mapweave: {tmp_path / 'nothing.mapweave'}: no such file\n"


def test_help_is_quick():
    """No heavy import happens before a command runs."""
    program = (
        "import sys, mapweave.cli\n"
        "mapweave.cli.parser().format_help()\n"
        "heavy = {'pybullet', 'gtsam', 'faiss', 'matplotlib', 'scipy', 'numba', 'numpy', 'ssl'}\n"
        "heavy &= set(sys.modules)\n"
        "sys.exit(', '.join(sorted(heavy)) or 0)"
    )
    done = python("-c", program)
    assert (done.returncode, done.stderr) == (0, "")


def test_what_is_wrong_with_settings_is_said_before_the_pipeline_is_imported(tmp_path):
    (tmp_path / "r0.toml").write_text("[agent]\nsped = 1\n")
    program = (
        "import sys, mapweave.cli\n"
        "status = mapweave.cli.main(['agent', 'r0', '--settings', sys.argv[1]])\n"
        "heavy = {'mapweave.agent.pipeline', 'networkx', 'cv2', 'rosbags'} & set(sys.modules)\n"
        "sys.exit(', '.join(sorted(heavy)) or status)"
    )
    done = python("-c", program, tmp_path / "r0.toml")
    assert done.returncode == FAILED
    (line,) = done.stderr.splitlines()
    assert "no setting 'sped'" in line
