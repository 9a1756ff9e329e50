"""What a person who drives sees of the robot."""

from dataclasses import replace

from mapweave.agent.observation import Command
from mapweave.hybridmap.agent_status import AgentStatus, Status
from mapweave.hybridmap.pose import Pose2
from mapweave.teleoperation.display import lines

REPORT = AgentStatus(
    Status("driven by a person", "140 of 150 features left", 3, 40, Pose2(), False), 1, "r0", 1
)
GONE = "/dev/ttyUSB0: there is no such port; is the robot connected and switched on?"


def shown(report: AgentStatus, silence: float = 0.0) -> str:
    return lines("r0", report, Command(0.15, 0.0), silence, "arrows drive")[1]


def test_a_base_that_does_not_answer_is_named():
    """The robot stood, and the display said what it had said before."""
    assert shown(replace(REPORT, last_error=GONE)) == f"{GONE}; {REPORT.status.words}"
    assert shown(REPORT) == REPORT.status.words
    assert shown(replace(REPORT, last_error=GONE), 3.0) == "no answer for 3.0 s: the robot stands"
