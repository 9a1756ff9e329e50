"""Which form of the costly products runs: compiled where numba is installed, else NumPy's."""

from __future__ import annotations

from agent.ekf import algebra

try:
    import numba
    import scipy.linalg  # noqa: F401

    COMPILED = bool(numba.__version__)
except ImportError:
    COMPILED = False
"""Whether this installation has what the compiled form needs: the extra `fast`."""

if COMPILED:
    from agent.ekf import compiled

    transition, propagate, spread = compiled.transition, compiled.propagate, compiled.spread
    inverse, leave_one_out, condition = compiled.inverse, compiled.leave_one_out, compiled.condition
    finite_rows, ahead, pull = compiled.finite_rows, compiled.ahead, compiled.pull
else:
    transition, propagate, spread = algebra.transition, algebra.propagate, algebra.spread
    inverse, leave_one_out, condition = algebra.inverse, algebra.leave_one_out, algebra.condition
    finite_rows, ahead, pull = algebra.finite_rows, algebra.ahead, algebra.pull
