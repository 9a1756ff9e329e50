"""One target in a process of its own: guided by coverage where atheris is installed, else by chance alone.

    python -m benchmarks.fuzz.process TARGET FOLDER SECONDS SEED

Good samples are in FOLDER/corpus. Findings go to FOLDER: the input, and beside it what happened.
`counts.json` is kept up to date, so that it is there even if the process dies.
"""

import hashlib
import json
import logging
import shutil
import signal
import sys
import time
import traceback
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.process_usage import peak_mb

try:
    import atheris
except ImportError:
    atheris = None

DECODERS = [
    "mapweave.wire", "mapweave.storage", "mapweave.agent.recordings", "mapweave.agent.ros_messages",
    "mapweave.agent.drivers", "mapweave.agent.replication", "mapweave.mapserver.http",
    "mapweave.mapserver.log",
    "mapweave.hybridmap", "mapweave.identities", "mapweave.formats", "mapweave.sim.worlds.file",
    "mapweave.sim.worlds.design",
]  # fmt: skip
COMPILED = ["mapweave.wire.landmark_reader", "mapweave.wire.rans", "mapweave.hybridmap.jit"]
"""Modules with kernels: numba cannot compile functions that count their branches."""
SLOW = 5.0
"""s for one input; longer is a hang."""


class Fuzzing:
    """Runs inputs and counts."""

    def __init__(self, target: Any, folder: Path) -> None:
        """Take a target and a folder for findings."""
        self._target, self._folder = target, folder
        self._work = folder / "work"
        self.counts = {"inputs": 0, "accepted": 0, "crashes": 0, "hangs": 0, "accepted_invalid": 0}
        self._places: set[str] = set()
        self._written = 0.0
        signal.signal(signal.SIGALRM, self._out_of_time)

    def prepare(self, data: bytes) -> None:
        """Run one input without a limit and without counting what comes of it."""
        self._work.mkdir(exist_ok=True)
        with suppress(Exception):
            self._target.run(data, self._work)
        self._clear()

    def one(self, data: bytes) -> None:
        """Run one input."""
        from benchmarks.fuzz.targets import AcceptedInvalid
        from mapweave.hybridmap.errors import MapweaveError

        self._work.mkdir(exist_ok=True)
        self.counts["inputs"] += 1
        # What the input is if the process dies of it.
        (self._folder / "last").write_bytes(data)
        signal.setitimer(signal.ITIMER_REAL, SLOW)
        try:
            self._target.run(data, self._work)
            self.counts["accepted"] += 1
        except MapweaveError as error:
            if "\n" in str(error):
                self._found("crashes", data, error)
        except TimeoutError as error:
            self._found("hangs", data, error)
        except AcceptedInvalid as error:
            self._found("accepted_invalid", data, error)
        except Exception as error:  # noqa: BLE001 - that is what is looked for
            self._found("crashes", data, error)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        self._clear()
        if time.monotonic() - self._written > 0.2:
            self.write()

    def _clear(self) -> None:
        for path in self._work.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    def write(self) -> None:
        """Keep the counts."""
        self._written = time.monotonic()
        (self._folder / "counts.json").write_text(json.dumps({**self.counts, "peak_rss_mb": peak_mb()}))

    def _found(self, what: str, data: bytes, error: Exception) -> None:
        """Keep a finding; the same place is one finding."""
        steps = traceback.extract_tb(error.__traceback__)
        place = f"{what} {type(error).__name__} {[(s.filename, s.lineno) for s in steps[-3:]]}"
        if place in self._places:
            return
        self._places.add(place)
        self.counts[what] += 1
        name = f"{what}-{hashlib.sha256(place.encode()).hexdigest()[:12]}"
        (self._folder / name).write_bytes(data)
        (self._folder / f"{name}.txt").write_text("".join(traceback.format_exception(error)))
        # libFuzzer ends the process without coming back.
        self.write()

    @staticmethod
    def _out_of_time(*_: object) -> None:
        raise TimeoutError(f"one input took more than {SLOW:g} s")


def mutated(data: bytes, samples: list[bytes], rng: np.random.Generator, most: int) -> bytes:
    """A sample with some bytes changed, taken out, doubled or taken from another."""
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 6))):
        size = len(changed)
        at = int(rng.integers(size + 1))
        what = int(rng.integers(6))
        if what == 0 and size:
            changed[at % size] ^= 1 << int(rng.integers(8))
        elif what == 1 and size:
            changed[at % size] = int(rng.choice([0, 1, 0x7F, 0x80, 0xFE, 0xFF, int(rng.integers(256))]))
        elif what == 2:
            del changed[at : at + int(rng.integers(1, 64))]
        elif what == 3:
            changed[at:at] = changed[at : at + int(rng.integers(1, 64))]
        elif what == 4:
            other = samples[int(rng.integers(len(samples)))]
            begin = int(rng.integers(len(other) + 1))
            changed[at : at + int(rng.integers(64))] = other[begin : begin + int(rng.integers(64))]
        else:
            changed[at:at] = rng.integers(0, 256, int(rng.integers(1, 16)), dtype=np.uint8).tobytes()
    return bytes(changed[:most])


def main() -> None:
    """Fuzz one target."""
    name, folder, seconds, seed = sys.argv[1], Path(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4])
    logging.disable(logging.CRITICAL)
    if atheris is None:
        from benchmarks.fuzz.targets import TARGETS
    else:
        with atheris.instrument_imports(include=DECODERS, exclude=COMPILED):
            from benchmarks.fuzz.targets import TARGETS
    target = TARGETS[name]
    corpus = folder / "corpus"
    samples = [path.read_bytes() for path in sorted(corpus.iterdir())]
    fuzzing = Fuzzing(target, folder)
    # What the first inputs import and compile is no hang on a busy machine.
    for sample in samples:
        fuzzing.prepare(sample)
    for sample in samples:
        fuzzing.one(sample)
    fuzzing.write()
    end = time.monotonic() + seconds
    if atheris is None:
        rng = np.random.default_rng(seed)
        while time.monotonic() < end:
            fuzzing.one(mutated(samples[int(rng.integers(len(samples)))], samples, rng, target.most))
        fuzzing.write()
        return
    options = [
        f"-max_total_time={max(1, round(seconds))}", f"-seed={seed + 1}", f"-max_len={target.most}",
        "-rss_limit_mb=4096", f"-artifact_prefix={folder}/", "-verbosity=0", "-timeout=30", str(corpus),
    ]  # fmt: skip
    atheris.Setup([sys.argv[0], *options], fuzzing.one)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
