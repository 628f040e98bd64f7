"""Every reflectance model by every command: the result is the model's own, or one sentence refuses.

The model of a plugin is fitted. Its run is then used without the loss, event and initialiser of the fit."""

import contextlib
import io
import json
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mi_refgs
from mi_refgs import Surfels, TrainedScene, load, registry
from mi_refgs.cli import main
from mi_refgs.compare import execute
from mi_refgs.compare.worker import fit_and_measure
from mi_refgs.evaluation.evaluate import render_names
from mi_refgs.evaluation.images import displayed_over
from mi_refgs.io.exr import write_exr
from mi_refgs.io.images import read_png
from mi_refgs.methods.extensions import EVENTS, INITIALISERS, LOSSES
from mi_refgs.runs.export import save
from mi_refgs.shade.light import LIGHTS
from mi_refgs.shade.reflectance import MODELS
from mi_refgs.surfels.attributes import ATTRIBUTES
from mi_refgs.viewer.reconstruction_view import DisplayOptions, ReconstructionView, planes_of
from tests.helpers import read_exr, refused, slow
from tests.scenes.integrator import raw_channels, sky, two_balls
from tests.scenes.tiny import METHOD, train_command, write_data

COAT = Path(__file__).parents[1] / "scenes" / "coat.py"
FIT_ONLY: list[Any] = [LOSSES, EVENTS, INITIALISERS]
NEEDED: list[Any] = [MODELS, ATTRIBUTES, LIGHTS]
OWN = METHOD.replace('indirect_sh"]', 'indirect_sh", "coat"]\nstart = ["nowhere", "random"]')
OWN = OWN.replace("[light]", '[light]\nkind = "sky"').replace("0\nat =", '0\nreflectance = "coated"\nat =')
OWN += "[event.rest]\n[loss]\nthin = 0.01\n"


def forget(*registries: Any) -> None:
    """Unregister what the plugin registered there, as in a process that has not loaded it."""
    for one in registries:
        for name in [name for kind, name in registry._files if kind == one.kind]:
            one.unregister(name)
    registry._loaded.discard(str(COAT))


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """`data`, a light, `coated.toml`, and a run per model, named after it."""
    folder = tmp_path_factory.mktemp("models")
    data = write_data(folder / "data", views=8)
    write_exr(folder / "light.exr", np.linspace(0.1, 3, 8 * 16 * 3, dtype=np.float32).reshape(8, 16, 3))
    (folder / "coated.toml").write_text(OWN)
    made, camera = mi_refgs.load_method("ref_gaussian"), mi_refgs.read_dataset(data, "test").views[0].camera()
    raw, light = raw_channels(), mi_refgs.EnvironmentLight.from_radiance(sky())
    surfels = Surfels.from_numpy(raw | {"tint": raw["albedo"], "normal_offset": 0 * raw["albedo"]})
    for name, model in MODELS.items():
        shading = mi_refgs.Shading(model.shaded_at[0], name, diffuse="irradiance")
        one = TrainedScene(surfels, light, two_balls(), shading, 1, 0.0)
        save(one, folder / name, made, camera, data=data)
    with contextlib.redirect_stdout(said := io.StringIO()):
        options = "--plugin", str(COAT)
        assert main(train_command(data, folder / "coated", folder / "coated.toml", *options)) == 0
    assert f"next: refgs eval {folder / 'coated'} --plugin {COAT}\n" in said.getvalue()
    yield folder
    forget(*NEEDED, *FIT_ONLY)


@pytest.fixture
def coat(place: Path) -> Iterator[None]:
    """What rendering needs of the plugin is registered, and nothing else of it."""
    mi_refgs.load_plugins(str(COAT))
    forget(*FIT_ONLY)
    yield
    forget(*NEEDED)


def radiance(of: mi_refgs.Reconstruction) -> np.ndarray:
    return np.asarray(of.render(0))[..., :3]


def rgb(path: Path) -> np.ndarray:
    layers = read_exr(path)
    return np.stack([layers[letter] for letter in "RGB"], axis=-1)


def scene(folder: Path, name: str) -> np.ndarray:
    """The image of a folder that a command wrote, whose shading is the model's."""
    assert json.loads((folder / "model.json").read_text())["shading"]["reflectance"] == name
    assert main(["render", str(folder / "scene.xml"), "-o", str(folder / "x.exr"), "--samples", "1"]) == 0
    return rgb(folder / "x.exr")


def written(run: Path, out: Path, command: str, *options: str) -> np.ndarray:
    assert main([command, str(run), "-o", str(out), *options]) == 0
    return scene(out, run.name)


def viewed(run: Path, out: Path) -> np.ndarray:
    camera, look = load(run).camera(), DisplayOptions()
    planes = planes_of(ReconstructionView(load(run).trained).fine(camera, look, 1), camera, look, None)
    return np.stack([np.array(plane) for plane in planes[:3]], axis=-1).reshape(camera.height, -1, 3)


def measured(run: Path, out: Path) -> None:
    assert main(["eval", str(run)]) == 0
    views = load(run).views()
    shown = read_png(run / render_names(views.views)[0])[..., :3]
    expected = displayed_over(np.asarray(load(run).render(0)), views.background)
    np.testing.assert_allclose(shown, expected, atol=0.01)


