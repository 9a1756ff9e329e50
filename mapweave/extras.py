"""The extras of the package: libraries that a plain installation leaves out, and who needs them."""

import shlex
import shutil
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from mapweave.exit_status import MISSING_EXTRA
from mapweave.hybridmap.errors import MapweaveError

MODULES = {
    "server": (
        "cryptography",
        "faiss",
        "gtsam",
        "numba",
        "prometheus_client",
        "python_multipart",
        "scipy",
        "starlette",
        "uvicorn",
        "wsproto",
    ),
    "cluster": ("ray",),
    "postgres": ("psycopg",),
    "sim": ("pybullet",),
    "eval": ("evo",),
    "gym": ("gymnasium",),
    "viz": ("matplotlib",),
    "rerun": ("rerun",),
    "metrics": ("prometheus_client",),
}
"""What each extra installs, by the names that are imported. No command needs `gym`; `fast` is left out."""
TRIAL = ("server", "sim", "eval", "viz")
"""What a scenario with a whole fleet needs, its report included."""


class MissingExtra(MapweaveError):
    """A command needs libraries that are not installed."""

    def __init__(self, extras: Sequence[str]) -> None:
        """Name the extras and how to install them."""
        *first, last = (f'"{extra}"' for extra in extras)
        names = f"{', '.join(first)} and {last}" if first else last
        super().__init__(f"needs the extra{'s' * (len(extras) > 1)} {names}: {how_to_install(*extras)}")


def pip() -> str:
    """What to type for the pip of the environment that runs this.

    Where this environment is not activated, a shell finds no `pip`, or that of the system, which installs
    elsewhere or refuses to (PEP 668).
    """
    here, found = Path(sys.executable).parent, shutil.which("pip")
    return "pip" if found and Path(found).parent == here else f"{shlex.quote(sys.executable)} -m pip"


def how_to_install(*extras: str) -> str:
    """The command that installs extras, each by its name."""
    return f"{pip()} install 'mapweave[{','.join(extras)}]'"


def need(*extras: str) -> None:
    """Check that extras are installed, for a command that needs several, or one of them only late.

    A command that needs a single extra at once does without: `cli.main` reads it off the import that fails.

    Raises:
        MissingExtra: some are not.
    """
    missing = [extra for extra in extras if any(find_spec(module) is None for module in MODULES[extra])]
    if missing:
        raise MissingExtra(missing)


def exit_without(*extras: str) -> None:
    """End a script in one line, as a command ends, if extras are not installed. Else nothing happens."""
    try:
        need(*extras)
    except MissingExtra as error:
        print(f"{Path(sys.argv[0]).name} {error}", file=sys.stderr)
        sys.exit(MISSING_EXTRA)


def extra_of(module: str | None) -> str | None:
    """The extra that installs a module, as a failed import names it; None if none does."""
    root = (module or "").split(".")[0]
    return next((extra for extra, modules in MODULES.items() if root in modules), None)
