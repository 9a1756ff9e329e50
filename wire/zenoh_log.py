"""What Zenoh itself logs, as records of this process's own log.

Zenoh's binding writes lines to standard output and knows no other way. So while the log is taken, file
descriptor 1 is a pipe that a thread reads, and Python's own `sys.stdout` writes to where it led before.
"""

from __future__ import annotations

import io
import logging
import os
import re
import select
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import TextIO

import zenoh

log = logging.getLogger(__name__)

REFUSALS = "off,zenoh_link_tls=warn,zenoh_transport=warn"
"""What is logged unless RUST_LOG in the environment chooses otherwise: why handshakes are refused."""
LINE = re.compile(r"\S+Z +(TRACE|DEBUG|INFO|WARN|ERROR) (?:.*?ThreadId\(\d+\) )?(.*)")
"""Time, level, name and number of the thread, part of Zenoh, message."""
LEVELS = {"INFO": logging.INFO, "WARN": logging.WARNING, "ERROR": logging.ERROR}
"""Of the records; what is below is DEBUG."""
HANDSHAKE = re.compile(r"zenoh_link_tls::unicast: (.*)\. Hint: increase the system open file limit\.")
"""How Zenoh reports every connection that it does not accept, whatever the cause."""
REASONS = (
    ("peer sent no certificates", "it has no certificate of this fleet"),
    (
        "received fatal alert: UnknownCA",
        "it does not know this fleet's authority: it has no key of this fleet",
    ),
    ("received fatal alert: DecryptError", "it trusts another authority: its key is of another fleet"),
    ("received fatal alert: CertificateExpired", "it says that this router's own certificate has expired"),
    ("received fatal alert: ", "it does not accept this router's certificate"),
    ("invalid peer certificate: certificate expired", "its certificate has expired"),
    ("invalid peer certificate: certificate not valid yet", "its certificate is not valid yet: check clocks"),
    ("invalid peer certificate: BadSignature", "its certificate is of another authority"),
    ("invalid peer certificate: UnknownIssuer", "its certificate is of another authority"),
    ("received corrupt message of type InvalidContentType", "it speaks plain TCP, not TLS"),
    ("peer is incompatible: ", "its TLS is too old, or otherwise not that of a fleet"),
    ("tls handshake eof", "it hung up amid the handshake"),
    ("Timeout during TLS handshake", "it did not finish the handshake in time"),
    ("Too many open files", "this process may open no more files; see `ulimit -n`"),
)
"""How Zenoh's words begin, and what they mean. What is not here is shown in Zenoh's words."""
EVERY = 60.0
"""s within which one reason is logged once: a client tries again each second, for ever."""
AMID = 4096
"""Bytes without an end of line that are passed on as they are; a line of Zenoh has a few hundred."""


class Refusals:
    """Handshakes that were refused: the first of each reason at once, the others counted."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Take a clock that only grows, s."""
        self._clock = clock
        self._since: dict[str, tuple[float, int]] = {}

    def add(self, reason: str) -> None:
        """One was refused."""
        since, more = self._since.get(reason, (0.0, -1))
        if more < 0:
            since = self._clock()
            log.warning("refused a client: %s", reason, extra={"reason": reason})
        self._since[reason] = since, more + 1

    def flush(self, end: bool = False) -> None:
        """Log the counts of reasons whose time is over, or of all at the end."""
        now = self._clock()
        for reason, (since, more) in list(self._since.items()):
            if not end and now - since < EVERY:
                continue
            if more:
                log.warning(
                    "refused a client: %s (%d more within %.0f s)", reason, more, now - since,
                    extra={"reason": reason, "more": more},
                )  # fmt: skip
                self._since[reason] = now, 0
            else:
                del self._since[reason]

    def wait(self) -> float | None:
        """How long there is nothing to flush, s; None: until the next is refused."""
        if not self._since:
            return None
        return max(0.0, min(since for since, _ in self._since.values()) + EVERY - self._clock())


