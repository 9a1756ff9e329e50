"""Says when an agent's map server is missing, and when it is there again."""

PATIENCE = 20.0
"""s without the map server after which that is reported."""


class ServerWatch:
    """Watches for one agent whether a server is alive.

    Attributes:
        arrivals: how often the map server has come in reach.
    """

    def __init__(self, server: str) -> None:
        """Take the server's name."""
        self._server = server
        self.arrivals, self._in_reach = 0, False
        self._missing = False
        self._seen: float | None = None

    def see(self, in_reach: bool, now: float) -> str:
        """Take in one tick; returns a line for people, or nothing.

        Args:
            in_reach: whether the map server is.
            now: s, of a clock on the wall: a recording's own runs faster.
        """
        self.arrivals += in_reach and not self._in_reach
        self._in_reach = in_reach
        if in_reach:
            missing, self._missing, self._seen = self._missing, False, now
            return f"map server {self._server} is in reach" if missing else ""
        self._seen = now if self._seen is None else self._seen
        if self._missing or now - self._seen <= PATIENCE:
            return ""
        self._missing = True
        return (
            f"no map server {self._server} in reach for {PATIENCE:g} s: what is mapped stays on this disk; "
            "start `mapweave server`, with the same --fleet; with a key, `mapweave keys list` there says "
            "whether it is good"
        )
