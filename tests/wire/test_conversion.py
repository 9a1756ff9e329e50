"""Conversion of plain data in several threads at once."""

import subprocess
import sys

import msgspec
import pytest

from mapweave.wire.conversion import convert, json_value

THREADS = """
import sys, threading
import msgspec
from mapweave.wire.conversion import convert, json_value

sys.setswitchinterval(1e-6)
for _ in range(300):
    kind = int
    for k in range(5):
        kind = msgspec.defstruct(f"S{k}", [("inner", kind), ("other", int, 0)])
    plain = json = None
    for _ in range(5):
        plain, json = ({"inner": plain}, f'{{"inner": {json}}}') if plain else ({"inner": 1}, '{"inner": 1}')
    together = threading.Barrier(8)
    wrong = []

    def first(k, kind=kind, plain=plain, json=json.encode()):
        together.wait()
        value = convert(plain, kind) if k % 2 else json_value(json, kind)
        if msgspec.to_builtins(value.inner.inner.inner.inner.inner) != 1:
            wrong.append(k)

    threads = [threading.Thread(target=first, args=(k,)) for k in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
print("done")
"""
"""Structs in structs, each round new ones, which eight threads use for the first time at once."""


def test_threads_that_use_a_type_for_the_first_time_do_not_crash():
    # In a process of its own, since it ended with a segmentation fault.
    run = subprocess.run([sys.executable, "-c", THREADS], capture_output=True, text=True, timeout=100)
    assert (run.returncode, run.stdout.strip()) == (0, "done"), run.stderr


def test_what_does_not_fit_is_refused_each_time():
    for _ in range(2):
        with pytest.raises(msgspec.ValidationError):
            convert("one", int)
        with pytest.raises(msgspec.DecodeError):
            json_value(b'"one"', int)


def test_other_types_are_read_by_the_given_function():
    assert convert(["1", b"2"], tuple[complex, bytes], lambda kind, plain: kind(plain)) == (1 + 0j, b"2")
