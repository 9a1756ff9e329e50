"""What tests of drivers share."""

from pathlib import Path

import pytest

from tests.agent.drivers.contract import noise_video


@pytest.fixture(scope="session")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A minute of images for the camera."""
    return noise_video(tmp_path_factory.mktemp("video") / "noise.avi", 60)
