"""What an agent says while it runs."""

import io

from rich.console import Console

from mapweave import Command, Observation, Odometry, Pose2
from mapweave.agent.pipeline import TickResult
from mapweave.hybridmap.agent_status import Status
from mapweave.processes.agent_progress import A_SECOND, BURST, AgentProgress


def test_a_robot_that_changes_its_mind_each_tick_does_not_fill_the_log():
    """A camera that flickers gave ten lines a second."""
    output, now = io.StringIO(), 0.0
    show = AgentProgress(Console(file=output, width=200), "r0", None, lambda: now)

    def tick(doing: str) -> None:
        status = Status(doing, "", 0, 0, Pose2(), False)
        show(Observation(0, Odometry(0.0, 0.0)), TickResult(Command(), (), (), status))

    for k in range(600):
        now = 0.1 * k
        tick("mapping" if k % 2 else "standing still")
    lines = output.getvalue().splitlines()
    assert BURST + 50 * A_SECOND < len(lines) < BURST + 70 * A_SECOND
    assert any("changes before are left out)" in line for line in lines)
    tick("lost")
    for _ in range(20):
        now += 0.1
        tick("lost")
    assert "r0: lost (0 nodes)" in output.getvalue().splitlines()[-1], "what it does in the end is said"


def test_one_node_is_no_nodes():
    output = io.StringIO()
    show = AgentProgress(Console(file=output, width=200), "r0", None, lambda: 0.0)
    status = Status("mapping", "", 1, 0, Pose2(), False)
    show(Observation(0, Odometry(0.0, 0.0)), TickResult(Command(), (), (), status))
    assert "r0: mapping (1 node)" in output.getvalue()
