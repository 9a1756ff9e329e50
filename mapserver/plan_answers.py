"""Answers in the coordinates of a floor plan, and goals that are given in them."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from mapweave.hybridmap.agent_status import FleetStatus, RobotEntry
from mapweave.hybridmap.errors import Refused
from mapweave.hybridmap.floor_plan import PlacedPlan, PlanPart
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.limits import MAX_POSITION
from mapweave.hybridmap.named_nodes import Resolve
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import (
    MAX_WORDS_ASKED,
    NO_COMPONENT,
    REACH,
    RelocalizeAnswer,
    ResolveRequest,
    Whereabouts,
)
from mapweave.mapserver.places import position_of


@dataclass(frozen=True, slots=True)
class WhereaboutsOnPlan(Whereabouts):
    """One place where the robot may be.

    Attributes:
        plan_from_robot: its pose in the frame of the plan, m and rad; None where the plan does not lie.
    """

    plan_from_robot: Pose2 | None = None


@dataclass(frozen=True, slots=True)
class AnswerOnPlan(RelocalizeAnswer):
    """Where a view was taken, also in the frame of a plan."""

    candidates: tuple[WhereaboutsOnPlan, ...]


@dataclass(frozen=True)
class RobotOnPlan(RobotEntry):
    """One robot.

    Attributes:
        plan_from_robot: its pose in the frame of the plan, m and rad; None where the plan does not lie, or if
            it is not known where the robot is.
    """

    plan_from_robot: Pose2 | None = None


@dataclass(frozen=True)
class StatusOnPlan(FleetStatus):
    """All robots, also in the frame of a plan."""

    robots: tuple[RobotOnPlan, ...] = ()


def answer_on_plan(answer: RelocalizeAnswer, plan: PlacedPlan) -> AnswerOnPlan:
    """An answer to a lost robot or a photograph, with the pose of each candidate on a plan."""
    candidates = tuple(
        WhereaboutsOnPlan(**_values(one), plan_from_robot=pose_on_plan(one, plan))
        for one in answer.candidates
    )
    return AnswerOnPlan(answer.certainty, candidates, answer.reason, answer.similar, answer.partial)


def status_on_plan(status: FleetStatus, plan: PlacedPlan) -> StatusOnPlan:
    """The robots of a fleet, with the pose of each on a plan."""
    return StatusOnPlan(
        tuple(RobotOnPlan(**_values(one), plan_from_robot=pose_on_plan(one, plan)) for one in status.robots)
    )


def pose_on_plan(one: Whereabouts | RobotEntry, plan: PlacedPlan) -> Pose2 | None:
    """Where a candidate or a robot is on a plan, m and rad; None where the plan does not lie."""
    pose = one.merged_from_robot
    if pose is None:
        return None
    return plan.pose(one.component, pose.mean if isinstance(pose, PoseGaussian) else pose)


def goal_on_plan(goal: str, plan: PlacedPlan, component: int, resolve: Resolve) -> str:
    """A goal in words, where a position is one on a plan, as a goal of a mission.

    Args:
        goal: `3.1,-2.0`, m, in the frame of the plan; all other words are returned as they are.
        plan: under the merged map.
        component: of the robot that is to go there; `NO_COMPONENT` if that is not known.
        resolve: returns nodes for words.

    Returns:
        The node nearest to the position: the numbers alone do not say in which part of the map they are.

    Raises:
        Refused: the plan does not lie where the robot is, or no node is near.
    """
    position = position_of(goal)
    if position is None:
        return goal
    if component == NO_COMPONENT and len(plan.parts) > 1:
        raise Refused(
            f"plan {plan.name} lies under {len(plan.parts)} parts of the map, and it is not known in which "
            "the robot is: give a node, or the name of a place"
        )
    part = plan.part(None if component == NO_COMPONENT else component)
    x, y = in_merged(position, part)
    (found,) = resolve(ResolveRequest((f"{x:.3f},{y:.3f}",), near_part(part), MAX_POSITION)).found
    nearest = part.plan_from_merged @ found.merged_from_node
    if (away := nearest.distance(Pose2(*position))) > REACH:
        # A person who has given numbers of the plan is not answered in those of the map.
        raise Refused(
            f"nothing is mapped within {REACH:g} m of {goal} on plan {plan.name}: the nearest node is "
            f"{found.node}, {away:.1f} m away at {nearest.x:.1f},{nearest.y:.1f}"
        )
    return str(found.node)


def part_near(plan: PlacedPlan, near: str, resolve: Resolve) -> PlanPart:
    """The part of the map under which positions on a plan are meant.

    Args:
        plan: under the merged map.
        near: a node or place in this part; empty: the one with most pairs of the plan.
        resolve: returns nodes for words.

    Raises:
        InvalidValue: `near` is not there.
        Refused: the plan does not lie there.
    """
    return plan.part(resolve(ResolveRequest((near,))).found[0].component if near else None)


def off_plan(words: Iterable[str], plan: PlacedPlan, near: str, resolve: Resolve) -> list[str]:
    """Words with nodes in the place of positions on a plan; see `goal_on_plan` and `part_near`."""
    component = part_near(plan, near, resolve).component
    return [goal_on_plan(word, plan, component, resolve) for word in words]


def nodes_on_plan(nodes: Sequence[NodeId], plan: PlacedPlan, resolve: Resolve) -> list[Pose2 | None]:
    """Where nodes of the merged map are on a plan, m and rad; None where the plan does not lie.

    Raises:
        InvalidValue: one is not in the merged map.
    """
    found = (
        one
        for begin in range(0, len(nodes), MAX_WORDS_ASKED)
        for one in resolve(ResolveRequest(tuple(map(str, nodes[begin : begin + MAX_WORDS_ASKED])))).found
    )
    return [plan.pose(one.component, one.merged_from_node) for one in found]


def in_merged(position: tuple[float, float], part: PlanPart) -> tuple[float, float]:
    """A position on a plan, m, in the frame of a component."""
    x, y = part.plan_from_merged.inverse().apply(np.array(position)).tolist()
    return x, y


def near_part(part: PlanPart) -> str:
    """A node of a component, as `near` of a question: positions are in its frame."""
    return str(part.pairs[0].node)


def component_of(robot: str, status: FleetStatus) -> int:
    """The component in which a robot is; `NO_COMPONENT` if that is not known."""
    return next((one.component for one in status.robots if one.robot == robot), NO_COMPONENT)


def _values(one: Whereabouts | RobotEntry) -> dict[str, Any]:
    return {field.name: getattr(one, field.name) for field in fields(one)}
