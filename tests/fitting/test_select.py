"""Terms by trial: what is tried when, what decides, what an unused term leaves behind, and resumption."""

from __future__ import annotations

import itertools
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs import methods
from mi_refgs.cli import main
from mi_refgs.data.dataset import Dataset, read_dataset
from mi_refgs.data.view import View
from mi_refgs.errors import InputError
from mi_refgs.fitting import select
from mi_refgs.fitting.runner import Choice, _require_same, begin
from mi_refgs.fitting.select import branched
from mi_refgs.fitting.state import decisions_of
from mi_refgs.fitting.targets import Target
from mi_refgs.fitting.train import Trainer
from mi_refgs.io.images import linear_from_srgb
from mi_refgs.methods.method import LIGHT, Method, Refine
from mi_refgs.methods.window import Window
from mi_refgs.runs.run import Run
from mi_refgs.surfels.ply import read_ply
from tests.helpers import refused, with_pixels
from tests.scenes.highlight import step_to
from tests.scenes.tiny import train_command, write_data

METHOD = """
extends = "base_2dgs"
drop = ["refine"]
iterations = 2_000
checkpoint_every = 4
log_every = 2

[surfels]
degree = { radiance_sh = 0 }

[stage.radiance]
until = 2_000

[select]
holdout = 3

[select.component.degree]
after = 2
trial = 2
change = { surfels = { degree = { radiance_sh = 1 } } }

[select.component.specular]
after = 5
trial = 2
drop = ["stage"]
[select.component.specular.change]
surfels = { attributes = ["radiance_sh", "albedo", "metallic", "roughness"] }
light = { height = 8 }
stage = { deferred = { until = 2_000, dominant = true } }

[select.component.interreflection]
after = 8
trial = 2
needs = ["specular"]
[select.component.interreflection.change]
surfels = { attributes = ["radiance_sh", "albedo", "metallic", "roughness", "indirect_sh"] }
mesh = { extract = { start = 8, until = 20, every = 4 }, resolution = 12 }
"""
SETTINGS = ["iterations=12", "surfels.count=60", "surfels.max_count=60"]


