"""Progress of a demo on the terminal."""

from __future__ import annotations

from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from mapweave.demo.report import Report
from mapweave.demo.watch import Watch


class Show:
    """A bar for the demo, a line for each robot and one for the server."""

    def __init__(self, robots: tuple[str, ...], quiet: bool) -> None:
        """Prepare; with `quiet` nothing is shown but errors."""
        self._console = Console(stderr=True, quiet=quiet)
        self._progress = Progress(
            TextColumn("{task.description:>8}"), BarColumn(bar_width=24), TimeElapsedColumn(),
            TextColumn("{task.fields[doing]}"), console=self._console, transient=False,
        )  # fmt: skip
        self._whole = self._progress.add_task("demo", total=1.0, doing="starting")
        self._server = self._progress.add_task("server", total=None, doing="starting")
        self._robots: dict[str, TaskID] = {
            name: self._progress.add_task(name, total=None, doing="starting") for name in robots
        }

    def __enter__(self) -> Show:
        """Begin to show."""
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the last state on the terminal."""
        self._progress.stop()

    def say(self, what: str) -> None:
        """One line that stays."""
        self._console.print(what)

    def update(self, share: float, stage: str, watch: Watch) -> None:
        """Show how far the demo is and what everybody is doing."""
        self._progress.update(self._whole, completed=share, doing=stage)
        self._progress.update(self._server, doing=watch.server.summary)
        for name, report in watch.agents().items():
            status = report.status
            detail = f", {status.detail}" if status.detail else ""
            if name in self._robots:
                doing = f"{status.nodes:3d} nodes  {status.doing}{detail}"
                self._progress.update(self._robots[name], doing=doing[:110])


def summary_table(report: Report) -> Table:
    """The figures of a demo for people."""
    table = Table(title="Three maps, one map, one lost robot found", show_header=False)
    table.add_column(justify="right", style="bold")
    table.add_column()
    for name, text in report.lines():
        table.add_row(name, text)
    return table
