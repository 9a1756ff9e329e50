"""What Zenoh logs, as records of this process: nothing is lost, and a failure of it stops nothing."""

import os
import subprocess
import sys

import pytest

from mapweave.wire.zenoh_log import EVERY, Refusals, meaning

PROGRAM = """
import logging, os, sys
from mapweave.wire import zenoh_log
logging.basicConfig(format="%(levelname)s %(name)s %(message)s")
{before}
with zenoh_log.ZenohLog():
    print("from Python")
    os.write(1, {written!r})
    {amid}
print("after it", flush=True)
os.write(1, b"from others\\n")
"""


def run(
    written: bytes, before: str = "", amid: str = "", how: tuple[str, ...] = ()
) -> tuple[list[str], list[str]]:
    """Lines of stdout and stderr of a process in which `written` comes as from Zenoh."""
    program = PROGRAM.format(before=before, written=written, amid=amid)
    words = [sys.executable, *how, "-c", program]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    done = subprocess.run(words, capture_output=True, timeout=60, check=True, env=environment)
    return done.stdout.decode().splitlines(), done.stderr.decode().splitlines()


def zenoh(words: str, level: str = "WARN") -> bytes:
    return f"2026-11-29T02:08:21.977038Z {level:>5} acc-0 ThreadId(04) {words}\n".encode()


@pytest.mark.parametrize("how", [(), ("-u",)])
def test_what_zenoh_says_otherwise_is_logged_as_it_says_it(how: tuple[str, ...]):
    written = zenoh("zenoh_transport::unicast: no room\nfor more") + zenoh("zenoh_link_tls: closed", "DEBUG")
    written += b"of another library\n" + zenoh("zenoh::net: failed", "ERROR") + b"without an end"
    output, log = run(written, how=how)
    assert output == ["from Python", "after it", "from others"]
    assert log == [
        "WARNING zenoh Zenoh: zenoh_transport::unicast: no room",
        "WARNING zenoh for more",
        "DEBUG zenoh Zenoh: zenoh_link_tls: closed",
        "WARNING zenoh of another library",
        "ERROR zenoh Zenoh: zenoh::net: failed",
        "WARNING zenoh without an end",
    ]


def test_one_reason_is_logged_once_a_minute_and_counted(caplog):
    now = 0.0
    refusals = Refusals(lambda: now)
    assert refusals.wait() is None
    for _ in range(5):
        refusals.add("a")
    refusals.add("b")
    refusals.flush()
    now = EVERY - 1.0
    refusals.flush()
    assert refusals.wait() == 1.0
    now = EVERY + 2.0
    refusals.flush()
    refusals.add("a")
    refusals.add("b")
    refusals.flush(end=True)
    assert [record.getMessage() for record in caplog.records] == [
        "refused a client: a",
        "refused a client: b",
        "refused a client: a (4 more within 62 s)",
        "refused a client: b",
        "refused a client: a (1 more within 0 s)",
    ]


def test_a_refusal_in_unknown_words_keeps_them():
    assert meaning("received fatal alert: BadCertificate") == (
        "it does not accept this router's certificate (BadCertificate)"
    )
    assert meaning("strange things (os error 5)") == "its handshake failed (strange things (os error 5))"


def test_a_failure_of_the_reader_leaves_output_as_it_was_and_stops_nothing():
    """A pipe that is not read takes 64 kB, and then a writer waits for ever."""
    broken = "zenoh_log.ZenohLog._take = lambda self, line: 1 / 0"
    more = 'import time; time.sleep(0.5); os.write(1, b"x" * 200_000 + b"\\n")'
    output, log = run(zenoh("zenoh_transport: first"), broken, more)
    assert output == ["x" * 200_000, "from Python", "after it", "from others"]
    assert "cannot be taken any more" in log[0] and log[-1] == "ZeroDivisionError: division by zero"