def meaning(words: str) -> str:
    """What Zenoh's words about a refused handshake mean."""
    for begin, reason in REASONS:
        if words.startswith(begin):
            return reason + (f" ({words.removeprefix(begin)})" if begin.endswith(": ") else "")
    return f"its handshake failed ({words})"


class ZenohLog:
    """Takes what Zenoh logs, from its entry until its exit. A context manager.

    If its thread fails, it says so, and Zenoh writes to standard output by itself again.
    """

    def __init__(self) -> None:
        self._own = logging.getLogger("zenoh")
        # Zenoh's own filter has chosen already.
        self._own.setLevel(logging.DEBUG)
        self._refusals = Refusals()
        self._stdout, self._pipe = -1, -1
        self._python_stdout = sys.stdout
        self._reader = threading.Thread(target=self._read, name="zenoh-log", daemon=True)

    def __enter__(self) -> ZenohLog:
        """Take it from now on."""
        self._python_stdout = sys.stdout
        self._stdout = os.dup(1)
        own = _copy(sys.stdout, self._stdout)
        self._pipe, write = os.pipe()
        os.dup2(write, 1)
        os.close(write)
        sys.stdout = own
        self._reader.start()
        # Zenoh asks for it once; in a log colours are noise.
        before = os.environ.get("NO_COLOR")
        os.environ["NO_COLOR"] = "1"
        try:
            zenoh.init_log_from_env_or(REFUSALS)
        finally:
            if before is None:
                os.environ.pop("NO_COLOR", None)
            else:
                os.environ["NO_COLOR"] = before
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Let Zenoh write to standard output; what it has written is logged first."""
        with suppress(OSError, ValueError):
            sys.stdout.flush()
        sys.stdout = self._python_stdout
        os.dup2(self._stdout, 1)
        # A process that was started meanwhile may hold the pipe open. The copy of descriptor 1 stays open for
        # those that hold the stream.
        self._reader.join(1.0)

    def _read(self) -> None:
        try:
            self._read_lines()
        except Exception:
            # Writers would wait for a pipe that is not read.
            os.dup2(self._stdout, 1)
            log.exception("what Zenoh logs cannot be taken any more and goes to standard output as it is")
        finally:
            os.close(self._pipe)

    def _read_lines(self) -> None:
        ready, rest = select.poll(), b""
        ready.register(self._pipe, select.POLLIN)
        while True:
            wait = self._refusals.wait()
            if ready.poll(None if wait is None else 1e3 * wait + 1.0):
                data = os.read(self._pipe, 65536)
                *lines, rest = (rest + data).split(b"\n")
                if not data or len(rest) > AMID:
                    lines, rest = [*lines, rest], b""
                for line in filter(None, lines):
                    self._take(line.decode(errors="replace"))
                if not data:
                    self._refusals.flush(end=True)
                    return
            self._refusals.flush()

    def _take(self, line: str) -> None:
        found = LINE.fullmatch(line)
        if found is None:
            # The further lines of a message, or what another library has written.
            self._own.warning("%s", line)
            return
        level, words = found.groups()
        refused = HANDSHAKE.fullmatch(words)
        if refused is None:
            self._own.log(LEVELS.get(level, logging.DEBUG), "Zenoh: %s", words)
        else:
            self._refusals.add(meaning(refused[1]))


def _copy(stream: TextIO, descriptor: int) -> TextIO:
    """The same stream on another descriptor; the stream itself if it is not on descriptor 1."""
    buffer = getattr(stream, "buffer", None)
    # With `python -u` there is no buffer.
    raw = getattr(buffer, "raw", buffer)
    if not isinstance(stream, io.TextIOWrapper) or not isinstance(raw, io.FileIO) or raw.fileno() != 1:
        return stream
    stream.flush()
    copy = type(raw)(descriptor, "w", closefd=False)
    file = copy if raw is buffer else io.BufferedWriter(copy)
    return io.TextIOWrapper(
        file,
        stream.encoding,
        stream.errors,
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )
