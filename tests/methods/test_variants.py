"""The shipped methods: exactly what each changes of the full one, and that each fits, evaluates, renders."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest

from mi_refgs import methods
from mi_refgs.cli import main
from mi_refgs.methods.build import plain
from tests.helpers import ROOT
from tests.scenes.tiny import SETTINGS, write_data

FULL = "ref_gaussian"
GEOMETRY_LOSS = "loss.normal loss.normal_rise"
OWN_LIGHT = "light.every rates.light"
NO_MESH = "mesh rates.channel rates.rest surfels.channels surfels.degree"
COLOUR_ONLY = (
    f"{NO_MESH} light refine.reset_raise stage.deferred stage.initial stage.radiance surfels.initial"
)

DIFFERENCES = {
    "ref_gaussian": "",
    "ref_gaussian_paper": (
        "iterations light.every loss.normal loss.normal_rise loss.smooth loss.smooth_until mesh.extract "
        "rates.channel rates.decay rates.light rates.rest refine.densify refine.propagate refine.reset "
        "stage.deferred stage.initial surfels.degree surfels.initial surfels.sh_raise"
    ),
    "no_pbr": f"{NO_MESH} {OWN_LIGHT} stage.deferred stage.initial surfels.initial",
    "no_interreflection": NO_MESH,
    "no_deferred": f"{NO_MESH} stage.deferred",
    "no_initial_stage": "stage.initial",
    "no_material_aware": "refine.propagate",
    "gaussians_3d": "surfels.primitive",
    "base_2dgs": COLOUR_ONLY,
    "base_3dgs": f"{COLOUR_ONLY} {GEOMETRY_LOSS} surfels.primitive",
    "base_3dgs_mcmc": (
        f"{COLOUR_ONLY} {GEOMETRY_LOSS} refine.densify refine.relocate refine.reset surfels.primitive"
    ),
    "base_3dgs_dr": (
        f"{NO_MESH} {GEOMETRY_LOSS} {OWN_LIGHT} refine.propagate stage.deferred stage.initial "
        "surfels.initial surfels.primitive surfels.sh_raise"
    ),
    "base_gaussian_shader": (
        f"{NO_MESH} {OWN_LIGHT} light.radiance loss.normal_rise refine.reset_raise stage.deferred "
        "stage.initial stage.only surfels.initial surfels.primitive"
    ),
    "base_r3dg": (
        f"{OWN_LIGHT} light.height light.radiance mesh.extract rates.channel rates.rest refine.reset_raise "
        "stage.deferred stage.initial stage.radiance stage.relightable surfels.channels surfels.degree "
        "surfels.initial surfels.primitive"
    ),
    "auto": "select",
    "photographs": (
        "loss.normal_rise loss.smooth loss.smooth_until mesh.extract refine.reset refine.reset_raise "
        "surfels.initial"
    ),
    "relighting": (
        "loss.half_metal loss.half_metal_rise loss.half_metal_start loss.light_colour loss.materials "
        "rates.light_relative stage.deferred stage.initial surfels.channels surfels.degree "
        "surfels.from_images surfels.initial"
    ),
}
"""Keys, to the second level, by which a method differs from the full one; `about` aside."""


def entries(variant: str) -> dict[str, Any]:
    """The resolved, unscaled keys of a method to the second level."""
    method = plain(methods.load(variant, "standard"))
    for name in ("about", "name", "file", "preset", "assignments", "components"):
        method.pop(name)
    found: dict[str, Any] = {}
    for key, value in method.items():
        inner = value if isinstance(value, dict) and key != "select" else {"": value}
        found |= {f"{key}.{name}".rstrip("."): entry for name, entry in inner.items()}
    return found


@pytest.mark.parametrize("variant", methods.names())
def test_a_method_changes_exactly_what_is_listed(variant: str) -> None:
    full, other = entries(FULL), entries(variant)
    changed = {key for key in full.keys() | other.keys() if full.get(key) != other.get(key)}
    whole = {"light", "mesh"}  # where a method has none of it
    absent = {name for name in whole if not any(key.startswith(f"{name}.") for key in other)}
    changed = {key for key in changed if key.partition(".")[0] not in absent} | absent
    # The preset decides how many iterations run, and everything is scaled to them.
    assert changed == {*DIFFERENCES[variant].split()} - {"iterations"}


def test_what_defines_a_method() -> None:
    """Values, not only keys."""
    full = methods.load(FULL)
    every_metal = methods.load("no_material_aware").refine.propagate
    assert every_metal is not None and every_metal.roughness is None and full.refine.propagate is None
    paper = methods.load("ref_gaussian_paper").refine.propagate
    assert paper is not None and (paper.metallic, paper.roughness) == (0.02, 0.1)
    assert [stage.shading.at for _, stage in methods.load("no_deferred").stages()] == ["surfel"] * 2
    assert [stage.shading.at for _, stage in methods.load("no_initial_stage").stages()] == ["pixel"]
    assert {stage.shading.reflectance for _, stage in methods.load("no_pbr").stages()} == {"mirror"}
    assert methods.load("no_interreflection").mesh is None and full.mesh is not None


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


@pytest.mark.parametrize("variant", methods.names())
def test_every_method_fits_and_evaluates(variant: str, data: Path, tmp_path: Path) -> None:
    """A few steps in every stage, with a mesh where the method has one."""
    run = tmp_path / "run"
    method = methods.load(variant, "quick")
    settings = [*SETTINGS]
    if method.select is None:  # a component may replace the stages
        settings += [f"stage.{name}.until={2 * i + 2}" for i, (name, _) in enumerate(method.stages())]
    if method.light is not None:
        settings.append("light.height=8")
    if method.mesh is not None:
        settings += ["mesh.resolution=12", "mesh.extract={start = 0, until = 6, every = 1}"]
    assert main(["train", str(data), "-o", str(run), "--method", variant, "--set", *settings]) == 0
    assert main(["eval", str(run)]) == 0
    assert main(["render", str(run), "-o", str(tmp_path / "view.exr")]) == 0
