"""The sketch of docs/arduino.md, compiled for this machine, at the far end of a pseudo-terminal."""

import os
import pty
import re
import shutil
import subprocess
import threading
import time
import tty
from pathlib import Path

import numpy as np
import pytest

from mapweave.agent.drivers.arduino import Arduino
from mapweave.agent.drivers.settings import CameraSettings, Geometry, RobotSettings
from mapweave.agent.observation import Command
from tests.agent.drivers.contract import SLACK, STOPS_WITHIN, drive

ROOT = Path(__file__).parents[3]

ARDUINO = r"""
// What the Arduino core gives a sketch, with motors whose wheels turn at once, and encoders on them.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <algorithm>
#include <ctime>
#include <fcntl.h>
#include <poll.h>
#include <termios.h>
#include <unistd.h>
typedef unsigned char byte;
enum { LOW, HIGH, INPUT_PULLUP, OUTPUT, RISING };
template <class T, class L, class H> T constrain(T x, L low, H high) {
  return x < low ? T(low) : x > high ? T(high) : x;
}
static int port, pins[64];
static double level[2];
static unsigned long millis() {
  timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return t.tv_sec * 1000ul + t.tv_nsec / 1000000;
}
void noInterrupts() {}
void interrupts() {}
void pinMode(int, int) {}
int digitalPinToInterrupt(int pin) { return pin; }
static void (*handlers[2])();
void attachInterrupt(int pin, void (*handler)(), int) { handlers[pin - 2] = handler; }
void digitalWrite(int pin, int value) { pins[pin] = value; }
int digitalRead(int pin) { return pin == 12 ? HIGH : pins[pin]; }
void analogWrite(int pin, int value) { level[pin - 9] = value / 255.0 * (pins[pin - 2] ? 1 : -1); }
struct {
  void begin(long) {}
  bool available() {
    pollfd p = {port, POLLIN, 0};
    return poll(&p, 1, 0) > 0 && (p.revents & POLLIN);
  }
  char read() { char c = 0; if (::read(port, &c, 1) < 1) exit(0); return c; }
  void print(const char *s) { if (write(port, s, strlen(s)) < 0) exit(0); }
  void print(char c) { if (write(port, &c, 1) < 0) exit(0); }
  void print(long n) { char b[24]; snprintf(b, sizeof b, "%ld", n); print(b); }
  void println(int n) { print((long)n); print("\r\n"); }
} Serial;
"""

MAIN = r"""
int main(int, char **arguments) {
  port = atoi(arguments[1]);
  setup();
  double at[2] = {0, 0};
  long seen[2] = {0, 0};
  unsigned long before = millis(), said = 0;
  for (;;) {
    usleep(500);
    unsigned long now = millis();
    for (int wheel = 0; wheel < 2; wheel++) {
      at[wheel] += level[wheel] * 600.0 / MM_PER_COUNT * (now - before) / 1000.0;
      for (; seen[wheel] < (long)std::floor(at[wheel]); seen[wheel]++) {
        pins[ENCODER_B[wheel]] = wheel == 0;
        handlers[wheel]();
      }
      for (; seen[wheel] > (long)std::floor(at[wheel]); seen[wheel]--) {
        pins[ENCODER_B[wheel]] = wheel == 1;
        handlers[wheel]();
      }
    }
    before = now;
    loop();
    if (now - said >= 5) {
      said = now;
      double m = MM_PER_COUNT / 1e3;
      printf("%f %f %f %f\n", level[0] * 0.6, level[1] * 0.6, at[0] * m, at[1] * m);
      fflush(stdout);
    }
  }
}
"""


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("needs g++")
    result = re.search(r"```cpp\n(.*?)```", (ROOT / "docs" / "arduino.md").read_text(), re.DOTALL)
    assert result is not None
    folder = tmp_path_factory.mktemp("sketch")
    source, program = folder / "sketch.cpp", folder / "sketch"
    source.write_text(ARDUINO + result[1] + MAIN)
    subprocess.run([compiler, "-w", "-O1", "-o", str(program), str(source)], check=True)
    return program


@pytest.mark.slow
def test_the_sketch_drives_counts_and_stops_by_itself(program: Path, video: Path):
    master, slave = pty.openpty()
    tty.setraw(slave)
    board = subprocess.Popen([program, str(master)], pass_fds=[master], stdout=subprocess.PIPE, text=True)
    wheels: list[tuple[float, list[float]]] = []
    assert board.stdout is not None

    def watch() -> None:
        # Each line gets the time at which it came.
        wheels.extend(
            (time.monotonic(), [float(part) for part in line.split()]) for line in board.stdout or ()
        )

    watching = threading.Thread(target=watch)
    watching.start()
    settings = RobotSettings(
        options={"port": os.ttyname(slave), "wheel_radius": 0.033, "counts_per_turn": 1440},
        camera=CameraSettings(64, 48, 60.0, 60.0, 32.0, 24.0, 0.3, source=str(video)),
        geometry=Geometry(radius=0.12, axle=0.15),
    )
    robot = Arduino(settings)
    try:
        robot.sense()
        seen = [*drive(robot, Command(0.2, 0.0), 1.5), *drive(robot, Command(-0.05, 1.0), 1.0)]
        seen += drive(robot, Command(), 0.5)
        left, right = wheels[-1][1][2:]
        assert left + right > 0.4
        forward, turn = (sum(getattr(o.odometry, name) for o in seen) for name in ("forward", "turn"))
        assert forward == pytest.approx((left + right) / 2, abs=0.005)
        assert turn == pytest.approx((right - left) / 0.15, abs=0.05)
        # Its speed controller reaches the speed.
        drive(robot, Command(0.2, 0.0), 1.5)
        begin = wheels[-1]
        drive(robot, Command(0.2, 0.0), 1.0)
        (then, before), (now, after) = begin, wheels[-1]
        assert np.subtract(after[2:], before[2:]) / (now - then) == pytest.approx([0.2, 0.2], abs=0.03)
        last = time.monotonic()
        time.sleep(1.0)
        stopped = next(at for at, text in wheels if at > last and text[:2] == [0.0, 0.0])
        assert stopped - last < STOPS_WITHIN + SLACK
        assert wheels[-1][1][:2] == [0.0, 0.0]
    finally:
        robot.close()
        board.kill()
        board.wait()
        watching.join()
        board.stdout.close()
        os.close(master)
        os.close(slave)
