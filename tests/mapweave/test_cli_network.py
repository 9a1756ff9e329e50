"""The command line and the network: one line on stderr without a server, or with another program."""

import errno
import os
import pty
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import IO

import cv2
import numpy as np
import pytest

from mapweave import connection
from mapweave.cli import main
from mapweave.commands import network
from mapweave.exit_status import USAGE
from mapweave.hybridmap.errors import NotConnected
from mapweave.settings import NetworkSettings
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.zenoh_bus import ZenohBus
from tests.mapweave.command_line import complaint
from tests.mapweave.expired_key import EXPIRED, expired_key
from tests.programs import python
from tests.simulator import needs_simulator
from tests.waiting import eventually

pytestmark = pytest.mark.usefixtures("signals", "simulator")


@pytest.mark.parametrize("endpoint", ["localhost", "tcp/localhost", "http/a:1", "tcp/:1", "tcp/a b:1"])
def test_endpoints(endpoint, capfd, recording, tmp_path):
    picture = recording / "images" / "0.png"
    for command in (
        ["agent", "r0"], ["sim", "serve", "office"], ["relocalize", picture], ["replay", recording],
    ):  # fmt: skip
        assert "endpoint" in complaint(capfd, *command, "--connect", endpoint, status=USAGE)
    assert "endpoint" in complaint(capfd, "server", "--listen", endpoint, "--data", tmp_path, status=USAGE)


def test_a_port_that_is_taken(capfd, port, tmp_path):
    output = complaint(capfd, "server", "--listen", f"tcp/127.0.0.1:{port}", "--data", tmp_path)
    assert f"cannot listen at tcp/127.0.0.1:{port}: the port is taken" in output


def test_a_port_for_people_that_is_taken(capfd, port, closed, tmp_path):
    output = complaint(capfd, "server", "--listen", closed, "--data", tmp_path / "a", "--http", port)
    assert f"cannot listen at http 127.0.0.1:{port}: the port is taken; choose another one" in output
    output = complaint(
        capfd, "server", "--listen", closed, "--data", tmp_path / "b", "--http", "here", status=USAGE
    )
    assert "write a port, or HOST:PORT" in output
    assert not (tmp_path / "b").exists()


def test_a_port_for_people_that_is_for_root_alone(capfd, closed, tmp_path, monkeypatch):
    """It said only that permission was denied."""

    def bind(self, address):
        if address[1] == 80:
            raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(socket, "socket", type("Socket", (socket.socket,), {"bind": bind}))
    output = complaint(capfd, "server", "--listen", closed, "--data", tmp_path, "--http", "80")
    assert "cannot listen at http 127.0.0.1:80: ports below 1024 are for root alone; choose another" in output


def test_an_address_of_another_machine(capfd, tmp_path):
    there, data = "tcp/192.0.2.1:7447", tmp_path / "data"
    assert "mapweave keys init" in complaint(capfd, "server", "--listen", there, "--data", data)
    keys = tmp_path / "keys"
    assert main(["keys", "init", "--profile", "lab", "--keys", str(keys)]) == 0
    output = complaint(capfd, "server", "--keys", keys, "--listen", there, "--data", data)
    assert f"cannot listen at {there}" in output


def test_asking_without_a_server(capfd, recording, closed):
    picture = recording / "images" / "0.png"
    output = complaint(capfd, "relocalize", picture, "--connect", closed)
    assert f"no router at {closed}: start" in output


@pytest.mark.parametrize("words", [
    "link r0.1 r1.1", "unmerge r0.1 r1.1.1", "retire r0.1 r0.1.1", "explain r0.1 r0.1", "route r0.1 r0.1.1",
])  # fmt: skip
def test_wrong_ids_are_a_wrong_command_line_also_without_a_server(capfd, closed, words):
    complaint(capfd, "map", *words.split(), "--connect", closed, status=USAGE)


def test_where_nothing_listens_no_command_waits_for_a_router(capfd, closed, port, monkeypatch):
    """The answer came after 1 s, of the 2 s that loading on a slow computer has a part of."""
    waits = []
    monkeypatch.setattr(ZenohBus, "wait_connected", lambda self, timeout: waits.append(timeout) or False)
    advice = "start `mapweave server`, or give the endpoint of its router (--connect)"
    assert f"no router at {closed}: {advice}" in complaint(capfd, "status", "--connect", closed)
    assert waits == [connection.UNHEARD] and connection.UNHEARD < connection.SOON
    listens = f"tcp/127.0.0.1:{port}"
    complaint(capfd, "status", "--connect", closed, listens)
    assert sum(waits[1:]) == connection.SOON, "it may be a busy router"


