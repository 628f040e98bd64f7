"""Which shading options are allowed together, and the one sentence that refuses others."""

from __future__ import annotations

import re
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import Any, get_args

import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.errors import InputError
from mi_refgs.methods.read import load
from mi_refgs.render.pipeline import SurfelScene, render
from mi_refgs.shade.light.constant import ConstantLight
from mi_refgs.shade.options import Diffuse, ShadedAt, ShadingOptions
from mi_refgs.shade.points import RadianceTerms, ShadingPoints
from mi_refgs.shade.reflectance import Reflectance, SurfelView, register, unregister
from mi_refgs.shade.shading import Shading
from mi_refgs.splat.camera import Camera
from mi_refgs.surfels.table import ATTRIBUTES, Surfels
from tests.helpers import refused
from tests.scenes.integrator import image, raw_channels, scene

LIGHT = "[light]\nheight = 16\n"
STAGE = "[stage.only]\nuntil = 100\n"

IMPOSSIBLE = {
    "no light": (STAGE, ["stage.only", "light", "add it"]),
    "no roughness": (
        f"[surfels]\nattributes = ['radiance_sh', 'albedo', 'metallic']\n{LIGHT}{STAGE}",
        ["stage.only", "roughness", "no such attribute"],
    ),
    "no harmonics": (
        f"[surfels]\nattributes = ['albedo', 'metallic', 'roughness']\n{LIGHT}{STAGE}",
        ["stage.only", "radiance_sh", "no such attribute"],
    ),
    "a misspelt attribute": (
        f"[surfels]\nattributes = ['albdeo']\n{STAGE}",
        ["'albdeo' is unknown", "albedo"],
    ),
    "no samples": (
        f"[surfels]\nattributes = ['radiance_sh']\n{STAGE}reflectance = 'radiance'\nsamples = 0",
        ["stage.only", "samples: 0"],
    ),
    "bounces of a model that traces none": (
        f"[surfels]\nattributes = ['albedo', 'roughness']\n{LIGHT}{STAGE}reflectance = 'monte_carlo'\n"
        "at = 'surfel'\ntraced_bounces = 1\n[event.mesh]",
        ["stage.only", "traced_bounces: needs reflectance = split_sum"],
    ),
    "a model of surfels shaded per pixel": (
        f"[surfels]\nattributes = ['albedo', 'roughness']\n{LIGHT}{STAGE}reflectance = 'monte_carlo'",
        ["stage.only", "monte_carlo needs shading at surfel; set it"],
    ),
    "materials reset that are none": (
        f"[surfels]\nattributes = ['radiance_sh']\n{STAGE}reflectance = 'radiance'\nrestart = ['metallic']",
        ["stage.only", "restart", "metallic"],
    ),
}


@pytest.mark.parametrize("case", IMPOSSIBLE)
def test_impossible_methods_are_refused_when_they_are_read(case: str, tmp_path: Path) -> None:
    text, words = IMPOSSIBLE[case]
    path = tmp_path / "own.toml"
    path.write_text(f"iterations = 100\n{text}")
    assert "\n" not in refused(lambda: load(str(path)), "own.toml", *words)


def test_radiance_needs_no_order_of_shading(tmp_path: Path) -> None:
    """`at` keeps its default, "pixel": blending is linear, so that the image is the same."""
    path = tmp_path / "own.toml"
    surfels = "[surfels]\nattributes = ['radiance_sh']\n"
    path.write_text(f"iterations = 100\n{surfels}{STAGE}reflectance = 'radiance'")
    stage = load(str(path)).stage["only"]
    assert stage.shading.at == "pixel" and Shading.resolve(stage.shading, mesh=True).shaded_at == "surfel"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"at": "surfel", "occlusion": True}, "occlusion: needs shading at pixel"),
        ({"reflectance": "radiance", "occlusion": True}, "occlusion: needs shading at pixel"),
        ({"reflectance": "radiance", "dominant": True}, "dominant: needs reflectance"),
        ({"visibility_rays": 4}, "visibility_rays, traced_bounces, ambient_rays: need occlusion"),
        ({"diffuse": "sh", "ambient_rays": 9}, "need diffuse = irradiance"),
        ({"traced_bounces": 1}, "visibility_rays, traced_bounces, ambient_rays: need occlusion"),
    ],
)
def test_what_is_not_allowed_together_is_refused(options: dict, words: str) -> None:
    with pytest.raises(InputError, match=words):
        Shading(**options)
    keys = {"at": "shade_at"}
    with pytest.raises(Exception, match=words if "occlusion" not in options else "occlusion"):
        scene(**{keys.get(name, name): value for name, value in options.items()})


