"""Progress of a trial where there is no terminal."""

from types import SimpleNamespace
from typing import Any, cast

from mapweave.scenarios.terminal_progress import TerminalProgress


def test_lines_say_how_far_the_robots_are(capfd):
    """The lines of a demo in a file were all alike but for the time."""
    runner: Any = SimpleNamespace(moments=[], now=13.0, doing="until joined, then go", done=1, agents={})
    with TerminalProgress("demo", ("r0", "r1"), 3, quiet=False) as show:
        show.look(cast(Any, runner))
        runner.agents = {
            name: SimpleNamespace(status=SimpleNamespace(nodes=nodes, doing="driving", detail=""))
            for name, nodes in (("r1", 12), ("r0", 9))
        }
        show._said_at = 0.0
        show.look(cast(Any, runner))
    lines = capfd.readouterr().err.splitlines()
    assert [line.strip() for line in lines] == [
        "13.0 s  until joined, then go",
        "13.0 s  until joined, then go; nodes: r0 9, r1 12",
    ]
