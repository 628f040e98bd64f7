"""Which shading options are allowed together, and the one sentence that refuses others."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.errors import InputError
from mi_refgs.methods.read import load
from mi_refgs.render.pipeline import SurfelScene, render
from mi_refgs.shade.light.constant import ConstantLight
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.points import RadianceTerms, ShadingPoints
from mi_refgs.shade.reflectance import Reflectance, SurfelView, register, unregister
from mi_refgs.shade.shading import Shading
from mi_refgs.splat.camera import Camera
from mi_refgs.surfels.table import Surfels
from tests.helpers import refused
from tests.scenes.integrator import raw_channels, scene

LIGHT = "[light]\nheight = 16\n"
STAGE = "[stage.only]\nuntil = 100\n"

IMPOSSIBLE = {
    "no light": (STAGE, ["stage.only", "light", "add it"]),
    "no harmonics": (
        f"[surfels]\nattributes = ['albedo', 'metallic', 'roughness']\n{LIGHT}{STAGE}",
        ["stage.only", "radiance_sh", "no such attribute"],
    ),
    "a misspelt attribute": (
        f"[surfels]\nattributes = ['albdeo']\n{STAGE}",
        ["'albdeo' is unknown", "albedo"],
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
}


@pytest.mark.parametrize("case", IMPOSSIBLE)
def test_impossible_methods_are_refused_when_they_are_read(case: str, tmp_path: Path) -> None:
    text, words = IMPOSSIBLE[case]
    path = tmp_path / "own.toml"
    path.write_text(f"iterations = 100\n{text}")
    assert "\n" not in refused(lambda: load(str(path)), "own.toml", *words)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"at": "surfel", "occlusion": True}, "occlusion: needs shading at pixel"),
        ({"reflectance": "radiance", "dominant": True}, "dominant: needs reflectance"),
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


def test_a_model_of_the_hemisphere_has_directions() -> None:
    """It is occluded at surfels; others have no directions. Radiance needs no order of shading."""
    shading = Shading.resolve(ShadingOptions("surfel", "monte_carlo", directions=8), mesh=True)
    assert shading.occlusion and shading.chosen() == ["directions"]
    with pytest.raises(InputError, match="directions: needs reflectance = monte_carlo"):
        Shading("surfel", diffuse="irradiance", directions=8)
    assert Shading.resolve(ShadingOptions(reflectance="radiance"), mesh=True).shaded_at == "surfel"


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
    "rays of its own, and none": ({"visibility": "own"}, "trace is missing"),
    "no such rays": ({"visibility": "many"}, "visibility: 'many' is not allowed; use none or mirror or own"),
    "no order": ({"shaded_at": ()}, "shaded_at: () is not allowed; use pixel or surfel"),
    "no such option": ({"honoured": ("speed",)}, "honoured: ('speed',) is not allowed; use dominant"),
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
