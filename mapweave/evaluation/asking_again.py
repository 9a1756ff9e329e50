"""A robot asks again while it drives: what it has decided within the first metres after it was put down.

Each image of the asking pass is once the first that a robot sees. From there it asks at every image, as
`agent/global_localization` does, until it knows where it is or has driven `REACH`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from mapweave.agent.global_localization.view_agreement import ViewAgreement
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import RelocalizeAnswer, Whereabouts

REACH = 2.0
"""m of driving."""


@dataclass(frozen=True, eq=False)
class Asked:
    """One question on the way.

    Attributes:
        answer: to it.
        odom_from_robot: by the wheels.
        way: driven until then, m, forward or backward.
        turned: turned until then, rad, either way.
        expected: whether the map shows the place; None if unknown.
    """

    answer: RelocalizeAnswer
    odom_from_robot: Pose2
    way: float
    turned: float
    expected: bool | None


@dataclass(frozen=True)
class LostDrive:
    """What a robot that was put down somewhere came to.

    Attributes:
        expected: whether the map shows where it was put down; None if unknown.
        decided: whether it knows where it is, rightly or not.
        right: whether it is there; None if it has not decided, or the truth is unknown.
    """

    expected: bool | None
    decided: bool
    right: bool | None = None


def trials_of(asked: Sequence[Asked], is_right: Callable[[int, Whereabouts], bool | None]) -> list[LostDrive]:
    """One trial from each question on.

    Args:
        asked: all questions of one pass, in their order.
        is_right: judges a place that is given as the answer to the k-th question.
    """
    return [_trial(asked, first, is_right) for first in range(len(asked))]


def _trial(
    asked: Sequence[Asked], first: int, is_right: Callable[[int, Whereabouts], bool | None]
) -> LostDrive:
    agreement, begin = ViewAgreement(), asked[first]
    for k in range(first, len(asked)):
        now = asked[k]
        if now.way - begin.way > REACH:
            break
        place = agreement.take(now.answer, now.odom_from_robot, now.way, now.turned)
        if place is not None:
            return LostDrive(begin.expected, True, is_right(k, place))
    return LostDrive(begin.expected, False)


def trial_figures(trials: Sequence[LostDrive]) -> dict[str, Any]:
    """Figures by name; None without truth in the recording.

    Returns:
        `recall_within_2m`: of the trials that begin where the map shows the place, those with the right
        place; `decided`: trials with any place; `decided_wrong`, those of them that are wrong;
        `decided_precision`: the share of right ones.
    """
    expected = [trial for trial in trials if trial.expected]
    judged = [trial for trial in trials if trial.decided and trial.right is not None]
    wrong = sum(not trial.right for trial in judged)
    return {
        "recall_within_2m": round(sum(bool(t.right) for t in expected) / len(expected), 4)
        if expected
        else None,
        "decided": sum(trial.decided for trial in trials),
        "decided_wrong": wrong if judged else None,
        "decided_precision": round(1.0 - wrong / len(judged), 4) if judged else None,
    }
