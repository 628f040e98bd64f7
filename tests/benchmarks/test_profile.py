"""Phases of a step: time is booked where it is spent, and nothing is changed."""

import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import pytest

from benchmarks import profile as phases
from mi_refgs import methods
from mi_refgs.data.dataset import read_dataset
from mi_refgs.fitting.train import Trainer
from mi_refgs.kernels import timing
from mi_refgs.render.pipeline import Frame
from mi_refgs.runs.run import Run
from mi_refgs.shade.light.envmap import PrefilteredLight
from mi_refgs.splat import Composited, Footprints
from tests.helpers import refused
from tests.scenes.tiny import SETTINGS

PAUSE = 0.25  # seconds that a planted sleep takes: far more than any phase, on a busy machine too


@pytest.fixture(scope="module")
def trainer(data: Path, method: Path) -> Trainer:
    """Stages up to iterations 30 and 60."""
    until = ["iterations=60", "stage.initial.until=30", "stage.deferred.until=60"]
    return Trainer(methods.load(str(method), "quick", [*SETTINGS, *until]), read_dataset(data, "train"))


class SleepyClock(phases.PhaseClock):
    """Sleeps in the function of one phase."""

    def __init__(self, place: str) -> None:
        super().__init__()
        self.place = place

    def call(self, phase: str, function: Callable[[], Any], arguments: Any = ()) -> Any:
        def slow() -> Any:
            time.sleep(PAUSE)
            return function()

        return super().call(phase, slow if phase == self.place else function, arguments)


@pytest.mark.parametrize("place", ["project", "splat forward", "optimiser"])
def test_time_is_of_innermost_phase(place: str, trainer: Trainer, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each is inside `rest`."""
    monkeypatch.setattr(phases, "WARM_UP", 1)
    monkeypatch.setattr(phases, "PhaseClock", lambda: SleepyClock(place))
    found = {row["phase"]: row for row in phases.phases_of(phases.stepper(trainer, "deferred"), 2)}
    assert found[place]["ms"] > 1e3 * PAUSE
    assert max(row["ms"] for row in found.values() if row["phase"] != place) < 1e3 * PAUSE
    assert sum(row["share"] for row in found.values()) == pytest.approx(1)
    assert found["splat forward"]["launches"] > 0 and set(found) == {*phases.PHASES}


class Notes:
    """A listener that writes down what it hears, in order, and changes nothing."""

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.boundaries: dict[str, Any] = {}

    def call(self, phase: str, function: Callable[[], Any], arguments: Any) -> Any:
        self.calls.append(phase)
        return function()

    def boundary(self, value: Any, phase: str) -> Any:
        self.boundaries[phase] = value
        return value


def test_hooks_enclose_the_phases_of_their_names(trainer: Trainer) -> None:
    notes = Notes()
    with timing.listening(notes):
        phases.stepper(trainer, "deferred")()
    assert sorted(notes.calls) == sorted([*phases.PHASES[:8], "optimiser"])
    footprints, features, _ = notes.boundaries.pop("surfels backward")
    assert isinstance(footprints, Footprints) and dr.width(features[0]) == trainer.surfels.count
    kinds = {"splat backward": Composited, "shade backward": Frame, "prefilter backward": PrefilteredLight}
    assert {name: type(value) for name, value in notes.boundaries.items()} == kinds


def test_hooks_do_nothing_unless_somebody_listens() -> None:
    value, twice = [object()], timing.phase("sort")(lambda x: 2 * x)
    assert timing.boundary(value, "sort") is value and twice(3) == 6
    notes = Notes()
    with timing.listening(notes):
        assert twice(3) == 6 and timing.boundary(value, "project") is value
    assert (notes.calls, notes.boundaries) == (["sort"], {"project": value})
    assert twice(3) == 6 and notes.calls == ["sort"]


def test_the_table_of_a_run(finished: Path, tmp_path: Path) -> None:
    """Nothing is written; what was not fitted has no step."""
    before = {file: file.stat().st_mtime_ns for file in finished.rglob("*")}
    names = {line.split("  ")[0] for line in phases.table(Run(finished), 1).splitlines()}
    assert {"project", "splat forward", "optimiser", "sum"} <= names
    assert {file: file.stat().st_mtime_ns for file in finished.rglob("*")} == before
    shutil.copytree(finished, tmp_path / "run", ignore=shutil.ignore_patterns("checkpoints"))
    refused(lambda: phases.table(Run(tmp_path / "run")), "run: checkpoints: none; measure the run")
