"""The scene of the viewer's tests."""

import mitsuba as mi
import pytest

from mi_refgs.runs.trained_scene import TrainedScene
from tests.scenes.known import known_scene


@pytest.fixture(scope="session")
def scene() -> TrainedScene:
    """A ball of metal and one of glaze, of known materials, under a sky."""
    mi.set_variant("llvm_ad_rgb")
    return known_scene()
