"""Every kind of light × resume, render, export, edit, relight: they keep the light of the fit."""

import json
import shutil
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mi_refgs
from mi_refgs import methods
from mi_refgs.cli import main
from mi_refgs.data.dataset import read_dataset
from mi_refgs.fitting.decide import differences
from mi_refgs.fitting.objective import LossInputs, objective
from mi_refgs.fitting.runner import begin
from mi_refgs.fitting.train import Trainer
from mi_refgs.io.exr import write_exr
from mi_refgs.methods.method import LIGHT, LIGHT_ROTATION, LIGHT_SCALE
from mi_refgs.render.pipeline import Request, SurfelScene, render
from mi_refgs.runs.checkpoint import PARAMS
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light import lobe_matrices
from mi_refgs.shade.light.maps import LARGEST_HEIGHT, Learnt
from mi_refgs.shade.light.placed import PlacedLight
from tests.helpers import refused, unit, vector, with_grad
from tests.scenes.tiny import METHOD, SETTINGS, train_command, write_data, write_method, write_open_data

FILE = 'kind = "file"\nfile = "sky.exr"\nworld = true\n'
PHOTOGRAPHS = """[surroundings]
degree = 1
[event.photograph_light]
when = { start = 0, until = 6, every = 2 }
[loss]
photographed = 1.0
"""
KINDS = {  # the table [light], and what else the method has
    "learnt": "height = 8\n",
    "constant": 'kind = "constant"\nradiance = 0.7\n',
    "initial": FILE + "height = 8\n",
    "fixed": "every = 2\nradiance = 0.8\n",  # by options of the command line
    "placed": FILE + 'fixed = true\nrotate = 20\nlearn = ["rotation", "scale"]\n',
    "turntable": "height = 8\nturntable = true\n",
    "photographed": "height = 8\n" + PHOTOGRAPHS,  # whose light is near, too
}
SKY = np.linspace(0.1, 2, 8 * 16 * 3).reshape(8, 16, 3).astype(np.float32)  # the map of the tiny data set


