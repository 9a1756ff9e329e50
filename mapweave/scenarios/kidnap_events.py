"""Robots that are carried away, and robots that are sent somewhere. Truth sets the stage, no more."""

from collections.abc import Callable, Mapping

from mapweave.hybridmap.agent_status import AgentStatus
from mapweave.hybridmap.errors import NotConnected
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.mission_order import MissionKind
from mapweave.hybridmap.pose import Pose2
from mapweave.scenarios.fleet import SERVER, TrialFleet, TrialStage
from mapweave.scenarios.kidnap_planning import Kidnapping, NothingToShow, choose_goal, plan_kidnapping
from mapweave.scenarios.recording import Lost, RecordedLocalization
from mapweave.storage.map_file import MapFile, unpack_map_file

Note = Callable[[str, bool], None]
"""Takes a line, and whether it reports trouble."""


class KidnapEvents:
    """Keeps the record of robots that were lost.

    Attributes:
        lost: in order.
        sent: by robot, what became of the last goal that it was sent to.
    """

    def __init__(
        self,
        stage: TrialStage,
        fleet: TrialFleet,
        command: Callable[[str, MissionKind, NodeId], None],
        note: Note,
    ) -> None:
        """Start with no robot lost."""
        self._stage = stage
        self._fleet = fleet
        self._command = command
        self._note = note
        self.lost: list[Lost] = []
        self.sent: dict[str, Lost] = {}
        self._plot: Kidnapping | None = None

    def look(self, agents: Mapping[str, AgentStatus]) -> None:
        """Note who knows by now where it is, and who has arrived."""
        for lost in self.lost:
            report = agents.get(lost.robot)
            if report is None or report.stamp_ns <= lost.stamp_ns:
                continue
            status = report.status
            if lost.fix is None and status.fix_node is not None and status.mission == "goto":
                lost.fix = RecordedLocalization(report.stamp_ns, status.fix_node, status.node_from_robot)
            if lost.arrived_ns is None and status.mission == "goto":
                lost.legs = max(lost.legs, status.legs)
                if status.finished and lost is self.sent.get(lost.robot):
                    lost.arrived_ns = report.stamp_ns

    def merged(self) -> MapFile:
        """The server's merged map, with everything in it that has come.

        Raises:
            NotConnected: it does not hand it out.
        """
        replies = self._fleet.bus.ask(self._fleet.keys.server_map(SERVER), b"", 120.0)
        for reply in replies:
            if not reply.error:
                return unpack_map_file(reply.payload)
        why = replies[0].error if replies else "no answer"
        raise NotConnected(f"the map server did not hand out the merged map: {why}")

    def abduct(self, robot: str) -> str:
        """Put a robot, or one that the seed chooses, into a room that only one other has mapped.

        Returns:
            Why that cannot be done now; empty if it is done.
        """
        merged = self.merged()
        status = self._fleet.control.status()
        try:
            self._plot = plot = plan_kidnapping(
                HybridMap(merged.changes),
                {node: component for node, (component, _) in merged.poses.items()},
                self._truth_of(HybridMap(merged.changes)),
                self._fleet.control.plan(),
                (robot,) if robot else self._stage.robots,
                {name: robot_status.world_from_robot for name, robot_status in status.robots.items()},
                self._stage.seed,
            )
        except NothingToShow as reason:
            self._plot = None
            return str(reason)
        self._fleet.control.kidnap(plot.robot, plot.world_from_robot)
        self._note(f"{plot.robot} is put down in {plot.room}, which only {plot.host} has mapped", False)
        self.mark(plot.robot)
        return ""

    def mark(self, robot: str) -> None:
        """A robot was carried to where it is now."""
        status = self._fleet.control.status()
        pose = status.robots[robot].world_from_robot
        room = self._fleet.control.plan().room_at(pose.x, pose.y) or "nowhere"
        self.lost.append(Lost(robot, room, status.stamp_ns, pose))

    def send(self, robot: str, goal: str) -> None:
        """Send a robot, or the last lost one, to a goal; see `actions.Send`."""
        lost = next((record for record in reversed(self.lost) if robot in ("", record.robot)), None)
        if lost is None and not robot:
            self._note("no robot is sent: none was lost", True)
            return
        if lost is None or lost.goal is not None:
            # It was not kidnapped, or has been sent since: it is sent from where it is now.
            self.mark(robot if lost is None else lost.robot)
            lost = self.lost[-1]
        try:
            node = self._goal(lost, goal)
        except NothingToShow as reason:
            self._note(f"{lost.robot} is not sent: {reason}", True)
            return
        lost.goal, self.sent[lost.robot] = node, lost
        self._command(lost.robot, MissionKind.GO, node)
        self._note(f"{lost.robot} shall go to {node}", False)

    def _goal(self, lost: Lost, goal: str) -> NodeId:
        if goal not in ("foreign", "own"):
            return NodeId.parse(goal)
        if goal == "foreign" and self._plot is not None and self._plot.robot == lost.robot:
            return self._plot.goal
        merged = self.merged()
        whole = HybridMap(merged.changes)
        components = {node: component for node, (component, _) in merged.poses.items()}
        return choose_goal(
            whole, components, self._truth_of(whole), lost.robot, lost.world_from_robot,
            goal == "foreign", self._stage.seed,
        )  # fmt: skip

    def _truth_of(self, whole: HybridMap) -> dict[NodeId, Pose2]:
        robots = self._stage.robots
        return self._fleet.control.truth_of(n for n in whole.nodes.values() if n.id.agent in robots)
