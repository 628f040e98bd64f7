"""`refgs profile`: time is booked where it is spent, advice follows from numbers, and nothing is changed."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs import methods
from mi_refgs.cli import main
from mi_refgs.data import dataset as data_module
from mi_refgs.fitting.train import Trainer
from mi_refgs.kernels import timing
from mi_refgs.methods.method import Method
from mi_refgs.profiling import phases
from mi_refgs.profiling.advice import advice
from mi_refgs.profiling.profile import (
    Profile,
    StageProfile,
    Work,
    aovs_of,
    count_work,
    profile_frame,
    profile_stage,
)
from mi_refgs.render.pipeline import Frame
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.envmap import PrefilteredLight
from mi_refgs.shade.light.learnt import Learnt
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera, Composited, Footprints
from tests.helpers import refused
from tests.scenes.tiny import SETTINGS, SIZE, write_open_data

PAUSE = 0.25
"""Seconds that a planted sleep takes: far more than any stage of the tiny scene, on a busy machine too."""


def new_trainer(data: Path, method: Path, *settings: str) -> Trainer:
    """Stages up to iterations 30 and 60."""
    until = ["iterations=60", "stage.initial.until=30", "stage.deferred.until=60"]
    resolved = methods.load(str(method), "quick", [*SETTINGS, *until, *settings])
    return Trainer(resolved, data_module.read_dataset(data, "train"))


@pytest.fixture
def trainer(data: Path, method: Path) -> Trainer:
    """A trainer before its first step."""
    return new_trainer(data, method)


@pytest.fixture(scope="module")
def used_trainer(data: Path, method: Path) -> Trainer:
    """One for tests of where time goes, whatever steps went before."""
    mi.set_variant("llvm_ad_rgb")
    return new_trainer(data, method)


# ---------- Phases ----------


class Sleepy(dr.CustomOp):
    """Identity whose adjoint sleeps."""

    def eval(self, value: Any) -> Any:
        return type(value)(value)

    def backward(self) -> None:
        time.sleep(PAUSE)
        self.set_grad_in("value", self.grad_out())

    def name(self) -> str:
        return "sleepy"


class SleepyClock(phases.PhaseClock):
    """Sleeps in one phase: forward in its function, backward on either side of a boundary."""

    def __init__(self, place: str, side: str) -> None:
        super().__init__()
        self.place, self.side = place, side

    def call(self, phase: str, function: Callable[[], Any], arguments: Any = ()) -> Any:
        def slow() -> Any:
            time.sleep(PAUSE)
            return function()

        return super().call(phase, slow if (phase, self.side) == (self.place, "in") else function, arguments)

    def boundary(self, value: Any, phase: str) -> Any:
        def slow(side: str, value: Any) -> Any:
            if (phase, side) != (self.place, self.side):
                return value
            chosen = [True]  # one array only: the pause is taken once
            return phases._map(
                value, lambda x: dr.custom(Sleepy, x) if dr.grad_enabled(x) and chosen and chosen.pop() else x
            )

        return slow("after", super().boundary(slow("before", value), phase))


@pytest.mark.parametrize(
    ("place", "side", "phase", "at"),
    [
        ("surfels backward", "after", "splat backward", "initial"),
        ("surfels backward", "after", "splat backward", "deferred"),
        ("splat backward", "before", "splat backward", "deferred"),
        ("surfels backward", "before", "surfels backward", "deferred"),
        ("prefilter backward", "before", "prefilter backward", "initial"),
        ("prefilter backward", "before", "prefilter backward", "deferred"),
        ("shade backward", "before", "shade backward", "deferred"),
        ("shade backward", "after", "loss backward", "deferred"),
        *[(name, "in", name, "deferred") for name in phases.PHASES[:7] if name != "loss backward"],
        ("optimiser", "in", "optimiser", "deferred"),
    ],
)
def test_time_counts_for_innermost_phase(
    place: str, side: str, phase: str, at: str, used_trainer: Trainer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(phases, "WARM_UP", 1)
    monkeypatch.setattr(phases, "PhaseClock", lambda: SleepyClock(place, side))
    used_trainer.fit.iteration = {"initial": 5, "deferred": 35}[at]
    found = phases.phase_times(used_trainer.step, 3)
    assert found[phase] > 1e3 * PAUSE
    assert max(ms for other, ms in found.items() if other != phase) < 1e3 * PAUSE


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
    trainer.fit.iteration = 35
    with timing.listening(notes):
        trainer.step()
    assert sorted(notes.calls) == sorted([*phases.PHASES[:8], "optimiser"])
    assert notes.calls[-3:] == ["ssim forward", "loss backward", "optimiser"]
    assert notes.calls.index("splat forward") < notes.calls.index("shade forward")  # at pixels
    footprints, features = notes.boundaries.pop("surfels backward")
    assert isinstance(footprints, Footprints) and dr.width(features[0]) == trainer.surfels.count
    kinds = {"splat backward": Composited, "shade backward": Frame, "prefilter backward": PrefilteredLight}
    assert {name: type(value) for name, value in notes.boundaries.items()} == kinds


def test_hooks_do_nothing_unless_somebody_listens() -> None:
    value = [object()]
    assert timing.boundary(value, "sort") is value
    twice = timing.phase("sort")(lambda x: 2 * x)
    assert twice(3) == 6
    notes = Notes()
    with timing.listening(notes):
        assert twice(3) == 6 and timing.boundary(value, "project") is value
    assert (notes.calls, notes.boundaries) == (["sort"], {"project": value})
    assert twice(3) == 6 and notes.calls == ["sort"]


def test_profiling_leaves_nothing_behind(trainer: Trainer) -> None:
    method = trainer.method
    profile_stage(trainer, "initial", 1)
    assert timing._listener is None
    assert trainer.iteration == 0 and trainer.method is method


def test_step_with_clock_is_same_step(
    data: Path, method: Path, one_thread: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Boundaries are identities: the table moves as in plain steps."""
    monkeypatch.setattr(phases, "WARM_UP", 0)
    tables = []
    for timed in (False, True):
        resolved = methods.load(str(method), "quick", [*SETTINGS, "iterations=40"])
        trainer = Trainer(resolved, data_module.read_dataset(data, "train"))
        trainer.fit.iteration = 1
        if timed:
            phases.phase_times(trainer.step, 1)
        else:
            trainer.step()
        tables.append(trainer.surfels.to_numpy())
    for name, values in tables[0].items():
        assert np.allclose(values, tables[1][name], rtol=1e-5, atol=1e-6), name


