"""The exception tree of the whole project: bad input raises one of these, expected failures are results."""


class MapweaveError(Exception):
    """Anything a user can mend. Caught once, in the command line, and printed as one line."""

    def __str__(self) -> str:
        """One line, whatever a library or a file has contributed to the words."""
        return " ".join(line.strip() for line in super().__str__().splitlines())


class InvalidValue(MapweaveError):
    """A value is out of range, not finite, or of the wrong shape."""


class Refused(InvalidValue):
    """What is asked for was understood and looked at, and the answer is no; the words say why."""


class InvalidMessage(MapweaveError):
    """A message from outside does not decode or does not validate."""


class InvalidFile(MapweaveError):
    """A file is truncated, altered, or of another kind."""


class StoreAway(InvalidFile):
    """A database cannot be reached, or the connection with it was lost."""


class SettingsError(MapweaveError):
    """A setting is unknown or has a value that cannot work."""


class DeviceError(MapweaveError):
    """A robot, camera or recording cannot be read or commanded."""


class NotConnected(MapweaveError):
    """There is no router, or no answer."""


class Busy(MapweaveError):
    """More is asked than can be answered at present; the same question may be asked again later.

    Attributes:
        retry_after: s.
    """

    def __init__(self, retry_after: float) -> None:
        super().__init__(f"busy, retry after {retry_after:.1f} s")
        self.retry_after = retry_after
