"""Lines and progress for people: bars on a terminal, plain lines where stderr goes to a file or a pipe.

Rich takes a file for a terminal of 80 columns, wraps lines there, and reads `[words]` as markup.
"""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from datetime import datetime
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeVar

from mapweave.json_log import JsonFormatter, escaped, json_line, one_line

if TYPE_CHECKING:
    # A server prints lines alone.
    from rich.console import Console
    from rich.progress import Progress, TaskID

PLAIN_WIDTH = 10_000
"""Characters of a line that is not on a terminal: none is wrapped."""
EVERY = 10.0
"""Between two lines of progress where there is no terminal, s."""
STAMP = "%Y-%m-%d %H:%M:%S"
"""Of a line of a log: local time, as systemd's own."""

_T = TypeVar("_T")


def plain_or_terminal(stderr: bool = True, quiet: bool = False) -> Console:
    """A console that wraps nothing where there is no terminal.

    It reads no markup: names in files and words of robots are printed, which may look like it.
    """
    from rich.console import Console

    stream = sys.stderr if stderr else sys.stdout
    width = None if stream.isatty() else PLAIN_WIDTH
    return Console(file=stream, quiet=quiet, width=width, markup=False)


def log_with_time(log_format: str = "text", **fields: str) -> None:
    """Let warnings of any part be lines of the log, with the time like all others.

    Args:
        log_format: `text`, or `json` for one object a line, see `mapweave.json_log`.
        fields: that every object has.
    """
    handler = logging.StreamHandler()
    handler.setFormatter(TextFormatter() if log_format == "text" else JsonFormatter(**fields))
    logging.basicConfig(handlers=[handler])


class TextFormatter(logging.Formatter):
    """Time and message in one line, whatever is in it; then the exception, if there is one."""

    def __init__(self) -> None:
        """Nothing to set."""
        super().__init__("%(asctime)s %(message)s", STAMP)

    def formatMessage(self, record: logging.LogRecord) -> str:
        """The line."""
        record.message = one_line(record.message)
        return super().formatMessage(record)

    def formatException(self, ei: Any) -> str:
        """The lines of an exception, which may have words of others."""
        return "\n".join(map(escaped, super().formatException(ei).split("\n")))


def stamped(line: str) -> str:
    """An event as a line of a log, with the time."""
    if (as_json := json_line(line)) is not None:
        return as_json
    return f"{datetime.now().strftime(STAMP)} {one_line(line)}"


class EventLog:
    """Prints events on stderr: one line each, with the time."""

    def __init__(self, console: Console | None = None) -> None:
        """Take where to print."""
        self._console = console or plain_or_terminal()

    def __call__(self, line: str) -> None:
        """Print an event."""
        self._console.print(stamped(line), markup=False, highlight=False, soft_wrap=True)


class Bar:
    """Progress of long work. A context manager."""

    def __init__(
        self,
        console: Console,
        words: str,
        total: float | None,
        transient: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Prepare.

        Args:
            console: where.
            words: what is done.
            total: steps, if that is known.
            transient: whether a bar vanishes at the end.
            clock: only grows, s.
        """
        self._console, self._words, self._total, self._clock = console, words, total, clock
        self._done, self._said_at, self._said = 0.0, clock(), ""
        self._begun, self._over, self._saying = clock(), threading.Event(), threading.Lock()
        self._waiting = threading.Thread(target=self._say_that_it_goes_on, name="progress", daemon=True)
        self._bar: tuple[Progress, TaskID] | None = None
        self._detail = ""
        if console.is_terminal:
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
            from rich.table import Column

            # Of a line that is too long the detail is cut, not the numbers.
            whole, rest = Column(no_wrap=True), Column(no_wrap=True, overflow="ellipsis", ratio=1)
            columns = (
                TextColumn("{task.description}", markup=False, table_column=whole),
                BarColumn(20, table_column=whole),
                MofNCompleteColumn(table_column=whole), TimeElapsedColumn(table_column=whole),
                TextColumn("{task.fields[detail]}", markup=False, table_column=rest),
            )  # fmt: skip
            bar = Progress(*columns, console=console, transient=transient, expand=True)
            self._bar = bar, bar.add_task(words, total=total, detail="")

    def __enter__(self) -> Bar:
        """Begin to show."""
        if self._bar is not None:
            self._bar[0].start()
        else:
            self._waiting.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Show the last state. What was quick, has failed or has no steps ends without a plain line."""
        if self._bar is not None:
            self._bar[0].stop()
            return
        self._over.set()
        self._waiting.join()
        if self._said and error is None and (self._done or self._total is not None):
            self._say()

    def advance(self, steps: float = 1, detail: str = "") -> None:
        """Some steps are done."""
        self.update(self._done + steps, detail)

    def update(self, done: float, detail: str = "", total: float | None = None) -> None:
        """So many steps are done.

        Args:
            done: of all.
            detail: in words.
            total: where it is known only now.
        """
        self._done, self._detail = done, detail
        self._total = self._total if total is None else total
        if self._bar is not None:
            bar, task = self._bar
            bar.update(task, completed=done, total=self._total, detail=detail)
        elif self._clock() - self._said_at >= EVERY:
            self._say()

    def _say_that_it_goes_on(self) -> None:
        """A step may take minutes, such as the joining of maps."""
        while not self._over.wait(EVERY / 10):
            if self._clock() - self._said_at >= EVERY:
                self._say(f", {self._clock() - self._begun:.0f} s")

    def _say(self, since: str = "") -> None:
        with self._saying:
            of = "" if self._total is None else f" of {self._total:g}"
            # Of what has no steps nothing is counted.
            count = f": {self._done:g}{of}" if self._done or of else ""
            line = f"{self._words}{count}{', ' * bool(self._detail)}{self._detail}{since}"
            if line != self._said:
                self._console.print(line, markup=False, highlight=False, soft_wrap=True)
            self._said, self._said_at = line, self._clock()


def working(words: str) -> Bar:
    """Show that work goes on of which no steps are known yet."""
    return Bar(plain_or_terminal(), words, None, transient=True)


def tracked(
    items: Iterable[_T], words: str, total: int | None = None, console: Console | None = None
) -> Iterator[_T]:
    """Show the progress of a loop."""
    known = len(items) if total is None and isinstance(items, Sized) else total
    with Bar(console or plain_or_terminal(), words, known, transient=True) as bar:
        for item in items:
            yield item
            bar.advance()