@pytest.fixture
def variant(tmp_path: Path) -> str:
    path = tmp_path / "own.toml"
    path.write_text(METHOD)
    return str(path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_data(tmp_path_factory.mktemp("select") / "ball", views=9, truth=False)


@pytest.fixture
def views(folder: Path) -> Dataset:
    return read_dataset(folder, "train", truth=False)


def judged(monkeypatch: pytest.MonkeyPatch, scores: list[float]) -> list[int]:
    """Let trials end with these PSNRs, the rival's first; returns the views of each trial's fit."""
    rest, seen = iter(scores), []

    def psnr(trainer: Trainer, judges: Dataset) -> float:
        assert {v.name for v in judges.views}.isdisjoint(v.name for v in trainer.data.views)
        seen.append(len(trainer.data.views))
        return next(rest)

    monkeypatch.setattr(select, "validation_psnr", psnr)
    steps = itertools.count()  # all take the same time
    monkeypatch.setattr(select.time, "process_time", lambda: float(next(steps)))
    return seen


def fitted(variant: str, views: Dataset, run: Path, *settings: str) -> Trainer:
    trainer = begin(methods.load(variant, "quick", [*SETTINGS, *settings]), views, Run(run))
    trainer.train()
    return trainer


def test_components_are_kept_if_gain_exceeds_cost(
    variant: str, views: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Degree 1 gains too little; the two others are kept. Validation views are fitted at the end only."""
    seen = judged(monkeypatch, [20.01, 20.0, 25.0, 20.0, 27.0, 25.0])
    trainer = fitted(variant, views, tmp_path / "run")
    assert [(row["component"], row["iteration"], row["stays"]) for row in trainer.fit.decisions] == [
        ("degree", 2, False),
        ("specular", 5, True),
        ("interreflection", 8, True),
    ]
    assert seen == [6] * 6 and len(trainer.data.views) == 9 and trainer.iteration == 12
    assert trainer.method.components == ("specular", "interreflection")
    assert {*trainer.fit.params} >= {LIGHT, "indirect_sh"} and not trainer.fit.occluder.empty
    assert trainer.surfels.sh_degree() == 0


def test_component_without_its_requirement_is_not_tried(
    variant: str, views: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    judged(monkeypatch, [21.0, 20.0, 19.0, 20.0])
    trainer = fitted(variant, views, tmp_path / "run")
    assert [row["stays"] for row in trainer.fit.decisions] == [True, False, False]
    assert trainer.fit.decisions[2]["reason"] == "needs specular"
    assert trainer.surfels.sh_degree() == 1 and LIGHT not in trainer.fit.params
    text = select.table(trainer.fit.decisions)
    assert "left out (needs specular)" in text and "+1.00 dB" in text and len(text.splitlines()) == 4


def test_trials_share_the_images_on_the_device(
    variant: str, views: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All views are uploaded when the fit begins, its own when trials do, all again when they end."""
    judged(monkeypatch, [20.01, 20.0, 25.0, 20.0, 27.0, 25.0])
    uploaded, upload = [], Target.of

    def counted(view: View, background: np.ndarray) -> Target:
        uploaded.append(view.name)
        return upload(view, background)

    monkeypatch.setattr(Target, "of", counted)
    fitted(variant, views, tmp_path / "run")
    assert len(uploaded) == 9 + 6 + 9


def test_required_gain_depends_on_time_and_memory() -> None:
    cheap, dear = select.ComponentTrial(20.0, 5.0, 1.0), select.ComponentTrial(20.5, 25.0, 11.0)
    method = methods.load("auto", "quick")
    assert method.select is not None
    asked = select.required_gain(cheap, dear, method.select)
    doublings = np.log2(25 / 5)
    expected = (
        method.select.gain + doublings * method.select.gain_per_doubling + 10 * method.select.gain_per_mb
    )
    assert asked == pytest.approx(expected)
    assert select.required_gain(dear, cheap, method.select) == pytest.approx(method.select.gain - expected)


def test_component_that_is_off_is_absent(
    variant: str, views: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Parameters and kernel launches of a step."""
    counted = {}
    for name, scores in (("off", [0.0, 9.0] * 2), ("on", [0.0, 9.0] + [9.0, 0.0] * 2)):
        judged(monkeypatch, scores)
        trainer = fitted(variant, views, tmp_path / name)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            trainer.step()
            dr.sync_thread()
            kernels = dr.kernel_history([dr.KernelType.JIT])
        counted[name] = (len(trainer.fit.params), len(kernels))
    assert (counted["off"][0], counted["on"][0]) == (5, 10) and counted["off"][1] < counted["on"][1]


def test_interrupted_selection_resumes(
    variant: str, folder: Path, views: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed after the second decision: the same decisions, and tables of the same shapes."""
    scores = [19.0, 20.0, 25.0, 20.0, 27.0, 25.0]
    judged(monkeypatch, scores)
    straight = fitted(variant, views, tmp_path / "straight")

    class KilledError(Exception):
        pass

    judged(monkeypatch, scores[:4])
    run = Run(tmp_path / "run")
    trainer = begin(methods.load(variant, "quick", SETTINGS), views, run)
    step = trainer.step

    def killed_step() -> None:
        if len(trainer.fit.decisions) == 2 and trainer.iteration == 7:
            raise KilledError
        step()

    monkeypatch.setattr(trainer, "step", killed_step)
    with pytest.raises(KilledError):
        trainer.train()
    judged(monkeypatch, scores[4:])
    resumed = begin(run.method(), views, run)
    assert len(resumed.fit.decisions) == 2 and resumed.method.components == ("specular",)
    resumed.train()
    assert [row["stays"] for row in resumed.fit.decisions] == [row["stays"] for row in straight.fit.decisions]
    for name, tensor in straight.fit.params.items():
        assert tensor.shape == resumed.fit.params[name].shape


def test_a_run_without_the_slow_components_resumes(variant: str, folder: Path, tmp_path: Path) -> None:
    """Its time limit has left some out: the method that is named again has them."""
    run, choice = Run(tmp_path / "run"), Choice(variant, "quick", SETTINGS)
    method = methods.load(variant, "quick", SETTINGS).downscaled(1)
    assert method.select is not None
    first = {"degree": method.select.component["degree"]}
    run.create(replace(method, select=replace(method.select, component=first)), str(folder))
    _require_same(run, run.method(), choice)
    changed = replace(choice, settings=[*SETTINGS, "select.component.degree.trial=3"])
    refused(lambda: _require_same(run, run.method(), changed), "degree.trial", "started with 2")


def test_run_keeps_its_decisions(
    variant: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """On the command line, with real trials: config.toml, decisions.json and the PLY are of one method."""
    run = tmp_path / "run"
    command = train_command(folder, run, Path(variant))
    assert main([*command[: command.index("--set")], "--json", "--set", *SETTINGS]) == 0
    printed = capsys.readouterr()
    assert "refgs: interreflection " in printed.err
    assert json.loads(printed.out)["decisions"] == json.loads((run / "decisions.json").read_text())
    rows = json.loads((run / "decisions.json").read_text())
    method = Run(run).method()
    assert [row["component"] for row in rows] == ["degree", "specular", "interreflection"]
    assert method.components == tuple(row["component"] for row in rows if row["stays"])
    assert {*read_ply(run / "surfels.ply").raw} == {*method.surfels.names}
    assert main(["eval", str(run)]) == 0


def test_decisions_of_version_0_1_are_read() -> None:
    rows = [{"term": "degree", "stays": True}, {"component": "light", "stays": False}]
    state = {"decisions": np.frombuffer(json.dumps(rows).encode(), np.uint8)}
    assert [row["component"] for row in decisions_of(state)] == ["degree", "light"]


# ---------------- going on with another method ----------------


def other(variant: str, *terms: str) -> Method:
    return methods.load(variant, "quick", SETTINGS, terms)


def test_branching_keeps_common_parameters(variant: str, views: Dataset) -> None:
    trainer = step_to(Trainer(other(variant), views), 3)
    before = {name: np.array(tensor.numpy()) for name, tensor in trainer.fit.params.items()}
    rich = branched(trainer, other(variant, "degree", "specular"))
    state = rich.state()
    assert rich.iteration == 3 and {*rich.fit.params} == {*before, "albedo", "metallic", "roughness", LIGHT}
    np.testing.assert_array_equal(rich.fit.params["position"].numpy(), before["position"])
    harmonics = rich.fit.params["radiance_sh"].numpy()
    np.testing.assert_array_equal(harmonics[:, :3], before["radiance_sh"])
    assert np.all(harmonics[:, 3:] == 0)
    moments = state["optimiser/radiance_sh/second"].reshape(-1, 12)
    assert np.all(moments[:, 3:] == 0) and np.any(moments[:, :3] > 0)
    assert np.all(state["optimiser/albedo/second"] == 0) and state["optimiser/albedo/steps"] == 0
    poor = branched(rich, other(variant))
    assert {*poor.fit.params} == {*before}
    np.testing.assert_array_equal(poor.fit.params["radiance_sh"].numpy(), before["radiance_sh"])
    rich.step()
    poor.step()
    np.testing.assert_array_equal(trainer.fit.params["position"].numpy(), before["position"])


def test_capacity_is_filled_at_once_where_the_error_is(variant: str, views: Dataset) -> None:
    """The trial of more surfels begins with them: those with the largest error are split, none is removed."""
    method = other(variant, "degree")
    refine = Refine(densify=Window(0, 9, 9), prune_opacity=0.9)
    small = replace(method, refine=refine, surfels=replace(method.surfels, max_count=60))
    trainer = step_to(Trainer(small, views), 3)
    error = trainer.fit.tables[0].error_sum.numpy()
    assert trainer.surfels.count == 60 and np.count_nonzero(error) > 20
    more = branched(trainer, replace(small, surfels=replace(small.surfels, capacity=4 / 3)))
    assert more.surfels.count == more.method.surfels.most == 80
    position = trainer.surfels.raw["position"].numpy()
    same = (more.surfels.raw["position"].numpy()[:, None] == position).all(-1).any(0)
    assert set(np.flatnonzero(~same)) == set(np.argsort(-error)[:20])
    assert not more.fit.tables[0].error_sum.numpy().any() and trainer.surfels.count == 60


def test_branching_resamples_light(variant: str, views: Dataset) -> None:
    trainer = Trainer(other(variant, "specular"), views)
    trainer.fit.params[LIGHT] = mi.TensorXf(
        np.linspace(-1, 2, 8 * 16 * 3).reshape(8, 16, 3).astype(np.float32)
    )
    method = other(variant, "specular")
    assert method.light is not None
    finer = branched(trainer, replace(method, light=replace(method.light, height=16)))
    assert finer.light is not None and trainer.light is not None
    mean = finer.light.radiance().numpy().mean((0, 1))
    np.testing.assert_allclose(mean, trainer.light.radiance().numpy().mean((0, 1)), rtol=0.02)


# ---------------- what is refused, and what a trial must not spoil ----------------


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("holdout = 3", "holdout = 1", ["select.holdout", "1"]),
        ("after = 2\ntrial = 2", "after = 2\ntrial = 0", ["select.component.degree.trial", "1 or more"]),
        ('needs = ["specular"]', 'needs = ["speculr"]', ["interreflection", "speculr"]),
        ("light = { height = 8 }", "light = { height = 10 }", ["light.height", "10"]),
        ("degree = { radiance_sh = 1 } } }", "degrees = { radiance_sh = 1 } } }", ["degrees"]),
        ("after = 5", "after = 9", ["interreflection", "tried later"]),
        ("after = 5\n", 'after = 5\nneeds = ["specular"]\n', ["specular", "tried later"]),
        ("after = 5\n", 'after = 8\nneeds = ["interreflection"]\n', ["specular", "tried later"]),
    ],
)
def test_selection_that_cannot_be_made_is_refused_at_once(
    old: str, new: str, words: list[str], tmp_path: Path
) -> None:
    path = tmp_path / "own.toml"
    assert old in METHOD
    path.write_text(METHOD.replace(old, new))
    refused(lambda: methods.load(str(path), "quick"), *words)


def test_trials_end_with_fit(
    variant: str, views: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A term that has no room left is not tried, and no step is made beyond the last iteration."""
    judged(monkeypatch, [21.0, 20.0, 19.0, 20.0])
    trainer = fitted(variant, views, tmp_path / "run", "iterations=7")
    assert trainer.iteration == 7
    reasons = [row["reason"] for row in trainer.fit.decisions if row["without"] is None]
    assert reasons == ["needs specular"] and len(trainer.fit.decisions) == 3
    assert Run(tmp_path / "run").method().components == ("degree",)


def test_an_interrupt_during_a_trial_leaves_the_fit_as_it_was_before(
    variant: str, views: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, one_thread: None
) -> None:
    """In either half of the first trial, after two iterations; the resumed fit ends as a straight one."""
    monkeypatch.setattr(select.time, "process_time", itertools.count().__next__)
    straight, step = fitted(variant, views, tmp_path / "straight"), Trainer.step
    left = 0

    def interrupted(trainer: Trainer) -> None:
        nonlocal left
        step(trainer)
        left -= 1
        if not left:
            raise KeyboardInterrupt

    for left in (3, 5):
        run = Run(tmp_path / f"run_{left}")
        monkeypatch.setattr(select.time, "process_time", itertools.count().__next__)
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(Trainer, "step", interrupted)
            begin(methods.load(variant, "quick", SETTINGS), views, run).train()
        resumed = begin(run.method(), views, run)
        assert resumed.iteration == 2 and not resumed.fit.decisions
        monkeypatch.setattr(select.time, "process_time", itertools.count().__next__)
        resumed.train()
        for name, tensor in straight.fit.params.items():
            np.testing.assert_array_equal(tensor.numpy(), resumed.fit.params[name].numpy(), name)


def test_surfels_are_not_tried_without_errors_to_split(variant: str, views: Dataset, tmp_path: Path) -> None:
    """After densification has ended, more surfels would be the same ones."""
    path = tmp_path / "more.toml"
    path.write_text(
        f'extends = "{variant}"\n[refine]\ndensify = {{ start = 0, until = 0, every = 9 }}\n'
        "[select.component.degree.change.surfels]\ncapacity = 2\n"
    )
    trainer = fitted(str(path), views, tmp_path / "run")
    assert "densification has ended" in trainer.fit.decisions[0]["reason"]


def test_nothing_is_tried_on_few_views(variant: str, views: Dataset, tmp_path: Path) -> None:
    few, run = replace(views, views=views.views[:2]), Run(tmp_path / "run")
    said: list[str] = []
    trainer = begin(methods.load(variant, "quick", SETTINGS), few, run, said.append)
    assert trainer.method.select is None and "2 views: too few to hold some out" in " ".join(said)
    trainer.train()
    assert len(trainer.data.views) == 2 and not trainer.fit.decisions
    _require_same(run, run.method(), Choice(variant, "quick", SETTINGS))


def test_rival_that_fails_is_left_out(
    variant: str, views: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*_: Any) -> Trainer:
        raise InputError("refine.prune_opacity: no surfel is left")

    monkeypatch.setattr(select, "branched", failing)
    trainer = fitted(variant, views, tmp_path / "run")
    assert not any(row["stays"] for row in trainer.fit.decisions) and trainer.iteration == 12
    assert "no surfel is left" in trainer.fit.decisions[0]["reason"]


def test_seconds_include_trials(
    variant: str, views: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The seconds of a fit hold the steps of both sides of a trial, and the judges' images."""
    trainer = begin(methods.load(variant, "quick", SETTINGS), views, Run(tmp_path / "run"))
    before = time.perf_counter()
    trainer.train()
    wall = time.perf_counter() - before
    assert 0.5 * wall < trainer.fit.seconds <= wall + 0.1


def test_linear_images_are_scored_as_displayed(
    variant: str, views: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The score of an image in linear radiance is that of the same image as a PNG."""
    trainer = Trainer(other(variant), views)
    encoded = select.validation_psnr(trainer, views)
    linear = tuple(
        with_pixels(replace(v, is_linear_radiance=True), image=linear_from_srgb(v.image))
        for v in (view.load() for view in views.views)
    )
    judges = replace(views, views=linear, is_linear_radiance=False)
    assert select.validation_psnr(trainer, judges) == pytest.approx(encoded, abs=1e-4)
