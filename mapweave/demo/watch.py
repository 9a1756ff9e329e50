"""What the fleet says of itself, collected as it comes."""

from __future__ import annotations

import threading
from dataclasses import dataclass

from agent.fleet import AgentReport, decode_report
from hybridmap.errors import InvalidMessage
from wire.bus import Bus, Sample
from wire.keys import Keys
from wire.log_messages import decode_record


@dataclass(frozen=True)
class ServerReport:
    """The last that the server said.

    Attributes:
        nodes: in the merged map.
        maps: that have come.
        components: of the merged map.
        links: between maps.
        settled: whether everything that came is merged.
        payload_bytes: received for changes.
        node_puts: nodes received.
        summary: in words.
    """

    nodes: int = 0
    maps: int = 0
    components: int = 0
    links: int = 0
    settled: bool = False
    payload_bytes: int = 0
    node_puts: int = 0
    summary: str = "nothing yet"


class Watch:
    """Listens to the status of agents and server.

    Attributes:
        server: the server's last report.
        fixes: for each agent, the first report of each stretch in which it knew where it was.
    """

    def __init__(self, bus: Bus, keys: Keys) -> None:
        """Begin to listen."""
        self.server = ServerReport()
        self._agents: dict[str, AgentReport] = {}
        self._first_fix: dict[str, AgentReport] = {}
        self._lock = threading.Lock()
        self._keys = keys
        self._closing = [
            bus.subscribe(keys.agent_statuses(), self._agent),
            bus.subscribe(keys.server_statuses(), self._server),
        ]

    def agents(self) -> dict[str, AgentReport]:
        """The last report of each agent."""
        with self._lock:
            return dict(self._agents)

    def first_fix(self, agent: str) -> AgentReport | None:
        """The first report since `forget_fix` in which the agent knew where it was."""
        with self._lock:
            return self._first_fix.get(agent)

    def close(self) -> None:
        """Stop listening."""
        for closing in self._closing:
            closing.close()

    def _agent(self, sample: Sample) -> None:
        report = decode_report(sample.payload)
        name = self._keys.parse_agent_status(sample.key)
        with self._lock:
            self._agents[name] = report
            if report.fix_node is not None:
                self._first_fix.setdefault(name, report)

    def _server(self, sample: Sample) -> None:
        values = decode_record(sample.payload)
        try:
            self.server = ServerReport(
                int(values["nodes"]), int(values["maps"]), int(values["components"]), int(values["links"]),
                bool(values["settled"]), int(values["bytes"]), int(values["node_puts"]),
                str(values["summary"]),
            )  # fmt: skip
        except (KeyError, ValueError) as error:
            raise InvalidMessage(f"server status: {error}") from None
