"""One driver per network address on this machine, as an open serial port is locked."""

from __future__ import annotations

import errno
import socket

from mapweave.hybridmap.errors import DeviceError


class AddressLock:
    """Held until closed, or until the process ends.

    The lock is a name in Linux's abstract namespace of sockets: it leaves no file behind, and holds for all
    users of the machine. Programs on other machines do not see it.
    """

    def __init__(self, host: str, port: int) -> None:
        """Take the lock.

        Args:
            host: IP address of the robot: one robot may have several names.
            port: of its server.

        Raises:
            DeviceError: another driver holds it.
        """
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.bind(f"\0mapweave/robot/{host}/{port}")
        except OSError as error:
            self._socket.close()
            reason = "is in use by another process" if error.errno == errno.EADDRINUSE else error.strerror
            raise DeviceError(f"http://{host}:{port}: {reason}") from error

    def close(self) -> None:
        """Release the lock. May be called twice."""
        self._socket.close()
