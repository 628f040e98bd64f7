"""What was made last of a scene: several formats of one export ask for the same."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar
from weakref import WeakKeyDictionary

from mi_refgs.runs.trained_scene import TrainedScene

Made = TypeVar("Made")


class LastMade(Generic[Made]):
    """The last result of each scene, as long as the scene is there."""

    def __init__(self) -> None:
        self._made: WeakKeyDictionary[TrainedScene, tuple[tuple[Any, ...], Made]] = WeakKeyDictionary()

    def get(self, scene: TrainedScene, asked: tuple[Any, ...], make: Callable[[], Made]) -> Made:
        """The result for what was asked: the last one if it was that, else what `make` gives."""
        if scene not in self._made or self._made[scene][0] != asked:
            self._made[scene] = asked, make()
        return self._made[scene][1]
