"""Images whose motion is known."""

import pytest

from tests.vision.photographs import Pictures


@pytest.fixture(scope="session")
def pictures() -> Pictures:
    """Images whose motion is known."""
    return Pictures()
