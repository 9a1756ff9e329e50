"""Asking servers that are busy."""

from __future__ import annotations

import time

from mapweave.wire.bus import Reply, Request
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.patience import ask_patiently


def test_a_busy_server_is_asked_again_at_its_time() -> None:
    hub = MemoryHub()
    server, person = MemoryBus(hub), MemoryBus(hub)
    asked: list[float] = []

    def answer(request: Request) -> None:
        asked.append(time.monotonic())
        if len(asked) < 3:
            request.refuse("busy", 0.1)
        else:
            request.reply(b"because")

    closing = server.serve("why", answer)
    assert ask_patiently(person, "why", b"", 20.0) == [Reply(b"because")]
    assert len(asked) == 3 and asked[1] - asked[0] >= 0.1
    # Not beyond the time that the person gives.
    asked.clear()
    (reply,) = ask_patiently(person, "why", b"", 0.05)
    assert reply.error == "busy" and len(asked) == 1
    closing.close()
    server.close()
    person.close()
