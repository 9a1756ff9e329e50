"""A robot that drives by exact wheels and sees nothing, on roads that it shares by reservations."""

from collections.abc import Callable

from mapweave import NodeId, Pose2
from mapweave.agent.mission import MayIDrive, ServerAnswer, WhichWay
from mapweave.agent.settings import NavigatorSettings
from mapweave.hybridmap.query import ReserveRequest, RouteAnswer
from mapweave.mapserver.reservations import Reservations
from mapweave.mapserver.routes import Router
from synthetic.world import World
from tests.agent.scripted_fleet import NOWHERE, Eyes, Trial, answering, at, here, navigator

BLIND = NavigatorSettings(blind_distance=1e9)


def reserving_robot(
    home: World, router: Router, reservations: Reservations, name: str, start: NodeId, goal: NodeId,
    now: Callable[[], float], facing: float = 0.0,
) -> Trial:  # fmt: skip
    """A robot at one node that wants to another one; `now` is in s, `facing` relative to the node, rad."""
    poses = router.roads.poses
    eyes = Eyes(home, poses[start] @ Pose2(0.0, 0.0, facing))

    def way(question: WhichWay) -> RouteAnswer:
        ends = question.start, question.goal
        return router.route(*ends, question.blocked, (), question.start_from_robot)

    def traffic(question: MayIDrive) -> ServerAnswer:
        request = ReserveRequest(name, question.start, question.start_from_robot, question.route)
        return ServerAnswer(question.number, reservations.ask(request, router, now()))

    fleet = answering(way, lambda: at(here(start, poses[start].inverse() @ eyes.pose)))
    trial = Trial(navigator(eyes, NOWHERE, goal, BLIND), eyes, fleet)
    trial.traffic = traffic
    return trial
