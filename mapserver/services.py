"""Robots' questions over the bus. Views are for the desk, the map is packed beside; the rest is quick."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from concurrent.futures import Executor

from mapweave.hybridmap.errors import Busy, MapweaveError
from mapweave.hybridmap.map_event import MapEvent
from mapweave.hybridmap.query import KnownRequest, RouteAnswer, RouteRequest
from mapweave.mapserver.admission_control import AdmissionControl
from mapweave.mapserver.answers import Answers
from mapweave.mapserver.blockages import Blockages
from mapweave.mapserver.packed_map import PackedMap
from mapweave.mapserver.wire_limits import Pairs, drivable, said
from mapweave.wire.bus import Bus, Closing, Request
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import Scalar, encode_record
from mapweave.wire.messages import decode, decode_view, encode

log = logging.getLogger(__name__)

Handler = Callable[[bytes], bytes]


class Services:
    """Declared on a bus until closed."""

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        name: str,
        answers: Callable[[], Answers],
        desk: AdmissionControl,
        blockages: Blockages,
        status: Callable[[], dict[str, Scalar]],
        history: Callable[[], Iterable[MapEvent]],
        clock: Callable[[], float],
        executor: Executor,
    ) -> None:
        """Begin to answer.

        Args:
            bus: the connection; stays the caller's.
            keys: of the fleet.
            name: of the server in the fleet.
            answers: the newest ones. May wait for them.
            desk: for questions that take long.
            blockages: takes note of where robots did not get through.
            status: of the server.
            history: of the maps, for who takes them along.
            clock: only grows, s.
            executor: packs the whole map; it is shut down with this.
        """
        self._clock = clock
        self._answers = answers
        self._desk = desk
        self._blockages = blockages
        self._status = status
        self._map = PackedMap(
            answers, history, lambda request, pack: guarded(lambda _: pack())(request), executor
        )
        self._closing: list[Closing] = [
            bus.serve(keys.relocalize(name), self._relocalize_later),
            bus.serve(keys.route(name), guarded(self._route)),
            bus.serve(keys.known(name), guarded(self._known)),
            bus.serve(keys.server_map(name), self._map.ask),
            bus.serve(keys.server_status(name), guarded(self._tell_status)),
            bus.announce(keys.server_alive(name)),
        ]

    def close(self) -> None:
        """Stop answering."""
        for closing in self._closing:
            closing.close()
        self._map.close()

    def _relocalize_later(self, request: Request) -> None:
        done = self._desk.submit(lambda: self._relocalize(request.payload), hash(request.payload))
        done.add_done_callback(lambda done: guarded(lambda _: done.result())(request))

    def _relocalize(self, payload: bytes) -> bytes:
        view = decode_view(payload)
        return encode(said(self._answers().relocalizer.answer(view)))

    def _route(self, payload: bytes) -> bytes:
        request = decode(payload, RouteRequest)
        answers = self._answers()
        self._blockages.report(request.blocked, self._clock())
        wary = self._blockages.known(self._clock())

        def route(blocked: Pairs) -> RouteAnswer:
            start, goal, here = request.start, request.goal, request.start_from_robot
            return answers.router.route(start, goal, blocked, wary, here)

        return encode(drivable(route, request.blocked))

    def _known(self, payload: bytes) -> bytes:
        request = decode(payload, KnownRequest)
        answer = self._answers().known.answer(request.map, (request.x, request.y), request.reach)
        return encode(answer)

    def _tell_status(self, payload: bytes) -> bytes:
        self._answers()
        return encode_record(self._status())


def guarded(answer: Handler) -> Callable[[Request], None]:
    """Answer, or refuse with the reason: an asker must never wait for its time to run out."""

    def handle(request: Request) -> None:
        try:
            request.reply(answer(request.payload))
        except Busy as error:
            request.refuse(str(error), error.retry_after)
        except MapweaveError as error:
            request.refuse(str(error))
        except Exception as error:  # a defect here must not leave a robot waiting
            log.exception("no answer to %s", request.key)
            request.refuse(f"the server failed: {error}")

    return handle
