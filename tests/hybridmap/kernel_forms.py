"""Tests of kernels run twice: as numba compiles them, and in NumPy as on a robot without it."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

import pytest

from mapweave.hybridmap.jit import KERNELS, load


@contextmanager
def in_numpy() -> Iterator[None]:
    """Run kernels as they are written."""
    with pytest.MonkeyPatch.context() as patch:
        for kernel in KERNELS:
            patch.setitem(kernel.__dict__, "machine", kernel.python)
        yield


# NumPy's form is slower; test_kernel_forms.py and test_landmark_codec.py compare both in any case.
NUMPY = pytest.param("numpy", marks=[pytest.mark.slow] if find_spec("numba") else [])


@pytest.fixture(params=["numba", NUMPY], scope="module")
def form(request: pytest.FixtureRequest) -> Iterator[str]:
    """Either form, for all tests of a module that uses it."""
    if request.param == "numba":
        pytest.importorskip("numba")
        load()
        yield "numba"
    else:
        with in_numpy():
            yield "numpy"
