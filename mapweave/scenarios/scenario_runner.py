"""Runs a scenario on a fleet, event by event. Simulated time stops while the runner checks or acts: so its
decisions do not depend on the speed of the machine.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from mapweave.fleet import send_order
from mapweave.hybridmap.agent_status import AgentStatus
from mapweave.hybridmap.errors import InvalidValue, NotConnected
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.mission_order import MissionKind, MissionOrder
from mapweave.hybridmap.pose import Pose2
from mapweave.scenarios import actions
from mapweave.scenarios.actions import MISSION_KINDS
from mapweave.scenarios.fleet import SERVER, TICKS_PER_SECOND, TrialFleet, TrialStage
from mapweave.scenarios.kidnap_events import KidnapEvents
from mapweave.scenarios.lying import Lies, lie
from mapweave.scenarios.photographing import beside, photograph
from mapweave.scenarios.portal_events import PortalEvents
from mapweave.scenarios.recording import Lost, TrialEvent
from mapweave.scenarios.reports import Reports
from mapweave.scenarios.scenario import CONDITIONS, LONGEST, ScenarioEvent, When
from mapweave.sim import events
from mapweave.storage.map_file import MapFile

CHECK_EVERY = {"joined": 10.0, "explored": 5.0, "found": 1.0, "arrived": 1.0, "asked": 1.0, "grown": 1.0}
"""How often a condition is checked, simulated s."""
STRIDE = 5.0
"""Time is let go on by at most this without showing progress, s."""
HAPPEN_TRIES = 20
"""How often an event without room is tried (a person cannot walk through a robot), once a second."""
ABDUCT_TRIES, ABDUCT_PAUSE = 8, 10.0
"""How often a kidnapping is tried, and how long the robots explore on in between, simulated s."""
RECOVERY_PATIENCE = 120.0
"""How long all may take to be well again after something came back, wall s."""

SENDER = "scenario"
"""Gives the missions."""


class ScenarioRunner:
    """Lets a scenario happen.

    Attributes:
        moments: what was done and noticed.
        recoveries_s: wall time that each return took.
        now: simulated time, s.
        done: how many events have happened.
        doing: what is waited for, or done.
        agents: last status of those in reach.
        lies: what came of a robot's lies, if one has lied.
        photographed: where photographs that are nodes were really taken: `world_from_robot`.
    """

    def __init__(
        self,
        stage: TrialStage,
        fleet: TrialFleet,
        on_look: Callable[[ScenarioRunner], None] = lambda runner: None,
        stride: float = STRIDE,
    ) -> None:
        """Take the means.

        Args:
            stage: what is tried, and where.
            fleet: started.
            on_look: called whenever simulated time stops: for progress, film and live view.
            stride: how long time goes on between two such calls at most, simulated s.
        """
        self._stage = stage
        self._fleet = fleet
        self._on_look = on_look
        self._stride = min(stride, STRIDE)
        self.reports = Reports(fleet.bus, fleet.keys)
        self.moments: list[TrialEvent] = []
        self.recoveries_s: list[float] = []
        self.now = 0.0
        self.done = 0
        self.doing = "starting"
        self.agents: dict[str, AgentStatus] = {}
        self._alive = set(stage.robots)
        self._cut: set[str] = set()
        self.photographed: dict[NodeId, Pose2] = {}
        self._losing = KidnapEvents(stage, fleet, self._command, self.note)
        self._portals = PortalEvents(stage, fleet, self.note)
        self.lies: Lies | None = None
        self._grown: tuple[str, int] = ("", 0)

    def run(self) -> None:
        """All events, in order.

        Raises:
            MapweaveError: a process died unexpectedly, or an event cannot happen.
        """
        for event in self._stage.scenario.events:
            self.doing = _in_words(event)
            self._wait(event.when)
            self._act(event)
            self.done += 1
            self._on_look(self)

    @property
    def lost(self) -> list[Lost]:
        """Robots that were carried away, or sent."""
        return self._losing.lost

    def merged(self) -> MapFile:
        """The server's merged map; see Losing.merged."""
        return self._losing.merged()

    def note(self, text: str, trouble: bool = False) -> None:
        """Remember that something happened now."""
        self.moments.append(TrialEvent(round(self.now * 1e9), text, trouble))

    # Waiting

    def _wait(self, when: When) -> None:
        began = self.now
        since = began if not when.after else None
        end = began + when.within if when.within < LONGEST else LONGEST * 10
        while True:
            if since is None and self._true(when.after):
                since = self.now
                self.note(f"{CONDITIONS[when.after]}: yes")
            due = max(when.at, since + when.plus) if since is not None else LONGEST * 10
            if self.now >= due - 1e-6:
                return
            if self.now >= end - 1e-6:
                if when.after:
                    self.note(f"{CONDITIONS[when.after]}: not within {when.within:.0f} s", True)
                return
            next_check = self.now + (CHECK_EVERY[when.after] if when.after and since is None else STRIDE)
            self._advance(min(due, end, next_check))

    def _advance(self, until: float) -> None:
        while self.now < until - 1e-6:
            tick = round(min(until, self.now + self._stride) * TICKS_PER_SECOND)
            tick = max(tick, round(self.now * TICKS_PER_SECOND) + 1)
            self._fleet.advance(tick)
            self.now = tick / TICKS_PER_SECOND
            self._look()

    def _look(self) -> None:
        self.agents = self.reports.agents(sorted(self._alive - self._cut))
        self._losing.look(self.agents)
        self._on_look(self)

    def _true(self, condition: str) -> bool:
        match condition:
            case "joined":
                server = self.reports.server(SERVER)
                return server.components == 1 and server.maps >= len(self._stage.robots)
            case "explored":
                exploring = [a for a in self.agents.values() if a.status.mission == "explore"]
                return bool(exploring) and all(a.status.finished for a in exploring)
            case "found":
                return bool(self.lost) and self.lost[-1].fix is not None
            case "arrived":
                sent = self._losing.sent.values()
                return bool(sent) and all(one.arrived_ns is not None for one in sent)
            case "asked":
                return bool(self._portals.waiting(self.agents))
            case _:
                robot, nodes = self._grown
                return robot in self.agents and self.agents[robot].status.nodes > nodes

    # Acting

    def _act(self, event: ScenarioEvent) -> None:
        fleet, action = self._fleet, event.action
        match action:
            case actions.Wait():
                pass
            case actions.SetMission(mission, robot):
                names = sorted(self._alive - self._cut) if robot == actions.ALL_ROBOTS else [robot]
                for name in names:
                    self._command(name, MISSION_KINDS[mission])
                self.note(f"{', '.join(names)}: {mission}")
            case actions.Abduct(robot):
                self._abduct(robot)
            case actions.Send(robot, goal):
                if goal == "photographed":
                    if not self.photographed:
                        raise InvalidValue("goto: goal = 'photographed', and nothing was photographed before")
                    goal = str(next(reversed(self.photographed)))
                if goal == "beyond":
                    if self._portals.goal is None:
                        raise InvalidValue("goto: goal = 'beyond', and there are no floors")
                    goal = str(self._portals.goal)
                self._losing.send(robot, goal)
            case actions.MapByPhotographs(robot):
                self.photographed |= photograph(self._stage, fleet, action)
                first = next(pose for node, pose in self.photographed.items() if node.agent == action.name)
                self.note(f"{action.count} photographs become map {action.name}")
                fleet.control.kidnap(robot, beside(first, self._stage.seed))
                self._losing.mark(robot)
            case actions.TryLies(robot):
                self._recover(time.monotonic())
                self.lies = lie(self._stage, fleet, action, self.merged(), self.note)
            case actions.Floors():
                self._portals.label(self.merged())
            case actions.TakeThrough():
                if not self._portals.take_through(self.agents, self.merged()):
                    self.note("no robot asks to be taken through a lift", True)
            case events.Kidnap(robot):
                self._happen(event.table)
                self._losing.mark(robot)
            case actions.KillAgent(robot):
                before = self.agents.get(robot)
                self._grown = (robot, before.status.nodes if before is not None else 0)
                fleet.kill_agent(robot)
                self._alive.discard(robot)
                self.note(f"the agent of {robot} is killed")
            case actions.StartAgent(robot):
                began = time.monotonic()
                fleet.start_agent(robot)
                self._alive.add(robot)
                self.note(f"the agent of {robot} is started again")
                self._recover(began)
            case actions.KillServer():
                fleet.kill_server()
                self.note("the map server is killed")
            case actions.StartServer():
                began = time.monotonic()
                fleet.start_server()
                self.note("the map server is started again")
                self._recover(began)
            case actions.Cut(robot):
                fleet.cut(robot)
                self._cut.add(robot)
                self.note(f"the network of {robot} is cut")
            case actions.Worsen(robot, loss, delay):
                fleet.worsen(robot, loss, delay)
                self.note(f"the network of {robot} loses {loss:.0%} and delays by {delay:g} s")
            case actions.Restore(robot):
                began = time.monotonic()
                fleet.restore(robot)
                self._cut.discard(robot)
                self.note(f"the network of {robot} is back")
                self._recover(began)
            case _:
                self._happen(event.table)

    def _abduct(self, robot: str) -> None:
        """Kidnap a robot; where idle robots are in the way, they first explore on for a while."""
        for _ in range(ABDUCT_TRIES):
            reason = self._losing.abduct(robot)
            if not reason:
                return
            idle = [name for name, agent in self.agents.items() if agent.status.mission == "idle"]
            self.note(f"no robot can be kidnapped now, {', '.join(idle) or 'none'} explores on: {reason}")
            for name in idle:
                self._command(name, MissionKind.EXPLORE)
            self._advance(self.now + ABDUCT_PAUSE)
            for name in idle:
                self._command(name, MissionKind.STOP)
            self._advance(self.now + 1.0)
        self.note(f"no robot is kidnapped: {reason}", True)

    def _happen(self, table: Mapping[str, Any]) -> None:
        """Something happens to the world, as soon as there is room for it."""
        for _ in range(HAPPEN_TRIES):
            try:
                self.note(self._fleet.control.apply(table))
                return
            except InvalidValue as error:
                reason = str(error)
            self._advance(self.now + 1.0)
        self.note(f"event {table['do']} did not happen within {HAPPEN_TRIES} s: {reason}", True)

    def _recover(self, began: float) -> None:
        """Wait, while simulated time is stopped, until the server has all changes of every robot."""
        end = began + RECOVERY_PATIENCE
        while not self._all_well():
            if time.monotonic() > end:
                self.note(f"not all was well again after {RECOVERY_PATIENCE:.0f} s", True)
                return
            time.sleep(0.02)
        self.recoveries_s.append(time.monotonic() - began)
        self.note(f"all is well again after {self.recoveries_s[-1]:.2f} s of wall time")

    def _all_well(self) -> bool:
        """Whether every agent that should be in reach is, and has sent everything to the server."""
        names = sorted(self._alive - self._cut)
        agents = self.reports.agents(names)
        if len(agents) < len(names) or any(a.unsent or not a.linked for a in agents.values()):
            return False
        try:
            self.reports.server(SERVER)
        except NotConnected:
            return False
        return True

    def _command(self, robot: str, kind: MissionKind, node: NodeId | None = None) -> None:
        send_order(self._fleet.bus, self._fleet.keys, MissionOrder.new(robot, kind, SENDER, node))


def _in_words(event: ScenarioEvent) -> str:
    when = event.when
    table = {name: value for name, value in event.table.items() if name != "do"}
    words_of_event = " ".join([str(event.table["do"]).replace("_", " "), *(str(v) for v in table.values())])
    if when.after:
        return f"until {when.after} (at most {when.within:.0f} s), then {words_of_event}"
    if when.at:
        return f"at {when.at:.0f} s: {words_of_event}"
    return f"{when.plus:.0f} s later: {words_of_event}" if when.plus else words_of_event
