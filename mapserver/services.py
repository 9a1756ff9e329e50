"""Robots' questions over the bus. Views pass admission control, the map is packed in the background."""

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import replace
from functools import partial
from itertools import islice

from mapweave.hybridmap.agent_status import FleetStatus
from mapweave.hybridmap.errors import Busy, InvalidMessage, MapweaveError
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.map_event import MapEvent
from mapweave.hybridmap.mission_order import MissionRequest
from mapweave.hybridmap.nearby import NearbyRequest
from mapweave.hybridmap.pose import Array
from mapweave.hybridmap.query import (
    KnownRequest,
    Obstacle,
    RelocalizeAnswer,
    ReserveAnswer,
    ReserveRequest,
    RouteAnswer,
    RouteRequest,
    View,
)
from mapweave.mapserver.admission_control import AdmissionControl
from mapweave.mapserver.answers import Answers
from mapweave.mapserver.blockages import Blockages
from mapweave.mapserver.mission_relay import MissionRelay
from mapweave.mapserver.nearby import Nearby, StandingRobot
from mapweave.mapserver.obstacles import Disc, Discs, placed
from mapweave.mapserver.packed_map import PackedMap
from mapweave.mapserver.parked_robots import route_past_parked
from mapweave.mapserver.places import PlaceResolver
from mapweave.mapserver.quotas import Quotas
from mapweave.mapserver.reservations import Reservations
from mapweave.mapserver.roster import Roster
from mapweave.mapserver.route_rules import rule_words
from mapweave.mapserver.routes import Router
from mapweave.mapserver.wire_limits import drivable, within_range
from mapweave.merge.floors import maps_elsewhere
from mapweave.wire.bus import Bus, BusClient, Request
from mapweave.wire.keys import Keys, robot_of
from mapweave.wire.log_messages import Scalar, encode_record
from mapweave.wire.messages import decode, decode_view, encode
from mapweave.wire.senders import sent_by_any, serve_senders

log = logging.getLogger(__name__)

Handler = Callable[[bytes], bytes]


