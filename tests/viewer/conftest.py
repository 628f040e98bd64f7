"""The scene of the viewer's tests."""

import pytest

from mi_refgs.runs.trained_scene import TrainedScene
from tests.scenes.known import known_scene


@pytest.fixture(scope="session")
def scene() -> TrainedScene:
    """A ball of metal and one of glaze, of known materials, under a sky."""
    return known_scene()