# ---------- The command ----------


def files(folder: Path) -> dict[str, int]:
    return {str(path): path.stat().st_mtime_ns for path in folder.rglob("*")}


def test_profile_of_run_has_every_number(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = files(finished)
    capsys.readouterr()
    assert main(["profile", str(finished), "--steps", "2", "--size", "16", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert files(finished) == before  # nothing is written
    (stage,) = found["stages"]
    assert stage["name"] == "deferred" and stage["misses"] >= 0 and stage["launches"] > 10
    assert list(stage["phases_ms"]) == list(phases.PHASES)
    assert 0 < stage["step_ms"] and all(ms >= 0 for ms in stage["phases_ms"].values())
    work = found["work"]
    assert work["views"] == 3 and work["pixels"] == SIZE**2 and 0 < work["covered"] <= SIZE**2
    assert 0 < work["contributing"] < work["evaluated"] and 0 < work["share"] < 1
    assert work["share"] == pytest.approx(work["contributing"] / work["evaluated"])
    assert found["allocated"] > 1e5 and found["threads"] >= 1 and isinstance(found["advice"], list)
    (frame,) = found["frames"]
    assert (frame["width"], frame["height"]) == (16, 16) and frame["frame_ms"] > 0
    traced = [] if TrainedScene.read(finished).mesh is None else ["visibility"]
    materials = ["albedo", "metallic", "roughness"]
    assert {*frame["aovs_ms"]} == {*materials, *traced, "normal", "depth", "diffuse", "specular", "indirect"}


def test_image_and_each_aov_are_timed_in_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    """In turns; kernels that are compiled count for nothing, and an AOV by its difference in a round."""
    asked: list[tuple[str, ...]] = []
    clock = [0.0]

    def draw(camera: Camera, names: Collection[str]) -> Frame:
        asked.append(tuple(names))
        compiling, slow_round = 9.0 * (len(asked) < 4), 0.5 * (len(asked) > 12)
        clock[0] += 0.02 + 0.04 * ("depth" in names) + compiling + slow_round
        return Frame(mi.Float(1), None, None, mi.Color3f(1))

    monkeypatch.setattr("time.perf_counter", lambda: clock[0])
    camera = Camera.from_pose(8, 6, -8.0, -8.0, 4.0, 3.0, np.eye(4))
    found = profile_frame(draw, ["albedo", "depth"], camera, 3)
    assert asked == [(), ("albedo",), ("depth",)] * 5 and (found.width, found.height) == (8, 6)
    assert found.frame_ms == pytest.approx(20)
    assert found.aovs_ms == pytest.approx({"albedo": 0, "depth": 40}, abs=1e-6)


def test_aovs_of_frame_are_those_that_it_has(finished: Path) -> None:
    scene = TrainedScene.read(finished)
    camera = Camera.from_pose(8, 6, -8.0, -8.0, 4.0, 3.0, np.eye(4))
    plain = replace(scene, shading=Shading(reflectance="radiance"), mesh=None)
    frame = plain.renderer(aovs=True)(camera)
    assert aovs_of(frame) == ["albedo", "metallic", "roughness", "normal", "depth", "diffuse"]


def test_profile_of_data_set_has_every_stage(
    data: Path, method: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--method", str(method), "--preset", "quick", "--steps", "1", "--set", *SETTINGS]
    assert main(["profile", str(data), *options]) == 0
    said = capsys.readouterr().out
    head = said.splitlines()[0].split()
    assert head[-2:] == ["initial", "deferred"]
    for part in (*phases.PHASES, "undisturbed step", "kernel launches", "that contribute"):
        assert part in said


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("{run} --steps 0", ["--steps", "give 1 to"]),
        ("{run} --size 0", ["--size", "give 1 to"]),
        ("{run} --preset quick", ["--preset", "drop"]),
        ("{run} --set loss.ssim=0", ["--set", "drop"]),
        ("{run} --data nowhere", ["nowhere", "no such folder"]),
        ("{data} --data {data}", ["drop --data"]),
        ("{data} --size 16", ["drop --size"]),
        ("{empty}", ["transforms_train.json"]),
        ("{empty}/none", ["no such folder"]),
    ],
)
def test_bad_requests_are_refused(
    arguments: str, words: list[str], finished: Path, data: Path, tmp_path: Path
) -> None:
    refused(["profile", *arguments.format(run=finished, data=data, empty=tmp_path).split()], *words)


def test_run_without_checkpoints_has_images(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = Path(shutil.copytree(finished, tmp_path / "run"))
    shutil.rmtree(run / "checkpoints")
    capsys.readouterr()
    assert main(["profile", str(run), "--size", "12", "16"]) == 0
    head, *rows = capsys.readouterr().out.splitlines()
    assert head.split()[-2:] == ["12x12", "16x16"] and "training" not in head
    assert rows[0].split()[:3] == ["radiance", "and", "alpha"] and any("+ depth" in row for row in rows)
    (run / "model.json").unlink()
    refused(["profile", run], "checkpoints: none yet")


# ---------- Counts and advice ----------


def test_work_is_counted_over_views(trainer: Trainer) -> None:
    work = count_work(trainer)
    assert (work.views, work.surfels, work.pixels) == (3, 80, SIZE**2)
    hidden = trainer.surfels.to_numpy()
    hidden["opacity"][:20] = -20.0
    for name, values in hidden.items():
        trainer.fit.params[name] = type(trainer.fit.params[name])(values)
    fewer = count_work(trainer)
    assert fewer.unseen_share >= 0.25 > work.unseen_share
    assert fewer.contributing < work.contributing


def test_work_includes_the_background(method: Path, tmp_path: Path) -> None:
    """Its surfels cost what those of the object do."""
    open_method = tmp_path / "open.toml"
    open_method.write_text(method.read_text() + "[surroundings]\n")
    trainer = new_trainer(write_open_data(tmp_path / "data"), open_method, "surroundings.count=60")
    both = count_work(trainer)
    assert both.surfels == 140
    del trainer.fit.tables[1]
    alone = count_work(trainer)
    assert alone.surfels == 80 and alone.pairs < both.pairs and alone.contributing < both.contributing


def quiet_profile() -> Profile:
    """Return a profile without advice."""
    stage = StageProfile("deferred", 10.0, 60, 0, dict.fromkeys(phases.PHASES, 1.0))
    work = Work(8, 1000, 4e4, 16, 2e4, 5e4, 8e5, 4e5, 0.1, 0.1, 0.1, 2.0, 40.0)
    return Profile((stage,), work, 2**20, 2**34)


def a_method() -> Method:
    return replace(methods.load("base_2dgs", "quick"), light=Learnt(height=64))


@pytest.mark.parametrize(
    ("work", "ms", "part"),
    [
        ({"unseen_share": 0.5}, {}, "50% of the surfels contribute in none of 8 views"),
        ({"single_share": 0.6}, {}, "60% of the surfels that are seen never cover more than one pixel"),
        ({"contributing": 8e4, "faint_share": 0.5}, {}, "Only 10% of the evaluated"),
        ({"contributing": 8e4, "aspect": 9.0}, {}, "9 times as long as wide"),
        ({"contributing": 8e4, "footprint": 5.0}, {}, "5.0 pixels on average"),
        ({}, {"prefilter forward": 5.0}, "light.height=32"),
        ({}, {"sort": 3.0}, "50 tiles per surfel"),
        ({}, {"ssim forward": 5.0}, "loss.ssim=0"),
        ({}, {"optimiser": 9.0}, "the optimiser takes"),
    ],
)
def test_each_rule_follows_from_its_number(work: dict[str, Any], ms: dict[str, float], part: str) -> None:
    base = quiet_profile()
    stage = replace(base.stages[0], phases_ms=base.stages[0].phases_ms | ms)
    found = replace(base, stages=(stage,), work=replace(base.work, **work))
    said = advice(found, a_method())
    assert len(said) == 1 and part in said[0]


def test_advice_on_compiling_and_crowding() -> None:
    base = quiet_profile()
    assert advice(base, a_method()) == []
    found = replace(base, stages=(replace(base.stages[0], misses=3),), allocated=2**34)
    compiled, crowded = advice(found, a_method())
    assert "3 kernels were compiled" in compiled and "16.0 of the machine's 16.0 GiB" in crowded
