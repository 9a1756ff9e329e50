"""PyBullet without its global state: one object is one physics, and its calls go there."""

import functools
import inspect
import os
from typing import Any

# PyBullet says when it was built on stderr itself, amid the lines of a log.
_stderr, _nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
os.dup2(_nowhere, 2)
try:
    import pybullet
finally:
    os.dup2(_stderr, 2)
    os.close(_stderr)
    os.close(_nowhere)


class Physics:
    """A physics in this process, with PyBullet's functions as methods.

    Not `pybullet_utils.bullet_client`, which connects with an empty option string: PyBullet then prints
    "argv[0]=" on stdout, where a program's `--json` shall be.
    """

    def __init__(self) -> None:
        """Make an empty physics."""
        self._client = int(pybullet.connect(pybullet.DIRECT))

    def __getattr__(self, name: str) -> Any:
        """PyBullet's function or constant of this name; a function is bound to this physics once."""
        attribute = getattr(pybullet, name)
        if inspect.isbuiltin(attribute):
            attribute = functools.partial(attribute, physicsClientId=self._client)
        setattr(self, name, attribute)
        return attribute

    def close(self) -> None:
        """Release the physics. Idempotent."""
        if self._client >= 0:
            pybullet.disconnect(physicsClientId=self._client)
            self._client = -1
