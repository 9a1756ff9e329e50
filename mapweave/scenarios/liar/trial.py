"""Three honest robots and one that lies: what becomes of the three."""

import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import View
from mapweave.scenarios.liar.lies import WAYS, LieInputs, LyingMessages, Map, bodies, honest, messages
from mapweave.scenarios.liar.served import FleetResult, Served, TrialAnswer, difference

MOVED_M = 0.05
"""More than this moves no node of the others, m."""

Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class ContainmentOutcome:
    """What a lie changed for the other robots.

    Attributes:
        contained: whether they have what they would have without the robot that lies.
        named: what the page says against that; empty if nothing.
        in_status: whether the status of the robots says something against it as well.
        max_pose_difference_m: of their nodes.
        answers_changed: of those to lost robots.
        links_changed: among their maps, gone or come.
        alive: whether the server took all and answers.
        seconds: until all was merged.
        links_joining: between maps of the robot that lies and theirs, at least.
    """

    contained: bool
    named: str
    in_status: bool
    max_pose_difference_m: float
    answers_changed: int
    links_changed: int
    alive: bool
    seconds: float
    links_joining: int = 0

    @property
    def accused(self) -> bool:
        """Whether both the page and the status of the robots name the robot that lies."""
        return bool(self.named) and self.in_status


def changed_answer(before: TrialAnswer, after: TrialAnswer) -> bool:
    """Whether a lost robot is sent less, something else, or something that is not true.

    An answer where there was none is one more if it is right: true views of the fourth robot are no lie.
    """
    if before.found:
        return not after.found or not before.agrees(after) or before.right > after.right
    return after.found and not after.right


def compared(before: FleetResult, after: FleetResult) -> tuple[float, Bools, int]:
    """Greatest difference of a pose, m; which answers differ; links that do."""
    if before.components != after.components:
        moved = float("inf")
    else:
        moved = max(difference(pose, after.poses[node]) for node, pose in before.poses.items())
    changed = [changed_answer(*pair) for pair in zip(before.answers, after.answers, strict=True)]
    return moved, np.array(changed), len(before.links ^ after.links)


class LiarTrial:
    """Three honest robots whose maps are on a server's disk, and a fourth one."""

    def __init__(
        self,
        liar: MapId,
        maps: Mapping[MapId, Map],
        lost: Sequence[tuple[View, Pose2]],
        truth: Mapping[NodeId, Pose2],
        seed: int,
        folder: Path,
    ) -> None:
        """Have the maps of all but one on the disk of a server.

        Args:
            liar: map of the robot that is to lie.
            maps: of all robots, the true one of that robot included.
            lost: views of lost robots, and where they truly are.
            truth: where nodes truly are, in the frame of these.
            seed: draws the lies.
            folder: for stores; stays the caller's.
        """
        self._liar, self._own = liar, maps[liar]
        self._others = {map_id: content for map_id, content in maps.items() if map_id.agent != liar.agent}
        self._queries = lost
        self._truth = {node: pose for node, pose in truth.items() if node.map in self._others}
        self._seed, self._folder = seed, folder
        self._base = folder / "base"
        with Served(self._base / "s0.sqlite") as served:
            served.send({m: messages(m, bodies(content)) for m, content in self._others.items()})
            served.settle()
            self.before = served.seen(self._others, self._queries, self._truth)
        self._left_out = np.zeros(len(lost), np.bool_)
        self.beside, self._left_out = self._outcome(honest)

    def outcome(self, lie: Callable[[LieInputs], LyingMessages]) -> ContainmentOutcome:
        """Add the fourth robot with a lie. Views that an honest one changes the answers to are left out."""
        return self._outcome(lie)[0]

    def _sent(self, lie: Callable[[LieInputs], LyingMessages]) -> LyingMessages:
        rng = np.random.default_rng([self._seed, 0x11E])
        return lie(LieInputs(self._liar, self._own, self._others, rng))

    def _outcome(self, lie: Callable[[LieInputs], LyingMessages]) -> tuple[ContainmentOutcome, Bools]:
        """Add the fourth robot, and compare; and again when the server was started again."""
        sent, folder = self._sent(lie), self._folder / "way"
        shutil.copytree(self._base, folder)
        began = time.monotonic()
        with Served(folder / "s0.sqlite") as served:
            taken = served.settle() and served.send(sent.logs, sent.extra) and served.settle()
            seconds = time.monotonic() - began
            alive = taken and served.alive()
            in_status = served.in_status(self._liar.agent)
            joining = served.links_joining(self._liar.agent)
            first = compared(self.before, served.seen(self._others, self._queries, self._truth))
        with Served(folder / "s0.sqlite") as served:
            alive = served.settle() and alive
            again = compared(self.before, served.seen(self._others, self._queries, self._truth))
            named = served.named(self._liar.agent)
            joining = min(joining, served.links_joining(self._liar.agent))
        shutil.rmtree(folder)
        moved, links = max(first[0], again[0]), max(first[2], again[2])
        changed = (first[1] | again[1]) & ~self._left_out
        contained = alive and moved <= MOVED_M and not changed.any() and not links
        outcome = ContainmentOutcome(
            contained, named, in_status, round(moved, 4), int(changed.sum()), links, alive, round(seconds, 2),
            joining,
        )  # fmt: skip
        return outcome, changed


def row(name: str, one: ContainmentOutcome) -> str:
    """An outcome as a line."""
    figures = (
        f"{one.max_pose_difference_m:.3f} m, {one.answers_changed} answers, {one.links_changed} links changed"
    )
    verdict = "contained" if one.contained else "NOT CONTAINED"
    named = one.named or "not named"
    if one.named and not one.in_status:
        named += " (not in the status)"
    # On a busy machine what is compared may be no whole merge: that is the limit's outcome, not the lie's.
    late = "" if one.alive else ", not all merged in time"
    return f"{name}: {verdict}, {figures}, {one.seconds:.0f} s{late}; {named}"


def totals(outcomes: Mapping[str, ContainmentOutcome]) -> dict[str, Any]:
    """Totals over the ways that can be found out, and which of them were not."""
    listed = {name: one for name, one in outcomes.items() if name in WAYS}
    return {
        "ways": len(listed),
        "contained": sum(one.contained for one in listed.values()),
        "named": sum(one.accused for one in listed.values()),
        "max_pose_difference_m": max((one.max_pose_difference_m for one in listed.values()), default=0.0),
        "answers_changed": sum(one.answers_changed for one in listed.values()),
        "not_contained": [name for name, one in listed.items() if not one.contained],
        "not_named": [name for name, one in listed.items() if not one.accused],
        "late": [name for name, one in listed.items() if not one.alive],
    }
