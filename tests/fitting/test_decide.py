"""Decisions by trial: what is tried when, what decides, forks of a fit, interrupts and resumption."""

import json
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from mi_refgs import methods
from mi_refgs.cli import main
from mi_refgs.data.dataset import Dataset, read_dataset
from mi_refgs.errors import InputError
from mi_refgs.fitting import decide
from mi_refgs.fitting.decide import Decision, as_decided, differences, fork
from mi_refgs.fitting.events.densify import fill
from mi_refgs.fitting.runner import Choice, Settings, begin, chosen
from mi_refgs.fitting.train import Trainer
from mi_refgs.methods.method import LIGHT, Method
from mi_refgs.runs.run import Run
from mi_refgs.surfels.ply import read_ply
from tests.scenes.highlight import step_to, without
from tests.scenes.tiny import METHOD, train_command, write_data

ALONE = """
iterations = 2_000
surfels = { attributes = ["radiance_sh"], degree = { radiance_sh = 2 } }
stage.radiance = { until = 2_000, at = "surfel", reflectance = "radiance" }
"""
SURFELS = """
[event.densify]
when = { start = 0, until = 12, every = 100 }
[event.more_surfels]
doubling = [{ after = 5, trial = 2 }, { after = 8, trial = 2 }]
"""
SETTINGS = ["iterations=12", "surfels.count=60", "surfels.max_count=60", "log_every=2"]


