"""Hostile input to every decoder: messages, maps, stores, recordings, images, settings, keys, HTTP.

    python -m benchmarks.fuzz [--seconds S] [--seed N] [--targets NAME ...] [--keep DIR] [--json]

Each target runs in a process of its own, two at a time, for an even share of the time, from good samples that
are mutated: guided by coverage where atheris is installed (Linux on x86-64), else by chance alone. A crash is
any exception but a refusal in one line, or the end of the process; a hang is one input that takes more than
5 s; accepted but invalid is a value that is not finite, or that is another one when it is encoded again. Each
place in the code counts once.
"""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from benchmarks.command_line import command_line

SUMS = ("inputs", "accepted", "crashes", "hangs", "accepted_invalid")
AT_ONCE = 2
START, GRACE = 120.0, 60.0
"""s in which a process must be ready, and beyond its time in which it must end."""


def fuzz_one(name: str, folder: Path, seconds: float, seed: int) -> dict[str, Any]:
    """Fuzz one target in a process.

    Returns:
        Its counts.
    """
    command = [sys.executable, "-m", "benchmarks.fuzz.process", name, str(folder), str(seconds), str(seed)]
    counts, said = folder / "counts.json", folder / "said"
    # LibFuzzer ends its process at once: nothing is removed there.
    scratch = folder / "temporary"
    scratch.mkdir()
    with said.open("wb") as output:
        surroundings = {**os.environ, "TMPDIR": str(scratch)}
        process = subprocess.Popen(command, stdout=output, stderr=output, env=surroundings)
        # What it imports and compiles takes a minute on a busy machine, and is no input.
        hung = not (_within(START, process, counts.exists) and _within(seconds + GRACE, process))
        process.kill()
        status = process.wait()
    shutil.rmtree(scratch, ignore_errors=True)
    words = said.read_text(errors="replace")
    row: dict[str, Any] = json.loads(counts.read_text()) if counts.exists() else dict.fromkeys(SUMS, 0)
    row.setdefault("peak_rss_mb", 0.0)
    if hung or status:
        # The process itself has died, or no time limit could stop it: what it last read is in `last`.
        row["hangs" if hung or "libFuzzer: timeout" in words else "crashes"] += 1
        (folder / "end.txt").write_text(f"status {status}\n{words[-4000:]}")
    return row


def _within(limit: float, process: subprocess.Popen[bytes], done: Callable[[], bool] = lambda: False) -> bool:
    """Wait until something is done or the process has ended; returns False after so many seconds."""
    end = time.monotonic() + limit
    while process.poll() is None and not done():
        if time.monotonic() > end:
            return False
        time.sleep(0.05)
    return True


def main(argv: Sequence[str] | None = None) -> int:
    """Run it; returns 1 if anything was found."""
    from benchmarks.fuzz.samples import Samples
    from benchmarks.fuzz.targets import TARGETS

    parser = command_line("fuzz", "Hostile input.")
    parser.add_argument("--seconds", type=float, default=60.0, help="altogether, of two processors")
    parser.add_argument("--targets", nargs="+", choices=sorted(TARGETS), default=sorted(TARGETS))
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep findings there")
    options = parser.parse_args(argv)
    if options.seconds <= 0.0:
        parser.error("give seconds above 0")
    console = Console(stderr=True)
    share = AT_ONCE * options.seconds / len(options.targets)
    with tempfile.TemporaryDirectory() as temporary, Progress(console=console) as progress:
        folder = options.keep or Path(temporary)
        task = progress.add_task("fuzzing", total=len(options.targets))

        samples = Samples(options.seed)
        for name in options.targets:
            corpus = folder / name / "corpus"
            corpus.mkdir(parents=True)
            for number, sample in enumerate(TARGETS[name].samples(samples)):
                (corpus / f"{number:04}").write_bytes(sample)

        def run(name: str) -> dict[str, Any]:
            row = fuzz_one(name, folder / name, share, options.seed)
            progress.advance(task)
            return row

        with ThreadPoolExecutor(AT_ONCE) as pool:
            rows = dict(zip(options.targets, pool.map(run, options.targets), strict=True))
        findings = [
            f"{path.parent.name}: {path.read_text().strip().splitlines()[-1]}"
            for path in sorted(folder.glob("*/*.txt"))
        ]
    result = {
        **{name: sum(int(row[name]) for row in rows.values()) for name in SUMS},
        "peak_rss_mb": round(max(row["peak_rss_mb"] for row in rows.values()), 1),
        "targets": len(rows), "guided": importlib.util.find_spec("atheris") is not None,
        "seconds": options.seconds, "seed": options.seed,
    }  # fmt: skip
    if options.json:
        print(json.dumps(result))
    else:
        console = Console()
        table = Table("target", *SUMS, "peak MB")
        for name, row in rows.items():
            table.add_row(name, *(str(row[key]) for key in SUMS), f"{row['peak_rss_mb']:.0f}")
        console.print(table)
    for line in findings:
        print(line[:300], file=sys.stderr)
    return 1 if result["crashes"] or result["hangs"] or result["accepted_invalid"] else 0


if __name__ == "__main__":
    sys.exit(main())
