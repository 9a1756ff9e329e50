"""What a person who drives sees: the robot's state in a few lines that are written over."""

import math
import shutil
import sys
import textwrap

from mapweave.agent.observation import Command
from mapweave.hybridmap.agent_status import AgentStatus


def lines(name: str, report: AgentStatus, command: Command, silence: float, usage: str) -> list[str]:
    """The state in lines.

    Args:
        name: of the agent.
        report: its last status.
        command: what the person wants.
        silence: s since that status, if that is worth saying; else 0.
        usage: which keys there are.
    """
    status, pose = report.status, report.status.map_from_robot
    where = f"x {pose.x:z.2f} m  y {pose.y:z.2f} m  heading {math.degrees(pose.heading):z.0f} deg"
    if status.relocalizing:
        where = "not localized on its map"
    elif not status.nodes:
        where = f"no map yet  {where}"
    doing = "; ".join(words for words in (report.last_error, status.words) if words)
    if silence:
        doing = f"no answer for {silence:.1f} s: the robot stands"
    return [
        f"{name}  map {name}.{report.epoch}  {status.nodes} nodes  {status.mission}  {where}",
        doing,
        f"forward {command.forward:+.2f} m/s  turn {command.turn:+.2f} rad/s",
        usage,
    ]


class Display:
    """Writes lines over those before, on a terminal; elsewhere a line where it changes."""

    def __init__(self) -> None:
        """Nothing is shown yet."""
        self._shown = 0
        self._last = ""
        self._terminal = sys.stdout.isatty()

    def show(self, texts: list[str]) -> None:
        """Show lines, wrapped to the width of the terminal."""
        if not self._terminal:
            if texts[1] != self._last:
                self._last = texts[1]
                print(texts[0], texts[1], sep="  ", flush=True)
            return
        width = max(shutil.get_terminal_size().columns - 1, 20)
        wrapped = [line for text in texts for line in textwrap.wrap(text, width) or [""]]
        up = f"\x1b[{self._shown}A" if self._shown else ""
        sys.stdout.write(f"{up}\r\x1b[J" + "".join(f"{line}\n" for line in wrapped))
        sys.stdout.flush()
        self._shown = len(wrapped)