@pytest.mark.parametrize("command", ["agent", "replay"])
def test_a_router_is_looked_for_while_the_pipeline_is_imported(command, recording, closed):
    """That there is none was said after 2.3 to 3.6 s on a busy machine: one wait came after the other."""
    program = (
        "import sys, mapweave.cli\n"
        "from mapweave.wire.zenoh_bus import ZenohBus\n"
        "def opened(self, settings):\n"
        "    print('mapweave.agent.pipeline' in sys.modules)\n"
        "    sys.exit(7)\n"
        "ZenohBus.__init__ = opened\n"
        "mapweave.cli.main(sys.argv[1:])\n"
    )
    which = "r0" if command == "agent" else recording
    done = python("-c", program, command, which, "--connect", closed)
    assert (done.returncode, done.stdout, done.stderr) == (7, "False\n", "")


def test_an_agent_counts_from_when_it_began_to_look_for_a_router(capfd, closed, monkeypatch, tmp_path):
    waits, looked = [], []

    def wait(self, timeout):
        waits.append((timeout, time.monotonic()))
        return False

    def warn(bus, name, settings, since):
        looked.append((name, settings.endpoints, since))
        raise NotConnected("seen")

    monkeypatch.setattr(ZenohBus, "wait_connected", wait)
    monkeypatch.setattr("mapweave.commands.agent.warn_without_router", warn)
    begin = time.monotonic()
    assert "seen" in complaint(capfd, "agent", "r0", "--connect", closed, "--data", tmp_path)
    ((timeout, waited),) = waits
    ((name, endpoints, since),) = looked
    assert (name, endpoints, timeout) == ("r0", (closed,), connection.UNHEARD)
    assert begin < since < waited


def test_a_router_that_was_looked_for_long_enough_is_reported_at_once(closed, capfd, monkeypatch):
    monkeypatch.setattr(network, "SOON", 1000.0)
    settings = BusSettings(endpoints=(closed,))
    with closing(ZenohBus(settings)) as bus:
        network.warn_without_router(bus, "r0", settings, time.monotonic() - 1001.0)
        eventually(lambda: f"r0 finds no router at {closed}" in capfd.readouterr().err)


def test_asking_about_an_image(capfd, recording, tmp_path, closed):
    rest = ["--connect", closed]
    lonely = tmp_path / "a.png"
    lonely.write_bytes((recording / "images" / "0.png").read_bytes())
    assert "give the intrinsics with --camera" in complaint(capfd, "relocalize", lonely, *rest, status=USAGE)
    camera = ["--camera", recording / "camera.toml"]
    assert "no router" in complaint(capfd, "relocalize", lonely, *camera, *rest)
    assert "no such file" in complaint(capfd, "relocalize", lonely, "--camera", tmp_path / "b.toml", *rest)
    for known in (camera, []):
        assert "b.png: no such file" in complaint(capfd, "relocalize", tmp_path / "b.png", *known)
    for seconds in ("0", "-1", "nan", "inf"):
        output = complaint(capfd, "map", "retire", "r0.1", f"--timeout={seconds}", status=USAGE)
        assert f"--timeout {seconds}: give seconds" in output
    lonely.write_text("no image")
    assert "not an image" in complaint(capfd, "relocalize", lonely, *camera, *rest)
    assert "not an image" in complaint(capfd, "relocalize", tmp_path, *camera, *rest)
    cv2.imwrite(str(lonely), np.zeros((10, 20), np.uint8))
    assert f"{lonely}: 20x10 px, but {camera[1]} gives 64x48" in complaint(
        capfd, "relocalize", lonely, *camera, *rest
    )


