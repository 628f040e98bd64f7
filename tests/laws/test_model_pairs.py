"""Every reflectance model and every command: the result is the model's own, or one sentence refuses.

The model of a plugin is fitted. Its run is then used without the loss, event and initialiser of the fit.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import mi_refgs
from mi_refgs import registry
from mi_refgs.cli import main
from mi_refgs.compare import execute
from mi_refgs.compare.worker import fit_and_measure
from mi_refgs.evaluation.evaluate import render_names
from mi_refgs.evaluation.images import displayed_over
from mi_refgs.io.exr import read_exr, write_exr
from mi_refgs.io.images import read_png
from mi_refgs.methods.event import EVENTS
from mi_refgs.methods.initialiser import INITIALISERS
from mi_refgs.methods.loss import LOSSES
from mi_refgs.methods.read import load as load_method
from mi_refgs.runs.export import newest, save
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light import LIGHTS
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.reflectance import MODELS
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.attributes import ATTRIBUTES
from mi_refgs.surfels.table import Surfels
from mi_refgs.viewer.reconstruction_view import ReconstructionView
from mi_refgs.viewer.viewer_scene import DisplayOptions, planes_of
from tests.helpers import refused, slow
from tests.scenes.integrator import raw_channels, sky, two_balls
from tests.scenes.tiny import METHOD, train_command, write_data

COAT = Path(__file__).parents[1] / "scenes" / "coat.py"
FIT_ONLY = (LOSSES, EVENTS, INITIALISERS)
OWN = METHOD.replace('"indirect_sh"]', '"indirect_sh", "coat"]\nstart = ["nowhere", "random"]')
OWN = OWN.replace("height = 8", 'kind = "sky"\nheight = 8').replace(
    '"pixel"', '"pixel"\nreflectance = "coated"'
)
OWN += "[event.rest]\n[loss]\nthin = 0.01\n"


NEEDED = (MODELS, ATTRIBUTES, LIGHTS)


def forget(*registries: Any) -> None:
    """Unregister what the plugin registered there, so that it is as if it had not been loaded."""
    for kind, name in [*registry._files]:
        for one in registries:
            if one.kind == kind:
                one.unregister(name)
    registry._loaded.discard(str(COAT))


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """`data`, a light, `coated.toml`, and a run per model, named after it."""
    mi.set_variant("llvm_ad_rgb")
    folder = tmp_path_factory.mktemp("models")
    data = write_data(folder / "data", views=8)
    write_exr(folder / "light.exr", np.linspace(0.1, 3, 8 * 16 * 3, dtype=np.float32).reshape(8, 16, 3))
    (folder / "coated.toml").write_text(OWN)
    made = load_method("ref_gaussian", "quick")
    camera = mi_refgs.read_dataset(data, "test").views[0].camera()
    raw, light = raw_channels(), EnvironmentLight.from_radiance(sky())
    raw |= {"tint": raw["albedo"], "normal_offset": 0 * raw["albedo"]}
    for name, model in MODELS.items():
        shading = Shading(model.shaded_at[0], name, diffuse="irradiance")
        scene = TrainedScene(Surfels.from_numpy(raw), light, two_balls(), shading, 1, 0.0)
        save(scene, folder / name, made, camera, data=data)
    command = train_command(data, folder / "coated", folder / "coated.toml", "--plugin", str(COAT))
    assert main(command) == 0
    yield folder
    forget(*NEEDED, *FIT_ONLY)


@pytest.fixture
def coat(place: Path) -> Iterator[None]:
    """What rendering needs of the plugin is registered, and nothing else of it."""
    mi_refgs.load_plugins([COAT])
    forget(*FIT_ONLY)
    registry._loaded.add(str(COAT))
    yield
    forget(*NEEDED, *FIT_ONLY)


def radiance(of: mi_refgs.Reconstruction) -> np.ndarray:
    return np.asarray(of.render(0))[..., :3]


def scene_of(folder: Path, name: str) -> np.ndarray:
    """The image of a folder that a command wrote, whose shading is the model's."""
    assert json.loads((folder / "model.json").read_text())["shading"]["reflectance"] == name
    assert main(["render", str(folder / "scene.xml"), "-o", str(folder / "x.exr"), "--samples", "1"]) == 0
    layers = read_exr(folder / "x.exr")
    return np.stack([layers[letter] for letter in "RGB"], axis=-1)


def by_load(run: Path, out: Path) -> np.ndarray:
    return radiance(mi_refgs.load(run))


def by_render(run: Path, out: Path) -> np.ndarray:
    return scene_of(run, run.name)


