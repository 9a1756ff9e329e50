"""Which robots are there, and asking many of them for one thing, such as to stop."""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from mapweave.hybridmap.errors import MapweaveError, NotConnected
from mapweave.wire.bus import Bus
from mapweave.wire.keys import Keys

S = TypeVar("S")
T = TypeVar("T")

AT_ONCE = 64
"""Robots that are asked at once."""
SETTLING = 0.5
"""s; liveliness of agents that are there is known by then."""


def alive_robots(bus: Bus, keys: Keys) -> list[str]:
    """The robots whose agents are there, found by their liveliness."""
    found: set[str] = set()

    def see(key: str, alive: bool) -> None:
        if alive:
            found.add(keys.parse_agent_alive(key).agent)

    watching = bus.watch(keys.agents_alive(), see)
    try:
        time.sleep(SETTLING)
    finally:
        watching.close()
    return sorted(found)


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
