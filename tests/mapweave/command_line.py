"""The command line as tests use it: what a command that fails says."""

from __future__ import annotations

import pytest

from mapweave.cli import main

CAMERA = "width = 64\nheight = 48\nfx = 60\nfy = 60\ncx = 32\ncy = 24\nheight_m = 0.3\n"


def complaint(capfd: pytest.CaptureFixture[str], *arguments: object) -> str:
    """What a command that fails says: exactly one line."""
    assert main([str(a) for a in arguments]) == 1
    said = capfd.readouterr().err.splitlines()
    assert len(said) == 1, said
    assert said[0].startswith("mapweave: ")
    assert len(said[0]) < 400
    return said[0]
