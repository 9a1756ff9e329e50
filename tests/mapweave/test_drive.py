"""`mapweave drive` on a real pseudo-terminal, and by a device file, drives a real agent in the simulator."""

import os
import pty
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator

import pytest

from mapweave.hybridmap.pose import Pose2
from mapweave.scenarios.children import Children
from mapweave.sim.ground_truth_client import SimControl
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.zenoh_bus import ZenohBus
from tests.mapweave.command_line import complaint
from tests.simulator import needs_simulator
from tests.waiting import eventually, free_port

FLEET = "hand"
WORLD = """
name = "alone"
seed = 3
[[robot]]
name = "r0"
rangers = 0
[world]
kind = "arena"
[[events]]
at = 600.0
do = "wait"
"""


class Person:
    """A person at a terminal with `mapweave drive`."""

    def __init__(self, *arguments: str) -> None:
        self._side, slave = pty.openpty()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "mapweave", "drive", *arguments],
            stdin=slave, stdout=slave, stderr=slave, close_fds=True,
        )  # fmt: skip
        os.close(slave)
        self.screen = ""
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        try:
            while data := os.read(self._side, 4096):
                self.screen += data.decode()
        except OSError:
            pass

    def press(self, keys: bytes) -> None:
        os.write(self._side, keys)

    def end(self) -> None:
        self.process.kill()
        self.process.wait()
        self._reader.join(5.0)
        os.close(self._side)


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[list[str], SimControl]]:
    """A simulated robot without rangers, its agent, and what the simulator knows."""
    folder = tmp_path_factory.mktemp("drive")
    (folder / "alone.toml").write_text(WORLD)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    arguments = ["--fleet", FLEET, "--connect", endpoint]
    bus = ZenohBus(BusSettings(mode="client", endpoints=(endpoint,)))
    try:
        with Children(folder / "logs") as children:
            children.start(
                "sim", ["sim", "serve", str(folder / "alone.toml"), "--fleet", FLEET, "--listen", endpoint]
            )
            children.start("r0", ["agent", "r0", "--data", str(folder), *arguments])
            log = folder / "logs" / "r0.log"

            def ready() -> bool:
                children.check()
                return "standing still" in log.read_text()

            eventually(ready)
            said = " ".join(log.read_text().split())
            assert "`mapweave drive r0`" in said
            assert "--without-rangers" in said
            yield arguments, SimControl(bus, FLEET)
    finally:
        bus.close()


def pose(control: SimControl) -> Pose2:
    """The robot's true pose."""
    return control.status().robots["r0"].world_from_robot


def still(control: SimControl) -> bool:
    """Whether time passes and the robot stays where it is."""
    before, tick = pose(control), control.status().tick
    eventually(lambda: control.status().tick > tick + 20)
    return before.distance(pose(control)) < 0.003


@pytest.mark.slow
@needs_simulator
def test_a_robot_is_driven_by_keys_maps_and_stands_when_who_drives_is_killed(
    network: tuple[list[str], SimControl],
):
    arguments, control = network
    start = pose(control)
    person = Person("r0", *arguments)
    try:
        eventually(lambda: "q quits" in person.screen)
        assert still(control), "without a key it stands"

        def pressed(keys: bytes) -> Pose2:
            person.press(keys)
            return pose(control)

        eventually(lambda: pressed(b"w").distance(start) > 0.3)
        ahead = (start.inverse() @ pose(control)).x
        assert ahead > 0.25
        person.press(b" ")
        eventually(lambda: still(control))
        heading = pose(control).heading
        eventually(lambda: abs(pressed(b"\x1b[D").heading - heading) > 0.3)
        eventually(lambda: "driven by a person" in person.screen)
        eventually(lambda: pressed(b"w") and " 0 nodes" not in person.screen.rpartition("map r0.")[2])
        assert "x " in person.screen
        # Killed while a key is held: the last command was to drive.
        person.press(b"w")
        person.process.send_signal(signal.SIGKILL)
        person.process.wait()
        eventually(lambda: still(control))
    finally:
        person.end()
    other = Person("r0", *arguments)
    try:
        eventually(lambda: "driven by a person" in other.screen)
        other.press(b"q")
        assert other.process.wait(20) == 0
    finally:
        other.end()


@pytest.mark.slow
@needs_simulator
def test_a_robot_is_driven_by_a_gamepad_and_a_second_person_is_refused(
    network: tuple[list[str], SimControl], tmp_path
):
    arguments, control = network
    device = tmp_path / "js0"
    os.mkfifo(device)
    person = Person("r0", *arguments, "--gamepad", str(device))
    try:
        # Opened for both, so that neither side waits for the other.
        with os.fdopen(os.open(device, os.O_RDWR), "wb", buffering=0) as gamepad:
            eventually(lambda: "stick" in person.screen)
            start = pose(control)
            # struct js_event: u32 ms, s16 value, u8 type, u8 number. The stick to the back, then let go.
            gamepad.write(bytes([0x10, 0, 0, 0, 0xFF, 0x7F, 0x02, 0x01]))
            eventually(lambda: (start.inverse() @ pose(control)).x < -0.1)
            second = Person("r0", *arguments)
            try:
                assert second.process.wait(30) == 1
                eventually(lambda: "another `mapweave drive` drives this robot" in second.screen)
            finally:
                second.end()
            gamepad.write(bytes([0x20, 0, 0, 0, 0x00, 0x00, 0x02, 0x01]))
            eventually(lambda: still(control))
            person.process.send_signal(signal.SIGINT)
            assert person.process.wait(20) == 0
    finally:
        person.end()


@pytest.mark.slow
@needs_simulator
def test_who_is_not_there_is_named_in_one_line(network: tuple[list[str], SimControl], tmp_path, capfd):
    arguments, _ = network
    person = Person("r7", *arguments)
    try:
        assert person.process.wait(30) == 1
        eventually(
            lambda: "no agent r7 in fleet hand: start `mapweave agent r7`; there are r0" in person.screen
        )
    finally:
        person.end()
    assert "gamepad" in complaint(capfd, "drive", "r0", "--gamepad", str(tmp_path / "none"))
    assert "needs a terminal" in complaint(capfd, "drive", "r0", "--connect", f"tcp/127.0.0.1:{free_port()}")
