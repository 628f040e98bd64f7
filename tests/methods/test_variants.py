"""The shipped methods: what defines each, and that each fits; settings of the paper's code for its scenes."""

import json
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from mi_refgs import methods
from mi_refgs.cli import main
from mi_refgs.fitting.events.propagate import Propagate
from mi_refgs.io.files import resource_dir
from tests.helpers import ROOT
from tests.laws.covering import marked
from tests.scenes.tiny import SETTINGS, write_data

FULL = "ref_gaussian"
FOLDER = resource_dir("scenes")
NAMES = sorted(str(path.relative_to(FOLDER).with_suffix("")) for path in (FOLDER / "paper").rglob("*.toml"))
SMOOTH = {"ball": 1.0, "helmet": 1.0, "tbell": 1.0, "gardenspheres": 0.45}
DOWNSCALE = {"gardenspheres": 4, "toycar": 4, "sedan": 8}
TABLES = json.loads((ROOT / "benchmarks" / "paper_tables.json").read_text())["data_sets"]


def test_what_defines_a_method() -> None:
    full = methods.load(FULL)
    only = {"no_initial_stage": "stage.initial", "gaussians_3d": "surfels.primitive"}
    for ablation, key in (only | {"no_material_aware": "event.propagate"}).items():
        changed = methods.differences(full, methods.load(ablation)).keys() - {"name"}
        assert changed and all(one.startswith(key) for one in changed)
    every_metal = methods.load("no_material_aware").event["propagate"]
    assert isinstance(every_metal, Propagate) and every_metal.roughness is None
    paper = methods.load("ref_gaussian_paper").event["propagate"]
    assert isinstance(paper, Propagate) and (paper.metallic, paper.roughness) == (0.02, 0.1)
    assert "propagate" not in full.event
    assert [stage.shading.at for _, stage in methods.load("no_deferred").stages()] == ["surfel"] * 2
    assert [stage.shading.at for _, stage in methods.load("no_initial_stage").stages()] == ["pixel"]
    assert {stage.shading.reflectance for _, stage in methods.load("no_pbr").stages()} == {"mirror"}
    assert full.has_mesh and not methods.load("no_interreflection").has_mesh


@pytest.mark.parametrize("variant", methods.names())
def test_a_method_says_what_it_is(variant: str) -> None:
    """One level of `extends`; a name of its own; a baseline cites its paper and lists its deviations."""
    content = tomllib.loads((ROOT / "variants" / f"{variant}.toml").read_text())
    about = content["about"]
    assert content.get("extends", FULL) == FULL and ("extends" in content) == (variant != FULL)
    assert about["name"] and about["deviations"] and "paper_row" in about
    assert about.get("paper") or not variant.startswith("base_")
    names = [methods.load(name).about.name for name in methods.names()]
    assert len({*names}) == len(names)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_data(tmp_path_factory.mktemp("variants") / "ball", views=6)


def fits() -> Iterator[Any]:
    """Every method; slow if its shadings, its primitive and whether it has a mesh occur in those before."""
    cases: list[dict[str, Any]] = []
    for name in methods.names():
        method = methods.load(name)
        shadings = [f"{stage.shading.reflectance} at {stage.shading.at}" for _, stage in method.stages()]
        cases.append({"primitive": method.surfels.primitive, "mesh": method.has_mesh})
        cases[-1] |= dict.fromkeys(shadings)
    for name, marks in zip(methods.names(), marked(cases), strict=True):
        yield pytest.param(name, marks=marks)


@pytest.mark.parametrize("variant", [*fits()])
def test_every_method_fits_and_evaluates(variant: str, data: Path, tmp_path: Path) -> None:
    """A few steps in every stage, with a mesh where the method has one."""
    run = tmp_path / "run"
    method = methods.load(variant, "quick")
    settings = [
        *SETTINGS,
        *(f"stage.{name}.until={2 * i + 2}" for i, (name, _) in enumerate(method.stages())),
    ]
    if method.light is not None:
        settings.append("light.height=8")
    if method.has_mesh:
        settings += ["event.mesh.resolution=12", "event.mesh.when={start = 0, until = 6, every = 1}"]
    assert main(["train", str(data), "-o", str(run), "--method", variant, "--set", *settings]) == 0
    assert main(["eval", str(run)]) == 0
    assert main(["render", str(run), "-o", str(tmp_path / "view.exr")]) == 0


@pytest.mark.parametrize("name", [name for name in NAMES if name.count("/") == 2 and "open" not in name])
def test_settings_are_those_of_the_scene(name: str) -> None:
    _, folder, scene = name.split("/")
    method = methods.load(name, "paper")
    assert method.loss["smooth"].weight == SMOOTH.get(scene, 0.0)
    assert method.data.downscale == DOWNSCALE.get(scene, 1)
    real = folder == "ref_real"
    assert method.data.background == ("black" if real else "white")
    first, second = (stage for _, stage in method.stages())
    share = 3 / 20 if real else 18 / 50
    assert first.until == pytest.approx(share * method.iterations) and second.until == method.iterations
    assert first.shading.reflectance == ("radiance" if real else "split_sum")
    assert bool(second.restart) != real


def test_every_scene_of_the_tables_has_settings() -> None:
    for data in TABLES.values():
        if data["folder"] == "nerf_synthetic":  # the paper names no settings for it
            continue
        for words in data["scenes"].values():
            assert f"paper/{data['folder']}/{words[0]}" in NAMES
