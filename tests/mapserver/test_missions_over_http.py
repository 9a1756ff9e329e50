"""Missions over HTTP: what is taken and refused, and what the JSON says."""

import http.client

import pytest

from mapweave.hybridmap.agent_status import Status
from mapweave.hybridmap.errors import InvalidValue, NotConnected
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.portal import PortalMeans, PortalStop, PortalWait
from mapweave.hybridmap.pose import Pose2
from mapweave.mapserver.http.request_site import is_loopback
from mapweave.mapserver.http.web import Web
from mapweave.storage.map_file import unpack_map_file
from tests.mapserver.house import House, ask

THERE = NodeId("r0", 1, 3)
LIFT = PortalStop("east lift", PortalMeans.LIFT, THERE, NodeId("r1", 1, 5), "2")


def test_robots_are_sent_stopped_and_seen(house: House):
    _, control = house.robot()
    with Web(("127.0.0.1", 0), house.server) as web:
        (robot,) = ask(web, "GET", "/robots")[1]["robots"]
        assert (robot["robot"], robot["alive"]) == ("r0", True)
        assert robot["status"]["status"]["doing"] == "standing"
        assert robot["merged_from_robot"] == pytest.approx([0.0, 0.1, 0.0], abs=0.1)
        status, report = ask(web, "POST", f"/robots/r0/go?goal={THERE}&by=anna&id=first")
        assert (status, report["state"]) == (200, "running")
        assert (report["order"]["node"], report["order"]["by"]) == (str(THERE), "anna")
        assert ask(web, "POST", f"/robots/r0/go?goal={THERE}&id=first")[1] == report, "twice is once"
        assert ask(web, "POST", "/robots/r0/explore")[1]["order"]["kind"] == "explore"
        (stopped,) = ask(web, "POST", "/stop")[1]["reports"]
        assert control.report is not None and control.report.order.id == stopped["order"]["id"]
        kinds = [report["order"]["kind"] for report in ask(web, "GET", "/missions")[1]["reports"]]
        assert kinds == ["go", "explore", "stop"]
        connection = http.client.HTTPConnection("127.0.0.1", web.port, timeout=20)
        connection.request("GET", "/map")
        assert len(unpack_map_file(connection.getresponse().read()).poses) == 7
        connection.close()


def test_a_long_goal_is_refused_and_not_cut(house: House):
    """Of the position 0,99 with many zeros the second number was cut to 0, and the robot drove."""
    _, control = house.robot()
    far = f"0.{'0' * 59},0099"
    with Web(("127.0.0.1", 0), house.server) as web:
        for query in (f"goal={far}", f"goal={THERE}&via={far}"):
            status, answer = ask(web, "POST", f"/robots/r0/go?{query}")
            assert status == 400 and "is longer than 64 characters" in answer["error"]
    with pytest.raises(InvalidValue, match="is longer than 64 characters"):
        house.person.go("r0", far)
    assert control.report is None


def test_a_robot_at_a_portal_takes_it_from_any_client_that_it_was_taken_through(house: House):
    link, control = house.robot()
    asking = Status(
        "waiting at a portal", "take me up", 7, 0, Pose2(), False, "goto", portal=PortalWait(LIFT)
    )
    with pytest.raises(InvalidValue, match="r0 does not wait at a portal"):
        house.person.portal_done("r0")
    with pytest.raises(NotConnected, match="robot r9 does not answer"):
        house.person.portal_done("r9")
    with Web(("127.0.0.1", 0), house.server) as web:
        for say in (
            lambda: house.person.portal_done("r0"),
            lambda: ask(web, "POST", "/robots/r0/portal-done")[1]["said"],
        ):
            house.person.go("r0", str(THERE))
            control.next(True, 0.0, None)
            control.follow(asking)
            link.report(asking, 2)
            assert say() == "r0 was taken through lift 'east lift': it looks where it is"
            assert control.taken_through() and not control.taken_through()
        status, refused = ask(web, "POST", "/robots/r0/portal-done")
        assert (status, refused["error"]) == (400, "r0 looks where it is already")
        (robot,) = ask(web, "GET", "/robots")[1]["robots"]
        assert robot["status"]["status"]["portal"]["portal"]["name"] == "east lift"
        assert ask(web, "POST", "/robots/r9/portal-done")[1]["error"] == "r9 does not answer"


@pytest.mark.parametrize(
    ("path", "status", "reason"),
    [
        ("/robots/r0/go?goal=r9.1.1", 400, "goal r9.1.1 is not in the merged map"),
        (f"/robots/r0/go?goal={THERE}&via=r9.1.1", 400, "via point r9.1.1 is not in the merged map"),
        (f"/robots/r0/go?goal={THERE}&via=nowhere", 400, "via point 'nowhere' is no place of this map"),
        ("/robots/r0/go", 400, "give goal"),
        # A misspelt place on the way was passed over without a word.
        (
            f"/robots/r0/go?goal={THERE}&vai=kitchen",
            400,
            "'vai': there is no such value; give goal, via, by, id",
        ),
        (f"/robots/r0/go?goal={THERE}&goal=home", 400, "goal is given twice"),
        ("/robots/r0/stop?goal=r0.1.1", 400, "takes no goal"),
        ("/robots/r7/explore", 400, "no robot r7"),
        ("/robots/R%200/stop", 400, "name"),
        ("/robots/r0/fly", 404, "there is no mission 'fly'"),
        ("/robots/r0/stop?id=No%20Name", 400, "name"),
        ("/robots/r0/explore?by=a%0Ab", 400, "text must be one printable line"),
        (
            f"/robots/r0/go?goal={THERE}{17 * '&via=r0.1.2'}",
            400,
            "a mission passes at most 16 places, not 17",
        ),
    ],
)
def test_nonsense_is_refused(house: House, path: str, status: int, reason: str):
    _, control = house.robot()
    with Web(("127.0.0.1", 0), house.server) as web:
        got, answer = ask(web, "POST", path)
        assert got == status and reason in answer["error"]
        assert ask(web, "GET", "/robots/r0/stop")[0] == 405
        assert control.report is None and ask(web, "GET", "/missions")[1]["reports"] == []
        # It has spoiled nothing: the robot can be stopped.
        assert ask(web, "POST", "/robots/r0/stop")[0] == 200
        assert len(house.person.missions()) == 1
    assert control.report is not None


def test_robots_are_moved_from_this_machine_and_its_own_pages_alone(house: House):
    _, control = house.robot()
    with Web(("127.0.0.1", 0), house.server) as web:
        assert ask(web, "POST", "/robots/r0/stop", Origin="http://evil.example")[0] == 403
        # A proxy on this machine names the client for which it asks.
        forwarded = {"X-Forwarded-For": "10.0.0.1"}
        for path in ("/robots/r0/stop", "/stop"):
            status, answer = ask(web, "POST", path, **forwarded)
            assert status == 403 and "server's own machine alone" in answer["error"]
        assert control.report is None and ask(web, "GET", "/robots", **forwarded)[0] == 200
        assert ask(web, "POST", "/robots/r0/stop")[0] == 200
    hosts = ("127.0.0.1", "::1", "10.0.0.1", "localhost", "")
    assert [is_loopback(host) for host in hosts] == [True, True, False, False, False]