def by_view(run: Path, out: Path) -> np.ndarray:
    camera = mi_refgs.load(run).camera()
    view, look = ReconstructionView(newest(Run(run), Run(run).method())), DisplayOptions()
    planes = planes_of(view.fine(camera, look, 1), camera, look, None)
    return np.stack([np.array(plane) for plane in planes[:3]], axis=-1).reshape(camera.height, -1, 3)


def by_edit(run: Path, out: Path) -> np.ndarray:
    assert main(["edit", str(run), "-o", str(out), "--set", "opacity*=1"]) == 0
    return scene_of(out, run.name)


def by_export(run: Path, out: Path) -> np.ndarray:
    assert main(["export", str(run), "-o", str(out)]) == 0
    return scene_of(out, run.name)


def by_eval(run: Path, out: Path) -> None:
    assert main(["eval", str(run)]) == 0
    views = mi_refgs.load(run).views()
    shown = read_png(run / render_names(views.views)[0])[..., :3]
    expected = displayed_over(np.asarray(mi_refgs.load(run).render(0)), views.background)
    np.testing.assert_allclose(shown, expected, atol=0.01)


def by_relight(run: Path, out: Path) -> None:
    light = run.parent / "light.exr"
    command = ["relight", run, "--envmap", light, "-o", out]
    if MODELS[run.name].relit(mi_refgs.load(run).trained.shading) is None:
        refused(command, run.name)
        return
    assert main([*map(str, command)]) == 0
    layers = read_exr(out / "test/r_000.exr")
    found = np.stack([layers[letter] for letter in "RGB"], axis=-1)
    np.testing.assert_allclose(scene_of(out, run.name), found, atol=1e-4 * found.max())
    relit = mi_refgs.load(run).relight(light)
    np.testing.assert_allclose(radiance(relit), found, atol=1e-4 * found.max())
    if run.name == "coated":
        assert np.abs(radiance(relit.edit(set=["coat=0"])) - found).max() > 0.1


def by_mesh(run: Path, out: Path) -> None:
    command = ["export", run, "--to", "gltf-mesh", "-o", out, "--faces", "100", "--texture", "64"]
    if MODELS[run.name].textures({name: 0.5 for name in ATTRIBUTES}) is None:
        refused(command, run.name)
    else:
        assert main([*map(str, command)]) == 0


COMMANDS = (by_load, by_render, by_view, by_edit, by_export, by_eval, by_relight, by_mesh)
REST = [(pytest.param if way is by_relight else slow)(name, way) for name in MODELS for way in COMMANDS]
"""Of models of the package `test_routes` and tests of formats have the other commands."""


@pytest.mark.parametrize(("name", "way"), [*(("coated", way) for way in COMMANDS), *REST])
def test_a_command_shows_the_model(
    name: str, way: Callable[[Path, Path], np.ndarray | None], place: Path, coat: None, tmp_path: Path
) -> None:
    found = way(place / name, tmp_path / "out")
    if found is not None:
        expected = mi_refgs.load(place / name)
        np.testing.assert_allclose(found, radiance(expected), atol=1e-4)
        if name == "coated":
            assert np.abs(radiance(expected.edit(set=["coat=0"])) - found).max() > 0.1


def test_a_comparison_takes_it_along(place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def work(jobs: list[Any], workers: int, report: Any) -> None:
        for job in jobs:
            forget(*NEEDED, *FIT_ONLY)  # a worker is another process
            fit_and_measure(type(job).read(Path(job.folder)))

    monkeypatch.setattr(execute, "execute_all", work)
    command = train_command(place / "data", tmp_path, place / "coated.toml", "--plugin", str(COAT))
    assert main(["compare", *(word.replace("--method", "--methods") for word in command[1:])]) == 0
    forget(*NEEDED, *FIT_ONLY)


@pytest.mark.parametrize(
    "command",
    [
        "render RUN -o OUT.exr",
        "relight RUN --envmap LIGHT",
        "eval RUN",
        "edit RUN -o OUT --set coat=0",
        "export RUN -o OUT",
        "view RUN",
        "profile RUN",
        "train DATA -o RUN --resume",
    ],
)
def test_a_run_whose_plugin_is_not_loaded_names_it(command: str, place: Path, tmp_path: Path) -> None:
    run = place / "coated"
    words = {"RUN": run, "OUT": tmp_path / "out", "OUT.exr": tmp_path / "out.exr", "DATA": place / "data"}
    given = [words.get(word, word) for word in command.replace("LIGHT", str(place / "light.exr")).split()]
    refused(given, run, "'sky' is unknown", f"add --plugin {COAT}, or import it in Python")
