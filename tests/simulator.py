"""Whether the simulator is installed; tests that need it are skipped where it is not."""

from importlib.machinery import ModuleSpec
from importlib.util import find_spec

import pytest

INSTALLED = find_spec("pybullet") is not None
REASON = "needs the simulator: pip install 'mapweave[sim]'"

needs_simulator = pytest.mark.skipif(not INSTALLED, reason=REASON)
"""For tests that start the simulator in another process; an import in this one is noticed by itself."""


class SkipWithoutSimulator:
    """A finder of modules that skips the test, or the file of tests, in which pybullet is imported."""

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        """Skip at pybullet, leave the others to other finders."""
        if name == "pybullet":
            pytest.skip(REASON, allow_module_level=True)
        return None
