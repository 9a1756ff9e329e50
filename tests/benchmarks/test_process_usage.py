"""Processor time of a process whose threads end, by its own clock; memory that is taken and given back."""

import os
import subprocess
import sys

import numpy as np
import pytest

from benchmarks.process_usage import Usage, held_bytes, peak_mb, resident_mb, total

BURN = """
import ctypes, sys, threading, time

def burn(name, seconds):
    ctypes.CDLL(None).prctl(15, name.encode(), 0, 0, 0)  # PR_SET_NAME
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        pass
    print("burnt", flush=True)
    sys.stdin.readline()

for name, seconds in (("rx-0", 0.4), ("python", 0.2)):
    thread = threading.Thread(target=burn, args=(name, seconds))
    thread.start()
    thread.join()
print("ended", flush=True)
sys.stdin.readline()
"""


@pytest.mark.slow
def test_threads_that_have_ended_still_count_where_they_belong():
    with subprocess.Popen(
        [sys.executable, "-c", BURN], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin is not None and process.stdout is not None
        usage = Usage(process.pid)
        own, zenoh = usage.take()
        for _ in range(2):
            assert process.stdout.readline() == "burnt\n"
            usage.take()
            print(file=process.stdin, flush=True)
        assert process.stdout.readline() == "ended\n"
        own_after, zenoh_after = usage.take()
        assert zenoh == 0.0 and zenoh_after == pytest.approx(0.4, abs=0.05)
        assert 0.15 < own_after - own < 0.6, "with what Python itself takes to start"
        assert total([process.pid]) == pytest.approx(own_after + zenoh_after, abs=0.03)
        print(file=process.stdin, flush=True)


def test_memory_is_counted_in_millions_of_bytes():
    before, resident = held_bytes(), resident_mb(os.getpid())
    block = np.ones(100_000_000, np.uint8)
    assert held_bytes() - before == pytest.approx(1e8, rel=0.05)
    assert resident_mb() - resident == pytest.approx(100.0, rel=0.1)
    assert peak_mb() >= resident_mb() - 1.0
    del block
    assert held_bytes() - before < 2e7
    assert peak_mb() > resident_mb() + 80.0