@pytest.fixture(scope="module", params=KINDS)
def fitted(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """A kind, and the folder of a short fit with it."""
    folder, kind = tmp_path_factory.mktemp(request.param), request.param
    write_exr(folder / "sky.exr", SKY)
    own = write_method(folder, METHOD.replace("height = 8\n", KINDS[kind]))
    data = (write_open_data if kind == "photographed" else write_data)(folder / "data")
    options = {
        "fixed": ["--light-fixed", "--light", str(data / "environment.exr")],
        "photographed": ["--set", "surroundings.count=60", "surroundings.max_count=90"],
    }
    assert main([*train_command(data, folder / "run", own), *options.get(kind, [])]) == 0
    (folder / "sky.exr").unlink()  # a run has all of its light
    return kind, folder


def radiance(light: Any) -> np.ndarray:
    return np.asarray(light.environment().radiance().numpy())


def state_of(run: Path) -> dict[str, Any]:
    state = Run(run).load_checkpoint()
    assert state is not None
    return state


def test_a_run_saves_what_was_fitted(fitted: tuple[str, Path]) -> None:
    kind, folder = fitted
    run: Any = mi_refgs.load(folder / "run")
    assert run.method.light.every == (2 if kind == "fixed" else 1)
    saved, state = radiance(run.trained.light), state_of(folder / "run")
    scene: Any = TrainedScene.from_state(run.method, state)
    np.testing.assert_allclose(saved, radiance(scene.light), rtol=1e-5)
    assert (run.trained.near is not None) == (scene.near is not None) == (kind == "photographed")
    axes = None if scene.turntable is None else scene.turntable.numpy()
    if kind == "turntable":
        first = read_dataset(folder / "data", "train").views[0].to_world[:3, :3]
        np.testing.assert_allclose([axes, run.trained.turntable.numpy()], [first, first], atol=1e-6)
    else:
        assert axes is run.trained.turntable is None
    if kind == "constant":
        np.testing.assert_allclose(saved, np.broadcast_to(saved[0, 0], saved.shape), rtol=1e-5)
    if kind == "fixed":
        np.testing.assert_allclose(saved, SKY, rtol=1e-5)
    elif kind == "initial":
        assert 1e-4 < np.abs(saved - SKY).max() < 0.5
    if kind == "placed":
        rotation, scale = (state[PARAMS + name][0] for name in (LIGHT_ROTATION, LIGHT_SCALE))
        assert np.all(np.abs([rotation, scale]) > 1e-4) and np.all(np.abs([rotation, scale]) < 0.2)
        found = json.loads((folder / "run" / "light.json").read_text())
        turn = Rotation.from_rotvec(rotation).as_matrix()
        np.testing.assert_allclose(found["world_from_map"], turn, atol=1e-5)
        np.testing.assert_allclose(found["scale"], np.exp(scale), atol=1e-5)


def test_resumed_fits_repeat(fitted: tuple[str, Path], tmp_path: Path) -> None:
    _, folder = fitted
    shutil.copytree(folder / "run", tmp_path / "run")
    Run(tmp_path / "run").checkpoints()[-1].unlink()
    assert main(["train", str(folder / "data"), "-o", str(tmp_path / "run"), "--resume"]) == 0
    before, after = state_of(folder / "run"), state_of(tmp_path / "run")
    for name in [name for name in before if LIGHT in name]:
        np.testing.assert_allclose(after[name], before[name], rtol=1e-3, atol=1e-5, err_msg=name)


def test_commands_keep_the_light(fitted: tuple[str, Path], tmp_path: Path) -> None:
    kind, folder = fitted
    run: Any = mi_refgs.load(folder / "run")
    light = run.trained.light
    image = np.array(mi.render(mi.load_file(str(folder / "run" / "scene.xml")), spp=1))
    assert np.mean(np.abs(image - run.render(0)).max(-1) > 2e-3) < 0.005  # a ray that passes an edge
    edited = run.edit(set={"roughness": 0.3}).save(tmp_path / "edited").trained
    np.testing.assert_allclose(radiance(edited.light), radiance(light), rtol=1e-5)
    assert (edited.near is not None) == (edited.surroundings is not None) == (kind == "photographed")
    if kind == "turntable":  # whose light by view is in the SH colour
        refused(lambda: run.relight(light), "a light that turned", "--for relighting")
        return
    relit = run.relight(light).trained
    np.testing.assert_allclose(radiance(relit.light), radiance(light), rtol=1e-5)
    assert relit.near is None


def test_height_follows_the_size_of_images(tmp_path: Path) -> None:
    """From the images of the presets on, and wherever a method says it, as ever; a run keeps its own."""
    rows = [Learnt().sized(side**2).height for side in (20, 96, 128, 162, 400)]
    assert rows == [16, 76, 104, LARGEST_HEIGHT, LARGEST_HEIGHT]
    assert Learnt(height=8).sized(96**2).height == 8
    own = write_method(tmp_path, METHOD.replace("height = 8\n", ""))
    data, said = write_data(tmp_path / "data"), list[str]()
    run, method = Run(tmp_path / "run"), methods.load(str(own), "quick", SETTINGS)
    begin(method, read_dataset(data, "train"), run, said.append)
    assert run.method().light == Learnt(height=16) and "16 rows" in said[0]
    assert differences(run, method).keys() <= {"data.downscale"}


def test_what_no_light_can_be(tmp_path: Path) -> None:
    data, learns = write_data(tmp_path / "data"), ["light.kind=file", "light.file=a", "light.learn=['scale']"]
    refused(lambda: methods.load("ref_gaussian", "quick", learns), "add fixed = true")
    refused(lambda: methods.load("ref_gaussian", "quick", learns[:1]), "light: file: none is named")
    made = methods.load("ref_gaussian", "quick", [*learns[:2], "light.fixed=true"])
    assert made.assignments[1] == f'light.file="{Path.cwd() / "a"}"'  # commands run elsewhere, too
    command = ["train", str(data), "-o", str(tmp_path / "run"), "--method", "base_2dgs"]
    refused([*command, "--light", str(data / "environment.exr")], "light: no stage uses it")
    refused([*command, "--light-fixed"], "--light-fixed: no map is given; give its file as --light")


AT = np.array([[0.3, -0.2, 0.5], [0.1, 0.2, -0.3]], np.float32)  # rotation vector, log scale


def test_placed_light_is_the_map_turned_and_scaled() -> None:
    """In lookups, and in the map that a run saves."""
    smooth = np.tile(np.linspace(0.1, 1, 16)[:, None, None], (1, 32, 3))
    raw = mi_refgs.EnvironmentLight.from_radiance(smooth).raw
    light = PlacedLight(raw, *(mi.TensorXf(row[None]) for row in AT))
    d = unit(np.random.default_rng(1).normal(size=(200, 3)))
    expected = np.exp(AT[1]) * light.map.unfiltered().radiance(vector(d)).numpy().T
    turned = vector(Rotation.from_rotvec(AT[0]).apply(d))
    for found in (light.unfiltered(), light.environment().unfiltered()):
        np.testing.assert_allclose(found.radiance(turned).numpy().T, expected, atol=0.01)


def test_derivatives_of_rotation_and_scale_with_other_losses(tmp_path: Path) -> None:
    """Of the objective without L1, which has kinks, against central differences; at 0 too."""
    sky = 0.6 + 0.3 * lobe_matrices.map_directions(32)
    write_exr(tmp_path / "sky.exr", sky.astype(np.float32))
    own = write_method(tmp_path, METHOD.replace("height = 8\n", KINDS["placed"]))
    more = ["loss.ssim=1", *(f"loss.{name}=0.1" for name in ("smooth", "half_metal", "normal"))]
    more.append("surfels.initial={metallic=0.9}")
    method = methods.load(str(own), "quick", [*SETTINGS, *more])
    trainer = Trainer(method, read_dataset(write_data(tmp_path / "data"), "train"))
    trainer.train()
    target, fit = trainer.targets.at(6, 0), trainer.fit

    def objective_at(numbers: np.ndarray) -> Any:
        for name, row in zip((LIGHT_ROTATION, LIGHT_SCALE), numbers, strict=True):
            fit.params[name] = with_grad(mi.TensorXf(row[None].astype(np.float32)))
        shading = trainer.shading()
        light = shading.light_of(fit.light)
        scene = SurfelScene(fit.surfels, shading, light, fit.occluder)
        frame = render(scene, target.camera, Request(("normal",)))
        return objective(LossInputs.of(frame, target, trainer.data, light), method.loss, 6)[0]

    for at in (AT, np.zeros((2, 3))):
        dr.backward(objective_at(at))
        found = [dr.grad(fit.params[name]).numpy()[0] for name in (LIGHT_ROTATION, LIGHT_SCALE)]
        for i, row in enumerate(found):
            steps = [0.015 * np.outer(np.eye(2)[i], axis) for axis in np.eye(3)]
            expected = [(objective_at(at + x)[0] - objective_at(at - x)[0]) / 0.03 for x in steps]
            np.testing.assert_allclose(row, expected, atol=0.03 * np.abs(expected).max())