class Services(BusClient):
    """BusClient on a bus until closed."""

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        name: str,
        answers: Callable[[], Answers],
        admission: AdmissionControl,
        blockages: Blockages,
        status: Callable[[], dict[str, Scalar]],
        history: Callable[[], Iterable[MapEvent]],
        missions: MissionRelay,
        roster: Roster,
        relays: Executor,
        clock: Callable[[], float],
        executor: Executor,
        places: Callable[[], PlaceResolver],
        images: Callable[[], Mapping[str, bytes]],
        quotas: Quotas,
        observe: Callable[[float, Future[RelocalizeAnswer]], None] = lambda seconds, done: None,
    ) -> None:
        """Begin to answer.

        Args:
            bus: the connection; stays the caller's.
            keys: of the fleet.
            name: of the server in the fleet.
            answers: the newest ones. May wait for them.
            admission: admission control of long questions.
            blockages: takes note of where robots did not get through.
            status: of the server.
            history: of the maps, for who takes them along.
            missions: hands missions on.
            roster: of the robots.
            relays: waits for robots' answers; it is shut down with this.
            clock: only grows, s.
            executor: packs the whole map; it is shut down with this.
            places: named places of the newest merged map. May wait for it.
            images: of the plans, for the map's file.
            quotas: of robots.
            observe: called with the time from each question for a place to its answer, s, and the answer.
        """
        self._places, self._roster = places, roster
        self._quotas = quotas
        self._observe = observe
        self._clock = clock
        self._answers = answers
        self._admission = admission
        self._blockages = blockages
        self._status = status
        self._missions = missions
        self._relays = relays
        self._nearby = Nearby()
        self._reservations = Reservations(self._nearby.standing, self._nearby.radius)
        self._map = PackedMap(
            answers, history, lambda request, pack: guarded(lambda _: pack())(request), executor,
            lambda: places().annotations, images,
        )  # fmt: skip
        of_robots: dict[str, Callable[[Request], None]] = {
            keys.relocalize(name): self._relocalize_later,
            keys.route(name): _in_name(self._route),
            keys.known(name): guarded(self._known),
            keys.reserve(name): _in_name(self._reserve),
            keys.nearby(name): _in_name(self._around),
        }
        self._closing = [
            *(bus.serve(question, answer) for question, answer in of_robots.items()),
            *(
                bus.serve(sent_by_any(question), self._limited(answer))
                for question, answer in of_robots.items()
            ),
            bus.serve(keys.server_map(name), self._map.ask),
            *serve_senders(bus, keys.server_mission(name), self._command_later),
            bus.serve(keys.missions(name), guarded(lambda _: encode(missions.missions()))),
            bus.serve(keys.robots(name), guarded(lambda _: encode(self.robots()))),
            bus.serve(keys.server_status(name), guarded(self._tell_status)),
            bus.announce(keys.server_alive(name)),
        ]

    def close(self) -> None:
        """Stop answering."""
        super().close()
        self._relays.shutdown()
        self._map.close()

    def robots(self) -> FleetStatus:
        """The robots, where they are, and the ways of those that drive; from any thread."""
        return self._roster.robots(self._places(), self._reservations.ways(self._clock()))

    def map_file(self) -> Future[bytes]:
        """The merged map as a map file, from any thread."""
        return self._map.packed()

    def _command_later(self, request: Request, who: str) -> None:
        def command(payload: bytes) -> bytes:
            mission = decode(payload, MissionRequest)
            return encode(self._missions.command(replace(mission, by=who or mission.by)))

        # It waits for a robot, which nothing else of the server may do.
        self._relays.submit(guarded(command), request)

    def _limited(self, answer: Callable[[Request], None]) -> Callable[[Request], None]:
        """Answer a robot that asks no more than its quota."""

        def handle(request: Request) -> None:
            self._quotas.ask(robot_of(request.key))
            answer(request)

        return handle

    def _relocalize_later(self, request: Request) -> None:
        look, robot = partial(decode_view, request.payload), robot_of(request.key)
        done = self.locate(look, hash(request.payload), robot)
        done.add_done_callback(lambda done: guarded(lambda _: encode(within_range(done.result())))(request))

    def locate(self, look: Callable[[], View], ticket: int, asker: str = "") -> Future[RelocalizeAnswer]:
        """Ask where a view was taken, from any thread; see `AdmissionControl.submit`.

        Args:
            look: makes the view; called by a worker.
            ticket: the same if the same image comes again.
            asker: a robot; empty for people.

        Raises:
            Busy: too many ask.
        """
        began = self._clock()
        done = self._admission.submit(lambda: self._located(look()), ticket, asker=asker)
        done.add_done_callback(lambda done: self._observe(self._clock() - began, done))
        return done

    def _located(self, view: View) -> RelocalizeAnswer:
        """Where a view was taken, with the names of the places; on the floor that the robot knows, if any."""
        answers, places = self._answers(), self._places()
        elsewhere: frozenset[MapId] = frozenset()
        if view.near is not None:
            elsewhere = maps_elsewhere(answers.merged, places.annotations.floors, view.near)
        return places.named(answers.relocalizer.answer(view, elsewhere))

    def _route(self, payload: bytes, robot: str) -> bytes:
        request, now = decode(payload, RouteRequest), self._clock()
        router = self._answers().router
        barred = self._barred(request.obstacles, router, now)
        # Of robots the server knows itself where they stand.
        things = self._barred([one for one in request.obstacles if not one.robot], router, now)
        hops = (tuple(sorted(hop)) for hop in Discs(router.roads, things).barred)
        self._blockages.report([*request.blocked, *((a, b) for a, b in hops)], now, robot)
        wary = self._blockages.known(now)

        def route(parked: Sequence[Disc]) -> RouteAnswer:
            past, start, goal = router.past([*barred, *parked]), request.start, request.goal
            return drivable(
                lambda blocked: past.route(start, goal, blocked, wary, request.start_from_robot),
                request.blocked,
            )

        def standing(way: Array, component: int, radius: float) -> list[StandingRobot]:
            return self._reservations.parked(way, component, radius, router.merged, now, robot)

        radius = self._reservations.radius(robot, router) if robot else None
        return encode(route_past_parked(request, router.roads, route, standing, radius))

    def _barred(self, obstacles: Sequence[Obstacle], router: Router, now: float) -> list[Disc]:
        """Where the obstacles are that a robot has met, without those of robots that have left."""
        graphs, discs = router.merged.graphs, []
        for one in obstacles:
            disc = placed(one, router.roads)
            if disc is not None and not (
                one.robot
                and self._nearby.left(
                    one.robot, (disc.x, disc.y), disc.reach, graphs[disc.component].anchor, now
                )
            ):
                discs.append(disc)
        return discs

    def _reserve(self, payload: bytes, robot: str) -> bytes:
        request = decode(payload, ReserveRequest)
        if robot not in ("", request.robot):
            raise InvalidMessage(f"{robot} reserves nothing for {request.robot}")
        router, closed = self._answers().router, None
        if rules := router.rules:
            within = rules.around(request.start, request.start_from_robot)
            closed = rules.first_closed((request.start, *request.route), within)
        if closed is None:
            return encode(self._reservations.ask(request, router, self._clock()))
        self._reservations.ask(replace(request, route=()), router, self._clock())
        number, closure = closed
        return encode(ReserveAnswer(number, "", None, f"the way ahead is {rule_words(closure)}", True))

    def _around(self, payload: bytes, robot: str) -> bytes:
        request = decode(payload, NearbyRequest)
        if robot not in ("", request.robot):
            raise InvalidMessage(f"{robot} does not say where {request.robot} is")
        router, now = self._answers().router, self._clock()
        answer = self._nearby.ask(request, router.merged, now)
        known = (start for start in request.starts if router.merged.component_of(start[0]) is not None)
        for node, node_from_robot in islice(known, 1):
            aside = self._reservations.room_for(request.robot, node, node_from_robot, router, now)
            answer = replace(answer, aside=aside)
        return encode(answer)

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


def _in_name(answer: Callable[[bytes, str], bytes]) -> Callable[[Request], None]:
    """Answer in the name of the robot that asks; see `guarded`."""
    return lambda request: guarded(lambda payload: answer(payload, robot_of(request.key)))(request)
