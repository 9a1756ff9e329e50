"""Output to a terminal that goes away: what is written then is lost, and is no error.

A process learns that its terminal is gone by a signal, which a thread that prints may be ahead of, and which
does not come to a job that its shell has disowned or that ignores it: such a job goes on.
"""

import errno
import io
import logging
import sys
from typing import Any


class _Terminal(io.FileIO):
    """The file of a terminal."""

    def write(self, data: Any) -> int:
        """Write bytes; as if they were written where no terminal is any more."""
        try:
            return super().write(data)
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            return memoryview(data).nbytes


def outlast_terminal() -> None:
    """Drop output of this process and its log from now on if their terminal is gone."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None or not stream.isatty():
            continue
        file = io.BufferedWriter(_Terminal(stream.fileno(), "w", closefd=False))
        outlasting = io.TextIOWrapper(file, stream.encoding, stream.errors, line_buffering=True)
        setattr(sys, name, outlasting)
        for handler in logging.getLogger().handlers:
            if isinstance(handler, logging.StreamHandler) and handler.stream is stream:
                handler.setStream(outlasting)
