"""The simulation on the bus: time advances when every active robot has asked for its next step."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from mapweave.agent.drivers.messages import (
    AGAIN,
    ENDED,
    StepRequest,
    decode_step,
    encode_description,
    encode_observation,
)
from mapweave.agent.drivers.robot import clip
from mapweave.hybridmap.errors import MapweaveError
from mapweave.sim.ground_truth_service import GroundTruthService
from mapweave.sim.keys import SimKeys
from mapweave.sim.lockstep import Seat, StepBarrier
from mapweave.sim.lockstep_robot import Rendezvous, decode_rendezvous
from mapweave.wire.bus import Bus, Request

if TYPE_CHECKING:
    from mapweave.sim.simulation import Simulation

log = logging.getLogger(__name__)

POLL = 0.1
"""How often an idle bridge checks for its end and its time limits, s."""


class SimBridge:
    """Serves every robot of a simulation, and the control key.

    The bus's thread only puts questions into an inbox. Only the thread that calls `run` touches the
    simulation, so it needs no locks, and interventions happen between ticks.
    """

    def __init__(
        self,
        simulation: Simulation,
        bus: Bus,
        fleet: str,
        patience: float = 20.0,
        farewell: float = 2.0,
        held: bool = False,
    ) -> None:
        """Serve from now on; questions wait for `run`.

        Args:
            simulation: what is simulated.
            bus: the connection.
            fleet: which fleet.
            patience: how long the other robots wait for one that does not ask, s.
            held: let no time pass until a client asks for it (see SimControl.advance).
            farewell: how long `close` waits for agents that do not know of the end yet, s.
        """
        keys = SimKeys(fleet)
        self._keys = keys
        self._simulation = simulation
        self._farewell = farewell
        self._lockstep = StepBarrier(simulation.robots, patience)
        self._wall = dict.fromkeys(("waiting", "replying", "control"), 0.0)
        self._ground_truth = GroundTruthService(simulation, lambda: self._lockstep.active, self._wall)
        self._changed = threading.Condition()
        self._inbox: deque[Callable[[], None]] = deque()
        self._limit: int | None = 0 if held else None
        self._advancing: Request | None = None
        self._ended = False
        self._announced: set[str] = set()
        self._declared = [bus.watch(keys.robot_drivers(), self._presence)]
        for name in simulation.robots:
            self._declared.append(bus.serve(keys.robot_describe(name), self._describer(name)))
            self._declared.append(bus.serve(keys.robot_step(name), self._stepper(name, decode_step)))
            self._declared.append(bus.serve(keys.rendezvous(name), self._stepper(name, decode_rendezvous)))
        self._declared.append(bus.serve(keys.control(), self._control))
        self._declared.append(bus.announce(keys.sim_alive()))

    def run(self, stop: threading.Event) -> None:
        """Simulate until stopped; then refuse further questions.

        Raises:
            MapweaveError: the simulation fails.
        """
        try:
            while not stop.is_set():
                self._read_inbox()
                seats = self._lockstep.due(time.monotonic())
                asking = [seat for seat in seats if isinstance(seat.step, Rendezvous)]
                if asking:
                    # All have finished the tick: these may ask the fleet now, the others wait for them.
                    for seat in asking:
                        self._lockstep.answer(seat, b"", time.monotonic())
                elif self._may_advance(seats):
                    self._tick(seats)
                else:
                    if seats or not self._lockstep.active:
                        self._reached()
                    self._wait()
        finally:
            self._end()

    def close(self) -> None:
        """Announce the end to the agents, then leave the bus. Idempotent."""
        self._end()
        with self._changed:
            if not self._changed.wait_for(lambda: self._lockstep.active <= self._announced, self._farewell):
                untold = sorted(self._lockstep.active - self._announced)
                log.info("these robots' agents have not asked since the end: %s", ", ".join(untold))
                self._announced.update(untold)
        for declared in self._declared:
            declared.close()

    # In the thread that runs the simulation.

    def _tick(self, seats: list[Seat]) -> None:
        """Advance by one tick, then sense and answer robot by robot: one thinks while the next is sensed."""
        commands = {}
        for seat in seats:
            if isinstance(seat.step, StepRequest):
                commands[seat.name] = clip(seat.step.command, self._simulation.describe(seat.name))
        self._simulation.advance(commands)
        for seat in seats:
            observation = self._simulation.observe(seat.name)
            with self._timed("replying"):
                self._lockstep.answer(seat, encode_observation(observation), time.monotonic())

    def _may_advance(self, seats: list[Seat]) -> bool:
        """Whether to tick: when all have asked, or no robot is driven and a client wants time to pass."""
        if self._limit is None:
            return bool(seats)
        return self._simulation.tick < self._limit and (bool(seats) or not self._lockstep.active)

    def _reached(self) -> None:
        """The requested time is simulated, and every robot has finished: answer the waiting clients."""
        if self._advancing is not None:
            self._advancing.reply(self._ground_truth.reached())
            self._advancing = None

    def _advance(self, tick: int, request: Request) -> None:
        if self._advancing is not None:
            self._advancing.refuse(f"asked again, {AGAIN}")
        self._limit, self._advancing = tick, request

    def _read_inbox(self) -> None:
        while self._inbox:
            self._inbox.popleft()()

    def _wait(self) -> None:
        with self._timed("waiting"), self._changed:
            self._changed.wait_for(lambda: bool(self._inbox), POLL)

    def _answer_control(self, request: Request) -> None:
        with self._timed("control"):
            try:
                tick = self._ground_truth.advances_to(request.payload)
                if tick is not None:
                    self._advance(tick, request)
                    return
                request.reply(self._ground_truth.answer(request.payload))
            except MapweaveError as error:
                request.refuse(str(error))

    def _end(self) -> None:
        with self._changed:
            if self._ended:
                return
            self._ended = True
        # From here on handlers refuse by themselves, so that nothing comes after this.
        self._read_inbox()
        if self._advancing is not None:
            self._advancing.refuse(ENDED)
            self._advancing = None
        self._announce(self._lockstep.refuse_all(ENDED))

    @contextmanager
    def _timed(self, part: str) -> Iterator[None]:
        begin = time.perf_counter()
        try:
            yield
        finally:
            self._wall[part] += time.perf_counter() - begin

    # In the bus's thread.

    def _describer(self, name: str) -> Callable[[Request], None]:
        answer = encode_description(self._simulation.describe(name))
        return lambda request: request.reply(answer)

    def _stepper(
        self, name: str, decode: Callable[[bytes], StepRequest | Rendezvous]
    ) -> Callable[[Request], None]:
        def take(request: Request) -> None:
            step = decode(request.payload)
            if not self._put(lambda: self._receive(name, step, request)):
                request.refuse(ENDED)
                self._announce({name})

        return take

    def _receive(self, name: str, step: StepRequest | Rendezvous, request: Request) -> None:
        self._lockstep.receive(name, step, request, time.monotonic())

    def _control(self, request: Request) -> None:
        if not self._put(lambda: self._answer_control(request)):
            request.refuse(ENDED)

    def _presence(self, key: str, alive: bool) -> None:
        robot, driver = self._keys.parse_robot_driver(key)
        if not self._put(lambda: self._lockstep.presence(robot, driver, alive)) and not alive:
            self._announce({robot})

    def _put(self, task: Callable[[], None]) -> bool:
        """Leave a task for the simulation's thread; False if that has ended."""
        with self._changed:
            if self._ended:
                return False
            self._inbox.append(task)
            self._changed.notify_all()
            return True

    def _announce(self, names: set[str]) -> None:
        """Remember which agents know of the end, or need not know."""
        with self._changed:
            self._announced |= names
            self._changed.notify_all()