@pytest.fixture(autouse=True)
def every_third(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three of nine views validate."""
    monkeypatch.setattr(decide, "HOLDOUT", 3)


@pytest.fixture
def file(tmp_path: Path) -> str:
    """A method with light and materials that tries colour alone, then more surfels."""
    (tmp_path / "alone.toml").write_text(ALONE + SURFELS)
    tried = f'[event.colour_alone]\nmethod = "{tmp_path / "alone.toml"}"\nafter = 2\ntrial = 2\n'
    (tmp_path / "own.toml").write_text(METHOD + SURFELS + tried)
    return str(tmp_path / "own.toml")


@pytest.fixture
def method(file: str) -> Method:
    return methods.load(file, "quick", SETTINGS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_data(tmp_path_factory.mktemp("decide") / "ball", views=9, truth=False)


@pytest.fixture
def views(folder: Path) -> Dataset:
    return read_dataset(folder, "train", truth=False)


def judged(monkeypatch: pytest.MonkeyPatch, *gains: float) -> list[int]:
    """Let the rivals of trials gain so much; returns the number of views of each trial's fits."""
    scores, seen = [x for gain in gains for x in (20 + gain, 20.0)], list[int]()

    def psnr(trainer: Trainer) -> float:
        assert trainer.validation is not None
        names = {view.name for view in trainer.validation.views}
        assert len(names) == 3 and names.isdisjoint(view.name for view in trainer.data.views)
        seen.append(len(trainer.data.views))
        return scores.pop(0)

    monkeypatch.setattr(decide, "validation_psnr", psnr)
    return seen


def fitted(method: Method, views: Dataset, run: Path) -> Trainer:
    trainer = begin(method, views, Run(run))
    trainer.train()
    return trainer


def summary(trainer: Trainer) -> list[tuple[str, int, bool]]:
    return [(row["component"], row["iteration"], row["stays"]) for row in trainer.fit.decisions]


@pytest.mark.parametrize(
    ("gains", "stays", "capacity"),
    [
        ([0.01, 0.14], [True, False], 1),
        ([-0.09, 0.16, 0.16], [True, True, True], 4),
        ([-0.11, 0.16, 0.14], [False, True, False], 2),
    ],
)
def test_components_stay_by_their_gain_alone(
    gains: list[float],
    stays: list[bool],
    capacity: int,
    method: Method,
    views: Dataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Validation views are fitted at the end only, when all is decided."""
    seen = judged(monkeypatch, *gains)
    trainer = fitted(method, views, tmp_path / "run")
    tried = [("colour_alone", 2), ("surfels_2x", 5), ("surfels_4x", 8)]
    assert summary(trainer) == [(*one, stay) for one, stay in zip(tried, stays, strict=False)]
    assert seen == [6] * 2 * len(stays)
    assert len(trainer.data.views) == 9 and trainer.validation is None and trainer.iteration == 12
    assert trainer.method.surfels.capacity == capacity and trainer.surfels.count <= 60 * capacity
    alone = stays[0]
    assert (LIGHT not in trainer.fit.params) == (trainer.method.light is None) == alone
    assert trainer.surfels.sh_degree() == (2 if alone else 1)
    assert all("dB required" in row["reason"] for row in trainer.fit.decisions)
    written = Run(tmp_path / "run").method()
    assert written == trainer.method and written.name == method.name


def test_images_are_those_of_the_method_that_was_chosen(
    file: str, views: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The chosen one has no coarse images, and names its file as it is beside the method's."""
    text = Path(file).read_text().replace(f"{tmp_path}/", "")
    Path(file).write_text(f"{text}[data]\ncoarse = [{{ until = 2_000, block = 2 }}]\n")
    judged(monkeypatch, 0.01, 0.0)
    method = methods.load(file, "quick", SETTINGS)
    trainer, same = begin(method, views, Run(tmp_path / "run")), list[bool]()
    trainer.train(lambda one: same.append(one.targets.options == one.method.data))
    assert method.data.coarse and not trainer.method.data.coarse and same == [True] * 8


def test_what_comes_too_late_holds_no_views_out(
    file: str, views: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    judged(monkeypatch, -0.2)
    warn, run = Mock(), Run(tmp_path / "run")
    trainer = begin(methods.load(file, "quick", [*SETTINGS, "iterations=5"]), views, run, warn=warn)
    trainer.train()
    assert summary(trainer) == [("colour_alone", 2, False)] and len(trainer.data.views) == 9
    assert [call.args[0].partition(":")[0] for call in warn.mock_calls][-2:] == ["surfels_2x", "surfels_4x"]


@pytest.mark.parametrize("given", [{"data": {"downscale": 2}}, [" data.downscale=2"], ["data={downscale=2}"]])
def test_settings_of_images_are_those_of_the_first_read(given: Settings, tmp_path: Path) -> None:
    method, views = chosen(write_data(tmp_path / "ball", truth=False), Choice(None, "20:60", given))
    assert method.data.downscale == views.downscale == 2


def test_a_method_is_replaced_with_its_settings(file: str, method: Method) -> None:
    """Those of tables that the other method has not are left out; what Python changed is kept."""
    given = [
        "loss.ssim=0.3",
        "loss.half_metal=0.1",
        "light.height=16",
        "event.mesh.resolution=9",
        "stage.deferred.traced_bounces=1",
    ]
    own = methods.load(file, "quick", [*SETTINGS, *given])
    own = replace(own, data=replace(own.data, downscale=3), seed=5)
    (decision,) = (x for name, x in own.event.items() if name == "colour_alone")
    assert isinstance(decision, Decision)
    found = decision.chosen(own, "colour_alone")
    assert found.loss["ssim"].weight == 0.3 and found.light is None and not found.has_mesh
    assert (found.seed, found.data.downscale, found.iterations, found.name) == (5, 3, 12, "own")
    assert {*found.event} == {"densify", "more_surfels"} and found.surfels.max_count == 60
    rows = [{"component": name, "stays": True} for name in ("colour_alone", "surfels_2x", "metal")]
    decided = as_decided(own, rows)
    assert decided == replace(found, surfels=replace(found.surfels, capacity=2.0))
    assert as_decided(decided, rows) == decided
    with pytest.raises(InputError, match="light: it is given"):
        decision.chosen(methods.load(file, "quick", [*SETTINGS, "light.turntable=true"]), "colour_alone")


def test_a_fork_keeps_common_parameters(method: Method, views: Dataset) -> None:
    trainer = step_to(Trainer(method, views), 4)  # of which the last has SH
    before = {name: np.array(tensor.numpy()) for name, tensor in trainer.fit.params.items()}
    history = trainer.fit.arrays()["optimiser/radiance_sh/second"].reshape(-1, 12)
    poor = fork(trainer, as_decided(method, [{"component": "colour_alone", "stays": True}]))
    assert {*poor.fit.params} == {"position", "rotation", "scale", "opacity", "radiance_sh"} and not poor.run
    np.testing.assert_array_equal(poor.fit.params["position"].numpy(), before["position"])
    harmonics = poor.fit.params["radiance_sh"].numpy()
    moments = poor.fit.arrays()["optimiser/radiance_sh/second"]
    np.testing.assert_array_equal(harmonics[:, :12], before["radiance_sh"])
    assert poor.iteration == 4 and history.any() and np.array_equal(moments.reshape(-1, 27)[:, :12], history)
    assert np.all(harmonics[:, 12:] == 0) and np.all(moments.reshape(-1, 27)[:, 12:] == 0)
    poor.step()
    np.testing.assert_array_equal(trainer.fit.params["position"].numpy(), before["position"])


def test_more_surfels_begin_where_the_error_is(method: Method, views: Dataset) -> None:
    """Those with the largest error are split at once, none is removed."""
    trainer = step_to(Trainer(method, views), 3)
    error = trainer.fit.tables[0].error_sum.numpy()
    more = fork(trainer, replace(method, surfels=replace(method.surfels, capacity=4 / 3)))
    fill(more)
    assert more.surfels.count == more.method.surfels.most == 80
    position = trainer.surfels.raw["position"].numpy()
    same = (more.surfels.raw["position"].numpy()[:, None] == position).all(-1).any(0)
    assert set(np.flatnonzero(~same)) == set(np.argsort(-error)[:20])
    assert not more.fit.tables[0].error_sum.numpy().any() and trainer.surfels.count == 60


def test_the_same_command_decides_the_same(
    method: Method, views: Dataset, tmp_path: Path, one_thread: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bit for bit, however fast the machine is, and after an interrupt in either half of the first trial."""
    method = without(method, "more_surfels")
    straight, step = fitted(method, views, tmp_path / "straight"), Trainer.step
    again = fitted(method, views, tmp_path / "again")
    assert again.fit.decisions == straight.fit.decisions
    left = 0

    def interrupted(trainer: Trainer) -> None:
        nonlocal left
        step(trainer)
        left -= 1
        if not left:
            raise KeyboardInterrupt

    ends = [again]
    for left in (3, 5):
        run = Run(tmp_path / f"run_{left}")
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(Trainer, "step", interrupted)
            begin(method, views, run).train()
        resumed = begin(run.method(), views, run)
        assert resumed.iteration == 2 and not resumed.fit.decisions
        resumed.train()
        ends.append(resumed)
    for end in ends:
        assert end.fit.decisions == straight.fit.decisions
        for name, tensor in straight.fit.params.items():
            np.testing.assert_array_equal(tensor.numpy(), end.fit.params[name].numpy(), name)


def test_decided_fit_resumes(
    file: str, method: Method, views: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed after the first decision: it stands, the others follow, and the command is the run's own."""
    judged(monkeypatch, 0.5, 0.5, 0.0)
    run, step = Run(tmp_path / "run"), Trainer.step

    def killed(trainer: Trainer) -> None:
        if trainer.fit.decisions and trainer.run is not None:
            raise MemoryError
        step(trainer)

    with monkeypatch.context() as patch, pytest.raises(MemoryError):
        patch.setattr(Trainer, "step", killed)
        begin(method, views, run).train()
    assert not differences(run, method)
    assert "loss.ssim.weight" in differences(run, methods.load(file, "quick", [*SETTINGS, "loss.ssim=0.5"]))
    resumed = begin(run.method(), views, run)
    assert summary(resumed) == [("colour_alone", 2, True)]
    resumed.train()
    assert [row["stays"] for row in resumed.fit.decisions] == [True, True, False]


def test_what_cannot_be_tried_is_said(
    method: Method, views: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    late = fitted(replace(method, iterations=3), views, tmp_path / "late")
    assert [row["reason"] for row in late.fit.decisions] == ["too late in the fit"] and late.iteration == 3

    ended = without(method, "colour_alone", "densify")
    found = fitted(ended, views, tmp_path / "ended").fit.decisions
    assert [row["reason"] for row in found] == ["no surfels to split: densification has ended"]

    with monkeypatch.context() as patch:
        patch.setattr(decide, "fork", Mock(side_effect=InputError("no surfel is left")))
        (row,) = fitted(without(method, "more_surfels"), views, tmp_path / "failed").fit.decisions
    assert not row["stays"] and "no surfel is left" in row["reason"]

    said: list[str] = []
    few = begin(method, replace(views, views=views.views[:2]), Run(tmp_path / "few"), said.append)
    few.train()
    assert "2 views: too few to hold some out" in " ".join(said)
    assert len(few.data.views) == 2 and not few.fit.decisions


def test_decisions_last(file: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """On the command line, with real trials: config.toml, decisions.json and the PLY are of one method."""
    run = tmp_path / "run"
    command = train_command(folder, run, Path(file))
    assert main([*command[: command.index("--set")], "--json", "--set", *SETTINGS]) == 0
    printed = capsys.readouterr()
    rows = json.loads((run / "decisions.json").read_text())
    assert json.loads(printed.out)["decisions"] == rows and "refgs: colour_alone " in printed.err
    assert {*read_ply(run / "surfels.ply").raw} == {*Run(run).method().surfels.names}
    assert main([*command[: command.index("--set")], "--resume", "--set", *SETTINGS]) == 0
    assert main(["eval", str(run)]) == 0
