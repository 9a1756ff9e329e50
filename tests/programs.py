"""Programs that tests run as processes of their own."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


def ran(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """A program that ends by itself within a minute, and what it printed. Options of `subprocess.run`."""
    options = {"capture_output": True, "text": True, "timeout": 60} | options
    return subprocess.run([str(word) for word in words], **options)


def python(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """The same of this interpreter with arguments."""
    return ran(sys.executable, *words, **options)


def mapweave(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """The same of a command, as a person runs it."""
    return python("-m", "mapweave", *words, **options)


@contextmanager
def going(*words: object, **options: Any) -> Iterator[subprocess.Popen[Any]]:
    """A program that goes on during a block and is killed at its end. Options of `subprocess.Popen`."""
    with subprocess.Popen([str(word) for word in words], **options) as process:
        try:
            yield process
        finally:
            process.kill()
