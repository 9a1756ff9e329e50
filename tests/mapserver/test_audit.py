"""Who, when and why in the server's records, with sessions of their own over TLS: the holder of the key."""

import shutil
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace

import pytest

from mapweave.agent.fleet_client import FleetClient
from mapweave.agent.mission_control import MissionControl
from mapweave.fleet import Fleet
from mapweave.hybridmap.agent_status import Status
from mapweave.hybridmap.annotation import Annotation, AnnotationRequest, Place
from mapweave.hybridmap.constraint_subject import RetiredNodes
from mapweave.hybridmap.errors import InvalidValue, NotConnected
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.manual_constraint import ConstraintRequest, ManualConstraint
from mapweave.hybridmap.mission_order import MissionKind, MissionRequest
from mapweave.hybridmap.pose import Pose2
from mapweave.identities.key_file import read_key_file
from mapweave.identities.key_folder import KeyFolder, Profile
from mapweave.mapserver.server import MapServer
from mapweave.teleoperation.session import Session
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.credentials import Role
from mapweave.wire.keys import Keys
from mapweave.wire.messages import encode
from mapweave.wire.senders import sent_by
from mapweave.wire.zenoh_bus import ZenohBus
from tests.mapserver.house import ROBOT, MappedRoom
from tests.waiting import eventually, free_port

KEYS = Keys("demo")
NODES = [NodeId("r0", 1, 5), NodeId("r0", 1, 7)]


def test_the_records_name_the_holder_of_the_key(mapped_room: Callable[[], MappedRoom], tmp_path):
    folder = KeyFolder.create(tmp_path / "keys", "demo", Profile.PRODUCTION, [], "s0", free_port())
    (endpoint,) = folder.catalogue.endpoints
    for name, role in (("anna", Role.OPERATOR), ("vera", Role.VIEWER), ("r0", Role.ROBOT)):
        folder.add(name, role)
    anna_key, vera_key = folder.key_file("anna"), folder.key_file("vera")
    with ExitStack() as stack:
        router = ZenohBus(folder.router("s0", [endpoint]))
        stack.callback(router.close)
        server = stack.enter_context(MapServer(router, KEYS, mapped_room().path, "s0"))
        eventually(lambda: server.status()["nodes"] == 7)

        def bus(name: str) -> ZenohBus:
            credentials = read_key_file(folder.key_file(name)).credentials
            made = ZenohBus(BusSettings(endpoints=(endpoint,), credentials=credentials))
            stack.callback(made.close)
            assert made.wait_connected(10)
            return made

        def words() -> list[str]:
            return [event.words for event in server.history()]

        anna = stack.enter_context(Fleet(endpoint, "demo", keys=anna_key))
        anna.retire(str(NODES[0]), because="a mirror")
        assert "retired by anna on 2" in words()[-1] and words()[-1].endswith('UTC: "a mirror"')
        anna.undo(1, because="a window")
        assert "in use again, by anna on 2" in words()[-1] and words()[-1].endswith('UTC: "a window"')
        assert server.settle(30)

        # A program that says another name in the message.
        session = bus("anna")
        constraint = ManualConstraint(RetiredNodes((NODES[1],)), True, "vera", 10**18, "forged")
        annotation = Annotation("kitchen", Place(NODES[0]), False, "vera", 10**18, "forged")
        for key, message in (
            (KEYS.any_constrain(), encode(ConstraintRequest(constraint))),
            (KEYS.any_annotate(), encode(AnnotationRequest(annotation))),
        ):
            (reply,) = session.ask(sent_by(key, "anna"), message, 20.0)
            assert not reply.error
            assert not session.ask(key, message, 0.5) and not session.ask(sent_by(key, "vera"), message, 0.5)
        assert (server.constraints().made[-1], server.annotations().made[-1]) == (
            replace(constraint, who="anna"), replace(annotation, who="anna"),
        )  # fmt: skip

        control = MissionControl("r0")
        link = FleetClient(bus("r0"), KEYS, ROBOT, control)
        stack.callback(link.close)
        link.report(Status("standing", "", 7, 0, Pose2(), False), 1)
        eventually(lambda: any(entry.alive for entry in anna.status().robots))
        assert anna.explore("r0").order.by == "anna" and control.report is not None
        assert control.report.order.by == "anna"
        forged = encode(MissionRequest("forged", "r0", MissionKind.STOP, time.time_ns(), "vera"))
        (reply,) = session.ask(sent_by(KEYS.any_mission(), "anna"), forged, 20.0)
        assert not reply.error
        assert (control.report.order.id, control.report.order.by) == ("forged", "anna")

        with Session(bus("anna"), KEYS, "r0", "vera", "anna"):
            pass
        link.report(Status("standing", "", 7, 0, Pose2(), False), 2)
        eventually(lambda: any("r0: the drive by hand is over, by anna since" in one for one in words()))
        assert any(one.startswith("r0: driven by hand, by anna since") for one in words())
        for kind in ("explore", "stop"):
            assert any(one.startswith(f"r0: {kind}, by anna (mission") for one in words()), words()

        with pytest.raises(InvalidValue, match="with this key you are anna, not bob"):
            Fleet(endpoint, "demo", "bob", anna_key)
        with Fleet(endpoint, "demo", keys=vera_key) as vera:
            assert len(vera.constraints()) == 3
            for change in (vera.retire, lambda node: vera.place("attic", node)):
                with pytest.raises(InvalidValue, match="key of a viewer: missions and corrections need"):
                    change(str(NODES[0]))

        shutil.copy(anna_key, tmp_path / "old.key.toml")
        folder.revoke("anna", "left")
        router.reopen(folder.router("s0", [endpoint]))
        with (
            Fleet(endpoint, "demo", keys=tmp_path / "old.key.toml") as former,
            pytest.raises(NotConnected, match=r"or the key of anna was revoked.*mapweave keys list"),
        ):
            former.constraints()
