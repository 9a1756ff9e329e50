"""The command line as tests use it: messages of failing commands, and the list of commands."""

import argparse

import pytest

from mapweave.cli import main, parser
from mapweave.commands.examples import parsers_of
from mapweave.exit_status import FAILED

CAMERA = "width = 64\nheight = 48\nfx = 60\nfy = 60\ncx = 32\ncy = 24\nheight_m = 0.3\n"


def complaint(capfd: pytest.CaptureFixture[str], *arguments: object, status: int = FAILED) -> str:
    """The message of a failing command: exactly one line."""
    assert main([str(a) for a in arguments]) == status
    output = capfd.readouterr().err.splitlines()
    assert len(output) == 1, output
    assert output[0].startswith("mapweave: ")
    assert len(output[0]) < 400
    return output[0]


def parsers() -> dict[str, argparse.ArgumentParser]:
    """The parser of every command, by its words: `map`, `map show` ..."""
    return parsers_of(parser())


def commands(runnable: bool = False) -> list[str]:
    """Every command that the parser has, as words.

    Args:
        runnable: only those that do something; not `map`, which has actions of its own.
    """
    words = list(parsers())
    return [w for w in words if not (runnable and any(other.startswith(f"{w} ") for other in words))]
