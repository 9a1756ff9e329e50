"""For all tests: one thread for algebra and images, as in Mapweave's own processes; and bytecode is kept."""

import ctypes
import gc
import os
import signal
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from typing import Any

# numpy reads it when it is imported, and cv2 imports numpy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# FAISS searches with all cores otherwise, which costs more than it gains where each core has a worker.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# `mapweave` says so before it imports cv2, and here cv2 is imported first.
os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

import cv2
import pytest
from hypothesis import settings

from mapweave.wire.memory import MemoryHub
from tests.simulator import INSTALLED, SkipWithoutSimulator

# Assertions of these modules are rewritten, as in tests.
pytest.register_assert_rewrite(
    "tests.waiting", "tests.postgres", "tests.mapweave.command_line", "tests.sim.measured_world"
)

# The duration of an example means nothing on a busy machine. Other examples are drawn in each run.
settings.register_profile("patient", deadline=None, max_examples=50)
settings.load_profile("patient")
cv2.setNumThreads(1)

# Each worker compiles the tests, and each of a hundred processes that they start the product. Where bytecode
# files are forbidden, as in images of containers, that is a good part of the time that all tests take.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

pytest_plugins = ["tests.postgres"]

# A shell starts what runs in the background with interrupts ignored, and what that starts inherits it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# glibc gives free memory back to the kernel, which clears it each time before it gives it again: where images
# are tracked that was a twentieth of the time. Arrays of 32 MB or more are given back at once nevertheless.
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
if mallopt := getattr(ctypes.CDLL(None), "mallopt", None):
    mallopt(M_TRIM_THRESHOLD, 256 << 20)
    mallopt(M_MMAP_THRESHOLD, 32 << 20)

# All that is imported and collected stays: to look for what does not takes each process a second, and again
# whenever all is looked through later.
gc.disable()


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()
    # All that was made since is looked through far less often: that was 3 % of the time of all tests.
    gc.set_threshold(5000, 10, 50)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say what was not tested: one line for each reason, such as a machine without a browser."""
    skipped = terminalreporter.stats.get("skipped", [])
    # Of a skipped test there are a file, a line and the reason.
    reasons = Counter(str(report.longrepr[-1]).removeprefix("Skipped: ") for report in skipped)
    for reason, count in reasons.most_common():
        terminalreporter.write_line(f"skipped {count}: {reason}", yellow=True)


if not INSTALLED:
    sys.meta_path.insert(0, SkipWithoutSimulator())


@pytest.fixture
def opened() -> Iterator[Callable[[Any], Any]]:
    """Gives back what it gets, and closes it at the end of the test; what was opened last is closed first."""
    with ExitStack() as stack:
        yield lambda thing: stack.enter_context(closing(thing))


@pytest.fixture
def hub() -> Iterator[MemoryHub]:
    """A network in memory; buses that a test opens and leaves open are closed at its end."""
    hub = MemoryHub()
    yield hub
    for bus in [*hub._buses]:
        bus.close()
