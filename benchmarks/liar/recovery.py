"""What is left of a lie once a person has retired the maps of the robot that lies."""

import shutil
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from mapweave.hybridmap.constraint_subject import RetiredMap
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.manual_constraint import ConstraintRequest, ManualConstraint
from mapweave.merge.explanation.map_standing import map_standings
from mapweave.merge.explanation.twin_maps import TWINS
from mapweave.scenarios.liar.lies import LieInputs, LyingMessages
from mapweave.scenarios.liar.served import KEYS, Served
from mapweave.scenarios.liar.trial import LiarTrial, compared
from mapweave.wire.messages import encode

SAME_M = 0.001
"""A node that has moved by less is where it was, m: poses are solved again."""


@dataclass(frozen=True)
class RecoveryOutcome:
    """What is left of a lie once a person has retired the maps of the robot that lies.

    Attributes:
        recovered: whether the others have what they had without it, node by node.
        twins: what the status says before that of its map and another one that show the same places; empty if
            nothing.
        max_pose_difference_m: of the others' nodes.
        answers_changed: of those to lost robots.
        links_changed: among their maps.
        superseded_otherwise: of their nodes.
    """

    recovered: bool
    twins: str
    max_pose_difference_m: float
    answers_changed: int
    links_changed: int
    superseded_otherwise: int


class RetiringServer(Served):
    """A server whose operator looks at the status, and retires maps."""

    def twins(self, agent: str) -> str:
        """What the status says of two maps that show the same places, one of them of a robot; else empty."""
        standings = map_standings(self._server.merged()).values()
        said = (one.apart for one in standings if TWINS in one.apart)
        return next((words for words in said if f"{agent}." in words.partition(TWINS)[0]), "")

    def retire(self, maps: Iterable[MapId]) -> bool:
        """Have a person retire maps; returns whether all is merged without them in time."""
        for map_id in maps:
            made = ManualConstraint(RetiredMap(map_id), True, "operator", time.time_ns(), "it is a copy")
            replies = self._bus.ask(KEYS.constrain("s0"), encode(ConstraintRequest(made)), 20.0)
            if not replies or replies[0].error:
                return False
        return self.settle()


class RecoveryTrial(LiarTrial):
    """Three honest robots, a fourth one, and a person who retires its maps."""

    def recovery(self, lie: Callable[[LieInputs], LyingMessages]) -> RecoveryOutcome:
        """Add the fourth robot with a lie, retire its maps, and compare; and again after a restart."""
        sent, folder = self._sent(lie), self._folder / "recovery"
        shutil.copytree(self._base, folder)
        with RetiringServer(folder / "s0.sqlite") as served:
            alive = served.settle() and served.send(sent.logs, sent.extra) and served.settle()
            twins = served.twins(self._liar.agent)
            alive = served.retire(sent.logs) and alive
            after = [served.seen(self._others, self._queries, self._truth)]
        with Served(folder / "s0.sqlite") as served:
            alive = served.settle() and alive
            after.append(served.seen(self._others, self._queries, self._truth))
        shutil.rmtree(folder)
        each = [compared(self.before, one) for one in after]
        moved, links = max(one[0] for one in each), max(one[2] for one in each)
        answers = max(int(one[1].sum()) for one in each)
        otherwise = max(len(self.before.superseded ^ one.superseded) for one in after)
        recovered = alive and moved <= SAME_M and not answers and not links and not otherwise
        return RecoveryOutcome(recovered, twins, round(moved, 4), answers, links, otherwise)


def recovery_row(name: str, one: RecoveryOutcome) -> str:
    """What is left of a lie as a line."""
    figures = (
        f"{one.max_pose_difference_m:.3f} m, {one.answers_changed} answers, "
        f"{one.links_changed} links changed, {one.superseded_otherwise} nodes superseded otherwise"
    )
    verdict = "recovered" if one.recovered else "NOT RECOVERED"
    return f"{name}: {verdict}, {figures}; {one.twins or 'joined, or not said to be a twin'}"