@contextmanager
def started(*words: object, seconds: float = 40) -> Iterator[tuple[subprocess.Popen[str], IO[str]]]:
    """A `mapweave` process, which is killed after this time, and its stderr."""
    command = [sys.executable, "-m", "mapweave", *map(str, words)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as process:
        watchdog = threading.Timer(seconds, process.kill)
        watchdog.start()
        assert process.stderr is not None
        try:
            yield process, process.stderr
        finally:
            watchdog.cancel()
            process.kill()


def test_an_agent_interrupted_before_its_base_answers_reports_it(closed, tmp_path):
    with started("agent", "r0", "--connect", closed, "--data", tmp_path) as (process, _):
        eventually(lambda: (tmp_path / "r0.sqlite").exists())
        process.send_signal(signal.SIGINT)
        _, output = process.communicate()
    *before, last = output.splitlines()
    assert last.endswith("robot/r0/describe: stopped before its base has answered")
    known = ("waits for its robot", "finds no router", "no answer yet; start the robot's base")
    assert all(any(words in line for words in known) for line in before)
    assert process.returncode == 1


@pytest.mark.parametrize(("command", "hints"), [
    (["agent", "r0"], {"r0: waits for its robot", "r0 finds no router at {closed}: start"}),
    pytest.param(["sim", "serve", "office"], {"the simulator finds no router at {closed}: start"},
     marks=needs_simulator),
])  # fmt: skip
def test_waiting_is_reported_with_its_reason(command, hints, closed, tmp_path):
    data = ["--data", tmp_path] if command[0] == "agent" else []
    with started(*command, "--connect", closed, *data) as (process, stderr):
        for line in stderr:
            hints = {hint for hint in hints if hint.format(closed=closed) not in line}
            if not hints:
                break
        process.send_signal(signal.SIGINT)
        process.communicate()
    assert not hints


def test_a_router_that_lets_no_one_in_without_a_key_is_no_missing_router(tmp_path):
    """It said to start a server, and that was running, with keys."""
    with socket.create_server(("127.0.0.1", 0)) as there:
        endpoint = f"tcp/127.0.0.1:{there.getsockname()[1]}"
        with started("agent", "r0", "--connect", endpoint, "--data", tmp_path) as (agent, stderr):
            said = next((line for line in stderr if "finds no router" in line), "")
            agent.send_signal(signal.SIGINT)
            # Else the agent ends only when Zenoh gives up the attempt to connect, after 10 s.
            there.close()
            agent.communicate()
    assert f"r0 finds no router at {endpoint}: what listens there does not let this in" in said
    assert "--keys FILE" in said and "start `mapweave server`" not in said


def test_a_router_that_is_found_after_all_is_reported_once(closed, tmp_path):
    """The line that there is none was the last word, though the agent had long been connected."""
    words = "agent", "r0", "--connect", closed, "--data", tmp_path
    with started(*words, seconds=60) as (agent, stderr):
        lines = (line for line in stderr if " a router" in line or "finds no router" in line)
        assert "r0 finds no router" in next(lines, "")
        with closing(ZenohBus(BusSettings(mode="router", listen=(closed,)))):
            assert next(lines, "").rstrip().endswith("r0 has found a router")
            agent.send_signal(signal.SIGINT)
            assert not [line for line in lines if "router" in line]


def test_a_router_that_begins_to_listen_just_now_is_not_said_to_refuse(closed, capfd, monkeypatch):
    """Programs started within a second of the server asked for a key, and were let in a moment later."""
    settings, opened, judge = BusSettings(endpoints=(closed,)), [], connection.not_let_in

    def opening(settings):
        opened.append(ZenohBus(BusSettings(mode="router", listen=(closed,))))
        return judge(settings)

    monkeypatch.setattr(connection, "not_let_in", opening)
    with closing(ZenohBus(settings)) as bus:
        network.warn_without_router(bus, "r0", settings)
        eventually(lambda: bus.connected())
        # The thread looks again within this time.
        time.sleep(2 * network.LOOK)
        said = capfd.readouterr().err
        opened[0].close()
    assert "router" not in said


def test_a_router_that_is_lost_for_long_is_reported(closed, capfd, monkeypatch):
    monkeypatch.setattr(network, "LOST", 3.0)
    settings, said = BusSettings(endpoints=(closed,)), []

    def heard(words):
        said.extend(line.split(" ", 2)[2] for line in capfd.readouterr().err.splitlines() if " r0 " in line)
        return any(words in line for line in said)

    with closing(ZenohBus(settings)) as bus:
        with closing(ZenohBus(BusSettings(mode="router", listen=(closed,)))):
            eventually(bus.connected)
            network.warn_without_router(bus, "r0", settings)
            time.sleep(1.0)
        eventually(lambda: not bus.connected())
        assert not heard("router"), "a router that is restarted is not reported"
        eventually(lambda: heard(f"r0 finds no router at {closed}: start `mapweave server`"))
        with closing(ZenohBus(BusSettings(mode="router", listen=(closed,)))):
            eventually(lambda: heard("r0 has found a router"))
    assert len(said) == 2


def test_the_own_certificate_that_has_expired_is_named_by_an_agent(tmp_path, closed):
    """It said only that what listens there does not let it in."""
    path, at = expired_key(tmp_path / "keys"), closed.replace("tcp", "tls")
    router, _ = network.router_settings(NetworkSettings(endpoints=(at,), keys=str(tmp_path / "keys")), "s0")
    words = "agent", "r0", "--keys", path, "--connect", at, "--data", tmp_path
    with closing(ZenohBus(router)), started(*words) as (agent, stderr):
        said = next((line for line in stderr if "finds no router" in line), "")
        agent.send_signal(signal.SIGINT)
        agent.communicate()
    assert EXPIRED in said
    assert "`mapweave keys add r0 --role robot` at the server" in said


def printed(program: str) -> str:
    """What a program prints that ends well."""
    return python("-c", program, check=True).stdout


def status_without_terminal(program: str, gone: Path) -> int:
    """Exit status of a program whose terminal goes once it is "ready"; then there is the file `gone`."""
    master, slave = pty.openpty()
    run = [sys.executable, "-c", program]
    with subprocess.Popen(run, stdin=slave, stdout=slave, stderr=slave, start_new_session=True) as process:
        os.close(slave)
        output = b""
        while b"ready\r\n" not in output:
            output += os.read(master, 100)
        os.close(master)
        gone.touch()
        return process.wait(60)


def test_an_interrupt_that_a_library_swallows_stops_a_process():
    """While a library in C was imported, Ctrl-C was lost, and the simulator went on."""
    program = """
import signal
from mapweave import early_interrupt
from mapweave.commands.network import stop_on_signals
early_interrupt.remember()
assert not early_interrupt.came()
try:
    signal.raise_signal(signal.SIGINT)
except BaseException as error:
    print(type(error).__name__)
print(stop_on_signals().wait(0.0))
"""
    assert printed(program).split() == ["KeyboardInterrupt", "True"]


def test_an_interrupt_that_python_drops_comes_again():
    """As in a callback at the end of an import: `map merge` went on after Ctrl-C, with a traceback."""
    program = """
import signal, sys, time, weakref
sys.stderr = sys.stdout
from mapweave import early_interrupt
early_interrupt.remember()
class Lock: pass
lock = Lock()
reference = weakref.ref(lock, lambda _: signal.raise_signal(signal.SIGINT))
began = time.monotonic()
try:
    del lock
    time.sleep(20)
    print("went on")
except KeyboardInterrupt:
    print("interrupted" if time.monotonic() < began + 10 else "interrupted late")
class Other:
    def __del__(self): raise ValueError("of its own")
del reference
Other()
"""
    first, *rest = printed(program).splitlines()
    assert first == "interrupted" and rest[-1] == "ValueError: of its own", "others are printed as before"


@pytest.mark.parametrize(
    "error", ["ImportError('initialization failed')", "ModuleNotFoundError(name='scipy')"]
)
def test_an_interrupt_of_which_a_library_makes_another_error_is_one_line(error):
    """While pybullet was imported, Ctrl-C ended with a traceback."""
    program = f"""
import signal, sys
sys.stderr = sys.stdout
sys.argv = ["mapweave", "robots"]
from mapweave import start
from mapweave.commands import robots
def run(arguments):
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt:
        raise {error} from None
robots.run = run
print(start.main())
"""
    assert printed(program) == "mapweave: interrupted\n130\n"


def test_a_signal_amid_another_stops_a_process():
    """Ctrl-C twice, or a signal to a process and its group: the second handler waited for the first."""
    program = """
import signal
import socket
from mapweave.commands.network import stop_on_signals
stop = stop_on_signals()
with stop._cond:
    signal.raise_signal(signal.SIGINT)
    signal.raise_signal(signal.SIGTERM)
print(stop.wait(30))
"""
    assert printed(program) == "True\n"


def test_a_process_ends_in_order_with_its_terminal(tmp_path):
    """As when the connection to a robot breaks. Before, it ended at once, and what waited was not written."""
    program = f"""
import fcntl, pathlib, signal, sys, termios
from mapweave.commands.network import stop_on_signals
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # whatever the tests themselves were started with
fcntl.ioctl(0, termios.TIOCSCTTY)
stop = stop_on_signals()
print("ready", flush=True)
came = stop.wait(30)
print("ends", flush=True)
pathlib.Path({str(tmp_path / "written")!r}).write_text(str(came))
"""
    assert status_without_terminal(program, tmp_path / "gone") == 0
    assert (tmp_path / "written").read_text() == "True"


def test_a_process_that_ignores_the_end_of_its_terminal_goes_on_and_may_print(tmp_path):
    """As a job that its shell has disowned. Before, the first line that it printed ended it."""
    program = f"""
import logging, pathlib, signal, time
from mapweave.commands.network import stop_on_signals
from mapweave.terminal import log_with_time
signal.signal(signal.SIGHUP, signal.SIG_IGN)
log_with_time()
stop = stop_on_signals()
print("ready", flush=True)
gone = pathlib.Path({str(tmp_path / "gone")!r})
while not gone.exists():
    time.sleep(0.01)
print("goes on", flush=True)
logging.warning("and its log")
pathlib.Path({str(tmp_path / "written")!r}).write_text(str(stop.is_set()))
"""
    assert status_without_terminal(program, tmp_path / "gone") == 0
    assert (tmp_path / "written").read_text() == "False"


def test_nohup_keeps_a_process():
    program = """
import signal
import socket
signal.signal(signal.SIGHUP, signal.SIG_IGN)
from mapweave.commands.network import stop_on_signals
stop = stop_on_signals()
signal.raise_signal(signal.SIGHUP)
print(stop.wait(0.3))
"""
    assert printed(program) == "False\n"
