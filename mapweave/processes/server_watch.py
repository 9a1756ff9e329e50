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
        self._missing, self._seen_ns = False, 0

    def see(self, in_reach: bool, stamp_ns: int) -> str:
        """Take in one tick; returns a line for people, or nothing."""
        self.arrivals += in_reach and not self._in_reach
        self._in_reach = in_reach
        if in_reach:
            missing, self._missing, self._seen_ns = self._missing, False, stamp_ns
            return f"map server {self._server} is in reach" if missing else ""
        self._seen_ns = self._seen_ns or stamp_ns
        if self._missing or stamp_ns - self._seen_ns <= PATIENCE * 1e9:
            return ""
        self._missing = True
        return (
            f"no map server {self._server} in reach for {PATIENCE:g} s: what is mapped stays on this disk; "
            "start `mapweave server`, with the same --fleet; with a key, `mapweave keys list` there says "
            "whether it is good"
        )
