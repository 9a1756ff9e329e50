"""Asking many robots for one thing, such as to stop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from mapweave.hybridmap.errors import MapweaveError, NotConnected

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
    if not robots:
        return []
    with ThreadPoolExecutor(min(len(robots), AT_ONCE), thread_name_prefix="robot") as threads:
        asked = [threads.submit(ask, robot) for robot in robots]
    answers, errors = [], []
    for robot, done in zip(robots, asked, strict=True):
        error = done.exception()
        if error is None:
            answers.append(done.result())
        elif isinstance(error, MapweaveError):
            errors.append(str(error) if robot in str(error) else f"{robot}: {error}")
        else:
            raise error
    if errors:
        raise NotConnected("; ".join(errors))
    return answers
