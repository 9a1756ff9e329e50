"""Buses that can talk to each other, in memory and over Zenoh, for what every bus must do."""

from typing import Protocol

from mapweave.wire.bus import Bus, Reply, Sample
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.zenoh_bus import ZenohBus
from tests.waiting import eventually, free_port


class Fleet(Protocol):
    """Makes buses that can talk to each other, and cuts and mends their connection."""

    def join(self) -> Bus: ...
    def cut(self) -> None: ...
    def mend(self) -> None: ...


class MemoryFleet:
    def __init__(self) -> None:
        self.hub = MemoryHub()
        self.buses: list[MemoryBus] = []

    def join(self) -> MemoryBus:
        self.buses.append(MemoryBus(self.hub))
        return self.buses[-1]

    def cut(self) -> None:
        for bus in self.buses:
            self.hub.cut(bus)

    def mend(self) -> None:
        for bus in self.buses:
            self.hub.restore(bus)

    def close(self) -> None:
        for bus in self.buses:
            bus.close()


class ZenohFleet:
    def __init__(self) -> None:
        self.endpoints = (f"tcp/127.0.0.1:{free_port()}",)
        self.router = self.open_router()
        self.buses: list[ZenohBus] = []

    def open_router(self) -> ZenohBus:
        return ZenohBus(BusSettings(mode="router", listen=self.endpoints))

    def join(self) -> ZenohBus:
        bus = ZenohBus(BusSettings(endpoints=self.endpoints))
        self.buses.append(bus)
        assert bus.wait_connected(30)
        return bus

    def cut(self) -> None:
        self.router.close()

    def mend(self) -> None:
        self.router = self.open_router()

    def close(self) -> None:
        for bus in self.buses:
            bus.close()
        self.router.close()


def endpoint(port: int) -> str:
    return f"tcp/127.0.0.1:{port}"


class Routers:
    """Routers on ports of this machine, and clients of them."""

    def __init__(self) -> None:
        self.open: list[ZenohBus] = []

    def router(self, port: int, *joined: int) -> ZenohBus:
        return self._opened(
            BusSettings(mode="router", listen=(endpoint(port),), routers=tuple(map(endpoint, joined)))
        )

    def client(self, *ports: int) -> ZenohBus:
        return self._opened(BusSettings(endpoints=tuple(map(endpoint, ports))))

    def close(self) -> None:
        """The newest first."""
        while self.open:
            self.open.pop().close()

    def _opened(self, settings: BusSettings) -> ZenohBus:
        self.open.append(ZenohBus(settings))
        return self.open[-1]


def settle(asker: Bus, key: str, servers: int = 1) -> list[Reply]:
    """Ask until so many servers are seen: a declaration needs a moment to get about."""
    replies: list[Reply] = []

    def seen() -> bool:
        replies[:] = asker.ask(key, b"ping", 2.0)
        return len(replies) >= servers

    eventually(seen)
    return replies


def subscribe(bus: Bus, others: Bus, pattern: str) -> list[Sample]:
    """Subscribe and wait until it is known to the other side."""
    got: list[Sample] = []
    probes: list[Sample] = []
    bus.subscribe(pattern, got.append)
    bus.subscribe("probe/**", probes.append)

    def arrives() -> bool:
        others.publish("probe/x", b"")
        return bool(probes)

    eventually(arrives)
    return got
