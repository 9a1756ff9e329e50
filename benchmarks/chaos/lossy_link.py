"""TCP links that can be cut, slowed, frozen and half closed: forwarders between two ends of a fleet.

TCP loses no single bytes, so a lossy radio looks like delays and broken connections: that is what these do.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable
from dataclasses import dataclass, field

PIECE = 1 << 16


@dataclass
class Link:
    """One forwarder. What is set here holds for what comes from now on.

    Attributes:
        target: port of this machine to which it leads.
        port: at which it listens.
        cut: connections end at once, and new ones too.
        frozen: nothing comes through, and no end learns of it.
        delay: s, of each piece.
        rate: bytes a second.
    """

    target: int
    port: int = 0
    cut: bool = False
    frozen: bool = False
    delay: float = 0.0
    rate: float = float("inf")
    writers: set[asyncio.StreamWriter] = field(default_factory=set)

    @property
    def endpoint(self) -> str:
        """Where it listens."""
        return f"tcp/127.0.0.1:{self.port}"


class Links:
    """All links, on a thread of their own. A context manager."""

    def __init__(self) -> None:
        """Begin without links."""
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="links", daemon=True)

    def __enter__(self) -> Links:
        """Start the thread."""
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """End all connections."""

        async def end() -> None:
            others = asyncio.all_tasks() - {asyncio.current_task()}
            for task in others:
                task.cancel()
            await asyncio.gather(*others, return_exceptions=True)

        asyncio.run_coroutine_threadsafe(end(), self._loop).result(10.0)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def open(self, target: int) -> Link:
        """A link to a port of this machine."""
        link = Link(target)

        async def listen() -> int:
            server = await asyncio.start_server(lambda r, w: self._serve(link, r, w), "127.0.0.1", 0)
            return int(server.sockets[0].getsockname()[1])

        link.port = asyncio.run_coroutine_threadsafe(listen(), self._loop).result(10.0)
        return link

    def change(self, link: Link, how: Callable[[Link], None]) -> None:
        """Change a link; connections of one that is cut end now."""

        def now() -> None:
            how(link)
            if link.cut:
                for writer in list(link.writers):
                    writer.transport.abort()

        self._loop.call_soon_threadsafe(now)

    def half_close(self, link: Link) -> None:
        """End one direction of each connection: a client goes on sending, and hears that no answer comes."""

        def now() -> None:
            for writer in list(link.writers)[::2]:
                with contextlib.suppress(OSError, RuntimeError):
                    writer.write_eof()

        self._loop.call_soon_threadsafe(now)

    async def _serve(self, link: Link, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            if link.cut:
                writer.transport.abort()
                return
            there, back = await asyncio.open_connection("127.0.0.1", link.target)
            link.writers |= {writer, back}
            try:
                await asyncio.gather(self._pump(link, reader, back), self._pump(link, there, writer))
            finally:
                link.writers -= {writer, back}
                writer.close()
                back.close()

    async def _pump(self, link: Link, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Pass on what comes, in order; both directions end with either."""
        due: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(64)

        async def send() -> None:
            while True:
                at, data = await due.get()
                await asyncio.sleep(at - self._loop.time())
                while link.frozen:
                    await asyncio.sleep(0.05)
                if not data:
                    return
                writer.write(data)
                await writer.drain()
                await asyncio.sleep(len(data) / link.rate)

        sending = asyncio.create_task(send())
        try:
            data = b"-"
            while data:
                data = await reader.read(PIECE)
                await due.put((self._loop.time() + link.delay, data))
            await sending
        except (OSError, RuntimeError):
            # Broken, or half closed: nothing more can be written.
            pass
        finally:
            sending.cancel()
            # The other direction reads the end of its connection.
            writer.transport.abort()
