"""What a shell offers for a value beyond choices and files."""

import argparse
from collections.abc import Callable, Iterable
from typing import Any


def complete_drivers(action: argparse.Action) -> None:
    """Let a shell offer the drivers of robots, and files that name or hold one."""

    def names() -> Iterable[str]:
        from mapweave.agent.drivers.registry import drivers

        return drivers()

    _complete(action, names, ("py", "toml"))


def complete_scenarios(action: argparse.Action) -> None:
    """Let a shell offer the scenarios that come with Mapweave, and the files of others."""

    def names() -> Iterable[str]:
        from mapweave.scenarios.scenario import scenario_names

        return scenario_names()

    _complete(action, names, ("toml",))


def _complete(action: argparse.Action, names: Callable[[], Iterable[str]], endings: tuple[str, ...]) -> None:
    def offered(prefix: str, **_: Any) -> list[str]:
        from argcomplete.completers import FilesCompleter

        return [*names(), *FilesCompleter(endings)(prefix)]

    # argcomplete looks for this attribute, and leaves out what does not continue the prefix.
    setattr(action, "completer", offered)  # noqa: B010 - argparse declares no such attribute
