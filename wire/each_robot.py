"""Asking many robots for one thing, such as to stop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from mapweave.hybridmap.errors import MapweaveError, NotConnected

S = TypeVar("S")
T = TypeVar("T")

AT_ONCE = 64
"""Robots that are asked at once."""


def each_robot(robots: Sequence[str], ask: Callable[[str], T]) -> list[T]:
    """What each robot says. One that hangs, or answers nonsense, keeps none of the others waiting.

    Args:
        robots: their names.
        ask: asks one; called in several threads.

    Raises:
        NotConnected: some do not answer, or not with what was asked; all others have been asked.
    """
    answers, errors = [], []

    def guarded(robot: str) -> T | MapweaveError:
        try:
            return ask(robot)
        except MapweaveError as error:
            return error

    for robot, answer in zip(robots, in_parallel(robots, guarded), strict=True):
        if isinstance(answer, MapweaveError):
            errors.append(str(answer) if robot in str(answer) else f"{robot}: {answer}")
        else:
            answers.append(answer)
    if errors:
        raise NotConnected("; ".join(errors))
    return answers


def in_parallel(asked: Sequence[S], ask: Callable[[S], T]) -> list[T]:
    """What `ask` returns for each, in order; it is called in several threads."""
    if not asked:
        return []
    with ThreadPoolExecutor(min(len(asked), AT_ONCE), thread_name_prefix="robot") as threads:
        return list(threads.map(ask, asked))