def relit(run: Path, out: Path) -> None:
    made, light = load(run), run.parent / "light.exr"
    command = ["relight", str(run), "--envmap", str(light), "-o", str(out)]
    if MODELS[run.name].relit(made.trained.shading) is None:
        refused(command, run.name)
        return
    assert main(command) == 0
    found, own = rgb(out / "test/r_000.exr"), made.relight(light)
    for image in (scene(out, run.name), radiance(own)):
        np.testing.assert_allclose(image, found, atol=1e-4 * found.max())
    assert run.name != "coated" or np.abs(radiance(own.edit(set=["coat=0"])) - found).max() > 0.1


def meshed(run: Path, out: Path) -> None:
    command = ["export", str(run), "--to", "gltf-mesh", "-o", str(out), "--faces", "100", "--texture", "64"]
    if MODELS[run.name].textures(dict.fromkeys(ATTRIBUTES, 0.5)) is None:
        refused(command, run.name)
    else:
        with contextlib.redirect_stderr(said := io.StringIO()):
            assert main(command) == 0
        assert ("coat: not exported; `coated` needs" in said.getvalue()) == (run.name == "coated")


COMMANDS: dict[str, Callable[[Path, Path], np.ndarray | None]] = {
    "load": lambda run, out: radiance(load(run)),
    "render": lambda run, out: scene(run, run.name),
    "edit": lambda run, out: written(run, out, "edit", "--set", "opacity*=1"),
    "export": lambda run, out: written(run, out, "export"),
    "view": viewed,
    "eval": measured,
    "relight": relit,
    "export --to": meshed,
}
REST = [(pytest.param if key == "relight" else slow)(name, key) for name in MODELS for key in COMMANDS]
"""For models of the package, `test_routes` and tests of formats have the other commands."""


@pytest.mark.parametrize(("name", "command"), [*(("coated", key) for key in COMMANDS), *REST])
def test_a_command_shows_the_model(name: str, command: str, place: Path, coat: None, tmp_path: Path) -> None:
    if (found := COMMANDS[command](place / name, tmp_path / "out")) is not None:
        expected = load(place / name)
        np.testing.assert_allclose(found, radiance(expected), atol=1e-4)
        assert name != "coated" or np.abs(radiance(expected.edit(set=["coat=0"])) - found).max() > 0.1


def test_raw_values_choose_the_model_that_uses_them(place: Path, coat: None) -> None:
    raw, light = raw_channels(), mi_refgs.EnvironmentLight.from_radiance(sky()).raw
    state = raw | {"coat": raw["metallic"], "light": light}
    assert mi_refgs.Reconstruction.from_params(state).trained.shading.reflectance == "coated"
    forget(MODELS)
    with pytest.warns(RuntimeWarning, match="coat: `split_sum` does not use it"):
        mi_refgs.Reconstruction.from_params(state)


def test_a_comparison_takes_it_along(place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def work(jobs: list[Any], *_: object) -> None:
        forget(*NEEDED, *FIT_ONLY)  # a worker is another process
        fit_and_measure(type(jobs[0]).read(Path(jobs[0].folder)))

    monkeypatch.setattr(execute, "execute_all", work)
    command = train_command(place / "data", tmp_path, place / "coated.toml", "--plugin", str(COAT))
    assert main(["compare", *(word.replace("--method", "--methods") for word in command[1:])]) == 0
    forget(*NEEDED, *FIT_ONLY)


COMMAND_LINES = """render -o x.exr, relight --envmap {light}, eval, edit -o x --set coat=0,
    export -o x, view, train --resume"""


@pytest.mark.parametrize("command", COMMAND_LINES.split(","))
def test_a_run_whose_plugin_is_not_loaded_names_it(command: str, place: Path) -> None:
    run, [name, *options] = place / "coated", command.format(light=place / "light.exr").split()
    given = [place / "data", "-o", run] if name == "train" else [run]
    refused([name, *given, *options], run, "'sky' is unknown", f"add --plugin {COAT}, or import it")


def test_what_is_missing_is_named_wherever_it_is_read(place: Path, coat: None, tmp_path: Path) -> None:
    """What only a fit needs, when it goes on; else the model in model.json, attributes in checkpoints."""
    fit = ["train", place / "data", "-o", place / "coated", "--resume"]
    refused(fit, "surfels.start: 'nowhere' is unknown", f"add --plugin {COAT}")
    forget(MODELS)
    export = ["export", place / "coated", "-o", tmp_path / "out"]
    refused(["render", place / "coated", "-o", "x.exr"], "model.json: ", "'coated' is unknown", COAT)
    xml, hint = place / "coated" / "scene.xml", "or load its file with --plugin"
    refused(["render", xml, "-o", "x.exr"], "reflectance: 'coated' is unknown", hint)
    forget(ATTRIBUTES)
    refused(lambda: mi_refgs.load_method(str(place / "coated.toml")), "attributes: 'coat' is unknown", hint)
    refused(export, ".npz: surfels: 'coat' is unknown", f"add --plugin {COAT}")


def test_what_is_no_such_thing_is_refused_at_registration() -> None:
    """A function; a class in place of an object, or an object in place of a class; a class that is none."""
    for known in (*FIT_ONLY, *NEEDED):
        one: Any = next(iter(known.values()))
        for wrong in (len, type(one) if not isinstance(one, type) else object(), Surfels):
            refused(partial(known.register, wrong), f"{known.kind}: ", "cannot be registered; give ")


def test_entry_points_are_loaded(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    point = registry.importlib.metadata.EntryPoint("x", "no_such_package_of_models", registry.GROUP)
    monkeypatch.setattr(registry.importlib.metadata, "entry_points", lambda group: [point])
    refused(["render", tmp_path, "-o", "x.exr"], "entry point no_such_package_of_models: ModuleNotFoundError")
