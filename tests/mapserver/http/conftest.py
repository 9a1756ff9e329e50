"""A server for people on a port of its own."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from mapweave.mapserver.http.web import Web
from tests.mapserver.stub_services import StubServices


@pytest.fixture
def services() -> StubServices:
    return StubServices()


@pytest.fixture
def served(services: StubServices) -> Iterator[Web]:
    with Web(("127.0.0.1", 0), services) as served:
        yield served
