"""Kernels by a small one: compiled once and kept, the same without numba, and where nothing can be kept."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import pytest
from numpy.typing import NDArray
from typing_extensions import TypeAliasType

from mapweave.hybridmap import jit

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
jit.load()  # of a second robot in the process
kernel = some_kernels.lengths
rows = np.array([[3.0, 4.0], [0.0, 2.0]])
report = {"lengths": kernel(rows, some_kernels.Scale(2.0, np.array([1.0, 0.0])), 1).tolist()}
report["table"] = some_kernels.table(np.array([1.0, 2.0, 3.0]), rows).tolist()
stats = getattr(kernel.machine, "stats", None)
report["hits"] = sum(stats.cache_hits.values()) if stats else -1
print(json.dumps(report))
"""


def run(folder: Path, how: str, cache: Path, scale: str = "Scale") -> dict[str, object]:
    (folder / "some_kernels.py").write_text(MODULE.replace("Scale", scale))
    environment = dict(os.environ)
    environment["NUMBA_CACHE_DIR"] = str(cache)
    environment["NUMBA_DISABLE_JIT"] = str(int(how == "disabled"))
    environment["PYTHONPATH"] = os.pathsep.join([str(folder), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM.replace("Scale", scale), how],
        capture_output=True,
        text=True,
        check=False,
        env=environment,
    )
    assert done.returncode == 0, done.stderr
    collected: dict[str, object] = json.loads(done.stdout)
    assert collected["lengths"] == [12.0, 5.0]
    assert np.array(collected["table"]).tolist() == [[3.0, 0.0], [6.0, 0.0], [9.0, 0.0]]
    # Silence for half a minute looks like a process that hangs.
    assert done.stderr.count("compiling") == int(collected["hits"] == 0)
    return collected


@pytest.mark.parametrize("how", ["without", "disabled"])
def test_without_numba_a_kernel_runs_as_it_is_written(tmp_path, how: str):
    assert run(tmp_path, how, tmp_path / "cache")["hits"] == -1


WHOLE = """
import sys
import numpy as np
from typing import Annotated
from numpy.typing import NDArray
from mapweave.hybridmap import jit

Ints = Annotated[NDArray[np.int64], 1]

@jit.compiled
def doubled(numbers: Ints, more: int) -> Ints:
    return 2 * numbers + more

@jit.compiled
def clear(numbers: Ints) -> None:
    numbers[:] = 0

@jit.compiled
def halved(numbers: jit.Vector) -> jit.Vector:
    return 0.5 * numbers

for _ in range(jit.UNCOMPILED):
    assert doubled(np.arange(3), 1).tolist() == [1, 3, 5]
clear(np.ones(3, np.int64))
assert "numba" not in sys.modules, "compiled for a few calls"
halved(np.zeros(2))
assert "numba" in sys.modules, "the two forms of real numbers are not the same to the last bit"
assert doubled(np.arange(3), 1).tolist() == [1, 3, 5]
"""


def test_the_first_calls_with_whole_numbers_do_not_wait_for_numba(tmp_path):
    pytest.importorskip("numba")
    (tmp_path / "whole.py").write_text(WHOLE)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    done = subprocess.run(
        [sys.executable, tmp_path / "whole.py"], capture_output=True, text=True, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_a_kernel_is_compiled_once_and_kept(tmp_path):
    pytest.importorskip("numba")
    assert run(tmp_path, "with", tmp_path / "cache")["hits"] == 0
    assert run(tmp_path, "with", tmp_path / "cache")["hits"] == 1


@pytest.mark.slow
def test_a_kernel_is_compiled_without_a_cache_folder(tmp_path):
    pytest.importorskip("numba")
    (tmp_path / "file").write_text("")
    assert run(tmp_path, "with", tmp_path / "file" / "cache")["hits"] == 0


@pytest.mark.slow
def test_a_kernel_of_an_earlier_version_is_compiled_again(tmp_path):
    """After an upgrade that renamed a class, agents ended with a traceback until the cache was deleted."""
    pytest.importorskip("numba")
    assert run(tmp_path, "with", tmp_path / "cache")["hits"] == 0
    assert run(tmp_path, "with", tmp_path / "cache", "Size")["hits"] == 0
    assert run(tmp_path, "with", tmp_path / "cache", "Size")["hits"] == 1


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["nbi", "nbc"])
@pytest.mark.parametrize("left", [0, 40, 200])
def test_a_kernel_whose_file_is_cut_off_is_compiled_again(tmp_path, kind: str, left: int):
    """As after a loss of power: so many bytes of the index, or of the compiled code, are left."""
    pytest.importorskip("numba")
    cache = tmp_path / "cache"
    assert run(tmp_path, "with", cache)["hits"] == 0
    for path in cache.rglob(f"*.{kind}"):
        path.write_bytes(path.read_bytes()[:left])
    assert run(tmp_path, "with", cache)["hits"] == 0
    assert run(tmp_path, "with", cache)["hits"] == 1


Scalar = TypeVar("Scalar", bound=np.generic)
ALIAS = TypeAliasType("ALIAS", np.ndarray[tuple[Any, ...], np.dtype[Scalar]], type_params=(Scalar,))
"""As NumPy 2.5 declares NDArray, which Python 3.12 and newer get: no command that reads a map ran with it."""


@pytest.mark.parametrize("array", [NDArray, ALIAS])
@pytest.mark.parametrize("scalar", [np.float64, np.int64, np.uint8])
def test_the_elements_of_an_array_are_known_from_each_numpys_annotation(array: Any, scalar: type):
    def one(values: Annotated[array[scalar], 1]) -> None:
        raise AssertionError("only its annotations are read")

    assert jit._scalar(Annotated[array[scalar], 2]) is scalar
    assert jit._is_whole(one) == (scalar is not np.float64)
