"""A process without some libraries: runs commands and prints what became of each.

    python -m tests.mapweave.without_libraries pybullet gtsam ... < [["map", "show", "x.mapweave"], ...]

It prints a JSON list of [exit status, stdout, stderr].
"""

import io
import json
import sys
import traceback
from collections.abc import Iterable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.metadata import Distribution, DistributionFinder
from types import ModuleType


class Without:
    """A finder of modules that does not find some of them, as if they were not installed."""

    def __init__(self, finder: MetaPathFinder, missing: frozenset[str]) -> None:
        """Ask another finder for all others."""
        self._finder, self._missing = finder, missing

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """None for those that are missing."""
        return None if name.split(".")[0] in self._missing else self._finder.find_spec(name, path, target)

    def find_distributions(self, context: DistributionFinder.Context | None = None) -> Iterable[Distribution]:
        """Versions are those of the installed packages."""
        find = getattr(self._finder, "find_distributions", None)
        return [] if find is None else find(context or DistributionFinder.Context())


def outcome(arguments: list[str]) -> tuple[int | None, str, str]:
    """Run one command."""
    from mapweave.cli import main

    status: int | None = None
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        try:
            status = main(arguments)
        except SystemExit as ended:
            status = ended.code if isinstance(ended.code, int) else 1
        except Exception:  # noqa: BLE001 - the traceback is what the test looks for
            traceback.print_exc()
    return status, out.getvalue(), err.getvalue()


if __name__ == "__main__":
    sys.meta_path[:] = [Without(finder, frozenset(sys.argv[1:])) for finder in sys.meta_path]
    print(json.dumps([outcome(arguments) for arguments in json.load(sys.stdin)]))
