"""For all tests: one thread for the algebra, as in Mapweave's own processes."""

from __future__ import annotations

# Before anything imports numpy: the package itself says how many threads BLAS gets.
import mapweave  # noqa: F401