def test_rendering_without_what_it_needs_is_refused() -> None:
    surfels = Surfels.from_numpy(raw_channels())
    camera, light = Camera.from_pose(4, 4, -4, -4, 2, 2, np.eye(4)), ConstantLight(mi.Color3f(1))
    with pytest.raises(InputError, match="light: reflectance = split_sum needs one"):
        render(SurfelScene(surfels, Shading()), camera)
    with pytest.raises(InputError, match="there is no mesh to trace"):
        render(SurfelScene(surfels, Shading(occlusion=True), light), camera)
    del surfels.raw["metallic"]
    with pytest.raises(InputError, match="metallic: the surfels have no such attribute"):
        render(SurfelScene(surfels, Shading(), light), camera)


def test_every_mode_that_is_not_refused_renders() -> None:
    """Each reflectance, order and diffuse with the attributes that `require_inputs` requires only."""
    raw = raw_channels()
    for reflectance, diffuse, at in product(("radiance", "split_sum"), get_args(Diffuse), get_args(ShadedAt)):
        shading = Shading(at, reflectance, diffuse)
        few = {name: values for name, values in raw.items() if name not in needless(shading)}
        options: dict = {"shade_at": at, "reflectance": reflectance, "diffuse": diffuse}
        assert image(scene(raw=few, **options)).max() > 0.05


def needless(shading: Shading) -> set[str]:
    found = set()
    for name in (name for name in ATTRIBUTES if not ATTRIBUTES[name].geometry):
        with suppress(InputError):
            shading.require_inputs([other for other in ATTRIBUTES if other != name])
            found.add(name)
    return found


def test_a_stage_says_how_many_directions(tmp_path: Path) -> None:
    """A model that sums over the hemisphere is occluded at surfels; others have no directions."""
    path = tmp_path / "own.toml"
    text = "iterations = 100\n[surfels]\nattributes = ['albedo', 'roughness']\n" + LIGHT + STAGE
    path.write_text(f"{text}at = 'surfel'\nreflectance = 'monte_carlo'\ndirections = 8")
    shading = Shading.resolve(load(str(path)).stage["only"].shading, mesh=True)
    assert shading.occlusion and shading.chosen() == ["directions"] and shading.directions == 8
    path.write_text(f"{text}at = 'surfel'\ndiffuse = 'irradiance'\ndirections = 8")
    with pytest.raises(InputError, match="directions: needs reflectance = monte_carlo"):
        load(str(path))


class Complete(Reflectance):
    """A model with all that is needed."""

    name = "complete"

    def required_attributes(self, options: ShadingOptions) -> tuple[str, ...]:
        return ("albedo",)

    def values(self, surfels: Surfels, seen: SurfelView, options: ShadingOptions) -> dict[str, Any]:
        return {"albedo": surfels.value("albedo")}

    def shade(self, points: ShadingPoints, light: Any, options: ShadingOptions) -> RadianceTerms:
        return RadianceTerms(points.albedo)


INCOMPLETE: dict[str, tuple[dict[str, Any], str]] = {
    "no needs": ({"required_attributes": Reflectance.required_attributes}, "required_attributes is missing"),
    "no values": ({"values": Reflectance.values}, "values is missing; write that method"),
    "no shade": ({"shade": Reflectance.shade}, "shade is missing"),
    "rays of its own, and none": ({"visibility": "own"}, "trace is missing"),
    "no such rays": ({"visibility": "many"}, "visibility: 'many' is not allowed; use none or mirror or own"),
    "no such lookup": ({"light": "sharp"}, "light: 'sharp' is not allowed"),
    "no order": ({"shaded_at": ()}, "shaded_at: () is not allowed; use pixel or surfel"),
    "a name in place of several": ({"shaded_at": "pixel"}, "shaded_at: 'pixel' is not allowed"),
    "no such option": ({"honoured": ("speed",)}, "honoured: ('speed',) is not allowed; use dominant"),
    "no name": ({"name": ""}, "the name is empty or in use"),
    "another's name": ({"name": "split_sum"}, "'split_sum': the name is empty or in use"),
}


@pytest.mark.parametrize("case", INCOMPLETE)
def test_an_incomplete_model_is_refused_when_it_is_registered(case: str) -> None:
    changes, words = INCOMPLETE[case]
    with pytest.raises(InputError, match=f"^reflectance model: .*{re.escape(words)}"):
        register(type("Incomplete", (Complete,), changes)())
    with pytest.raises(InputError, match="give an object of a subclass of Reflectance"):
        register(Complete)  # type: ignore[arg-type]
    register(Complete())
    unregister("complete")
