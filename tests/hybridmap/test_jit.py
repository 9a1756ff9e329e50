"""Kernels by a small one: compiled once and kept, the same without numba, and where nothing can be kept."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

MODULE = """
from typing import NamedTuple
import numpy as np
from mapweave.hybridmap.jit import Index, Matrix, Vector, compiled, for_each, for_each_pair

class Scale(NamedTuple):
    by: float
    offsets: Vector

@for_each
def square(n: Index, rows: Matrix, out: Vector) -> None:
    out[n] = rows[n, 0] ** 2 + rows[n, 1] ** 2

@for_each_pair
def product(m: Index, n: Index, a: Vector, rows: Matrix) -> float:
    return a[m] * rows[n, 0]

@compiled
def lengths(rows: Matrix, scale: Scale, more: int) -> Vector:
    out = np.empty(len(rows))
    square(len(rows), rows, out)
    return scale.by * np.sqrt(out) + scale.offsets + more

@compiled
def table(a: Vector, rows: Matrix) -> Matrix:
    return product(len(a), len(rows), a, rows)
"""

PROGRAM = """
import json, sys
if sys.argv[1] == "without":
    sys.modules["numba"] = None
import numpy as np
import some_kernels
from mapweave.hybridmap import jit
assert "numba" not in sys.modules or sys.argv[1] == "without", "imported too early"
jit.load()
kernel = some_kernels.lengths
rows = np.array([[3.0, 4.0], [0.0, 2.0]])
report = {"lengths": kernel(rows, some_kernels.Scale(2.0, np.array([1.0, 0.0])), 1).tolist()}
report["table"] = some_kernels.table(np.array([1.0, 2.0, 3.0]), rows).tolist()
stats = getattr(kernel.machine, "stats", None)
report["hits"] = sum(stats.cache_hits.values()) if stats else -1
print(json.dumps(report))
"""


def run(folder: Path, how: str, cache: Path) -> dict[str, object]:
    (folder / "some_kernels.py").write_text(MODULE)
    environment = dict(os.environ)
    environment["NUMBA_CACHE_DIR"] = str(cache)
    environment["NUMBA_DISABLE_JIT"] = str(int(how == "disabled"))
    environment["PYTHONPATH"] = os.pathsep.join([str(folder), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, how], capture_output=True, text=True, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr
    collected: dict[str, object] = json.loads(done.stdout)
    assert collected["lengths"] == [12.0, 5.0]
    assert np.array(collected["table"]).tolist() == [[3.0, 0.0], [6.0, 0.0], [9.0, 0.0]]
    # Silence for half a minute looks like a process that hangs.
    assert done.stderr.count("compiling") == int(collected["hits"] == 0)
    return collected


@pytest.mark.parametrize("how", ["without", "disabled"])
def test_without_numba_a_kernel_runs_as_it_is_written(tmp_path: Path, how: str) -> None:
    assert run(tmp_path, how, tmp_path / "cache")["hits"] == -1


@pytest.mark.slow
def test_a_kernel_is_compiled_once_and_kept(tmp_path: Path) -> None:
    pytest.importorskip("numba")
    assert run(tmp_path, "with", tmp_path / "cache")["hits"] == 0
    assert run(tmp_path, "with", tmp_path / "cache")["hits"] == 1


@pytest.mark.slow
def test_a_kernel_is_compiled_without_a_cache_folder(tmp_path: Path) -> None:
    pytest.importorskip("numba")
    (tmp_path / "file").write_text("")
    assert run(tmp_path, "with", tmp_path / "file" / "cache")["hits"] == 0
