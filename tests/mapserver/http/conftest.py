"""A server for people on a port of its own."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from mapweave.mapserver.http.web import Web
from tests.mapserver.desks import Desk


@pytest.fixture
def desk() -> Desk:
    return Desk()


@pytest.fixture
def served(desk: Desk) -> Iterator[Web]:
    with Web(("127.0.0.1", 0), desk) as served:
        yield served
