"""A simulated robot in real time as a Koala is wired: a serial line, and a camera that streams over HTTP."""

import threading
import time
from pathlib import Path

import cv2
import numpy as np

from mapweave import Command, Observation, Pose2
from mapweave.sim.simulation import Simulation
from tests.agent.drivers.emulators import Koala25, KoalaSilver, LineEmulator, TwoWheels
from tests.mjpeg_stream import MjpegStream

RANGERS = 72
"""Of the simulated robot, 5 degrees apart; a Koala has some of them."""


class SimulatedWheels(TwoWheels):
    """Wheels that are the simulated robot's: what the encoders say comes from there."""

    def __init__(self, axle: float, tick: float) -> None:
        super().__init__()
        self._axle = axle
        self._tick = tick
        self._ways = [(0.0, 0.0), (0.0, 0.0)]
        self._at = time.monotonic()

    def command(self) -> Command:
        """What the wheels shall do."""
        left, right = self.speeds
        return Command((left + right) / 2, (right - left) / self._axle)

    def turned(self, observation: Observation) -> None:
        """A tick is over."""
        u = observation.odometry
        left, right = u.forward - u.turn * self._axle / 2, u.forward + u.turn * self._axle / 2
        with self._lock:
            before = self._ways[1]
            self._ways = [before, (before[0] + left, before[1] + right)]
            self._at = time.monotonic()

    def way(self) -> tuple[float, float]:
        """Between the last two ticks, one tick late: encoders do not leap."""
        with self._lock:
            share = min((time.monotonic() - self._at) / self._tick, 1.0)
            (l0, r0), (l1, r1) = self._ways
            return l0 + share * (l1 - l0), r0 + share * (r1 - r0)


class InSimulation(LineEmulator):
    """Runs one robot of a simulation in real time; its only ends are the serial port and the stream's URL."""

    def __init__(self, folder: Path, simulation: Simulation, name: str) -> None:
        super().__init__(folder)
        self._simulation, self._name = simulation, name
        description = simulation.describe(name)
        self._tick = description.tick
        self.wheels = self._wheels = SimulatedWheels(description.axle, description.tick)
        # The simulation is touched between ticks only.
        self.world = threading.RLock()
        self._jpeg = b""
        self._new = threading.Condition()
        self._shown: list[tuple[int, Pose2]] = []
        self.late = 0
        self.ticks = 0
        self._stream = MjpegStream(self._next_frame)
        self.url = self._stream.url
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def truth_at(self, stamp_ns: int) -> Pose2:
        """`world_from_robot` when a frame was shown."""
        stamps = [shown for shown, _ in self._shown]
        at = min(range(len(stamps)), key=lambda k: abs(stamps[k] - stamp_ns))
        return self._shown[at][1]

    def close(self) -> None:
        self._closing = True
        self._stream.close()
        self._thread.join()
        super().close()

    def _next_frame(self) -> bytes | None:
        if self._closing:
            return None
        with self._new:
            self._new.wait(1.0)
            return self._jpeg

    def _run(self) -> None:
        """A tick each tick; a frame is shown when the encoders, one tick late, have got to it."""
        due, frame, pose = time.monotonic(), None, self._simulation.truth(self._name)
        while not self._closing:
            with self.world:
                self._simulation.advance({self._name: self._wheels.command()})
                seen, taken = self._simulation.observe(self._name), self._simulation.truth(self._name)
            due += self._tick
            self.late += time.monotonic() > due
            self.ticks += 1
            time.sleep(max(due - time.monotonic(), 0.0))
            due = max(due, time.monotonic() - self._tick)
            if frame is not None:
                with self._new:
                    self._jpeg = frame
                    self._new.notify_all()
                self._shown.append((time.time_ns(), pose))
            self._wheels.turned(seen)
            self.feel(seen.proximity)
            if seen.image is not None:
                pose = taken
                frame = cv2.imencode(".jpg", seen.image, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()

    def feel(self, proximity: np.ndarray) -> None:
        """Set the readings of the sensors."""
        raise NotImplementedError


def at(proximity: np.ndarray, bearing_deg: int) -> float:
    """Distance in a direction, m."""
    return float(proximity[round(bearing_deg % 360 / 360 * RANGERS) % RANGERS])


class Koala25InSimulation(InSimulation, Koala25):
    """Koala 2.5 with nine ultrasonic sensors; manual, section 4.1."""

    BEARINGS_DEG = (110, 70, 35, 0, -35, -70, -110, -160, 160)
    """Left rear, left front, front left, front, and so on clockwise to back left."""

    def feel(self, proximity: np.ndarray) -> None:
        """Readings from 25 to 250 cm."""
        centimetres = [100.0 * at(proximity, bearing) for bearing in self.BEARINGS_DEG]
        self.ultrasonic = [1000 if c >= 249.5 else 0 if c < 25.0 else round(c) for c in centimetres]


class KoalaSilverInSimulation(InSimulation, KoalaSilver):
    """Koala silver edition with sixteen infrared sensors that reach 20 cm."""

    BEARINGS_DEG = (5, 20, 35, 55, 75, 105, 135, 170)
    """Of the left side, from the front; the right side is mirrored."""

    def feel(self, proximity: np.ndarray) -> None:
        """Reflected light falls with the square of the distance; ten bits."""
        both = [*self.BEARINGS_DEG, *(-bearing for bearing in self.BEARINGS_DEG)]
        light = [20 * (0.2 / max(at(proximity, bearing), 0.01)) ** 2 for bearing in both]
        self.infrared = [min(round(value), 1023) for value in light]
