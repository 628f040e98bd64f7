"""Shading options: which are allowed together, what they are for, and the plugin's."""

import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.errors import InputError
from mi_refgs.methods.read import load
from mi_refgs.reference import lobe as exact
from mi_refgs.reference.light import radiance_of
from mi_refgs.render.pipeline import SurfelScene, render
from mi_refgs.shade.light import lobe_matrices
from mi_refgs.shade.light.constant import ConstantLight
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.points import RadianceTerms, ShadingPoints
from mi_refgs.shade.reflectance import Reflectance, SurfelView, register, unregister
from mi_refgs.shade.reflectance.split_sum import SplitSum
from mi_refgs.shade.shading import Shading
from mi_refgs.splat.camera import Camera
from mi_refgs.surfels.table import Surfels
from tests.helpers import refused, slow
from tests.scenes.integrator import check_derivatives, plane_mesh, raw_channels, scene
from tests.scenes.shading_points import points_of

PLAIN = ShadingOptions(diffuse="irradiance")
LIGHT = "[light]\nheight = 16\n"
STAGE = "[stage.only]\nuntil = 100\n"

IMPOSSIBLE = {
    "no light": (STAGE, ["stage.only", "light", "add it"]),
    "no harmonics": (
        f"[surfels]\nattributes = ['albedo', 'metallic', 'roughness']\n{LIGHT}{STAGE}",
        ["stage.only", "radiance_sh", "no such attribute"],
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
    "hits in the dark": ({"light": "none", "honoured": ("traced_bounces",)}, "honoured: hits are not lit"),
    "no irradiance": ({"light": "radiance", "honoured": ("ambient_rays",)}, "honoured: hits are not lit"),
    "another's name": ({"name": "split_sum"}, "'split_sum': the name is empty or in use"),
}


@pytest.mark.parametrize("case", INCOMPLETE)
def test_an_incomplete_model_is_refused_when_it_is_registered(case: str) -> None:
    changes, words = INCOMPLETE[case]
    with pytest.raises(InputError, match=f"^reflectance model: .*{re.escape(words)}"):
        register(type("Incomplete", (Complete,), changes)())
    with pytest.raises(InputError, match="give an object of Reflectance"):
        register(Complete)  # type: ignore[arg-type]
    register(Complete())
    unregister("complete")


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("diffuse", ("lambert",)),
        ("dominant", (1,)),
        ("directions", (0, 65)),
        ("traced_bounces", (None, -1, True)),
        ("visibility_rays", (0, 2.0, True)),
    ],
)
def test_bad_settings_are_refused(name: str, values: tuple[Any, ...]) -> None:
    for value in values:
        with pytest.raises(InputError, match=name):
            ShadingOptions(**{name: value})


@pytest.mark.parametrize("roughness", [0.3, 0.9, slow(0.5), slow(0.7)])
def test_the_dominant_direction_comes_closer_to_the_integral(roughness: float) -> None:
    """Under a gradient, against brute force: nearer in sum, and over twice as near where lobes are wide."""
    h = 32
    up, around = lobe_matrices.row_angles(h)[:, None, None], lobe_matrices.column_angles(2 * h)[None, :, None]
    map_ = np.tile(2 + np.cos(up) + 0.8 * np.sin(up) * np.sin(around), 3)
    cosine, normal = np.array([0.1, 0.3, 0.5, 0.7, 0.9]), np.array([1.0, 0, 0])
    view = np.stack([cosine, np.sqrt(1 - cosine**2), 0 * cosine], 1)
    sky, f0 = partial(radiance_of, map_), np.full(3, 0.8)
    truth = [exact.reflected(sky, normal, v, roughness, f0)[0] for v in view]
    metal = {"albedo": np.full((5, 3), 0.8), "metallic": np.ones(5), "roughness": np.full(5, roughness)}
    points = points_of({"normal": np.tile(normal, (5, 1)), "view": view, **metal})
    light = EnvironmentLight.from_radiance(map_).prefilter()
    mirror, dominant = (
        np.linalg.norm(SplitSum().shade(points, light, options).specular.numpy()[0] - truth)
        for options in (PLAIN, replace(PLAIN, dominant=True))
    )
    assert dominant < (0.8 if roughness < 0.6 else 0.5) * mirror


@pytest.mark.parametrize("rays", [3, slow(1)])
def test_derivatives_of_mi_render(rays: int, tmp_path: Path) -> None:
    options: dict[str, Any] = {"dominant": True, "diffuse": "irradiance", "visibility_rays": rays}
    check_derivatives(scene(mesh=plane_mesh(tmp_path), traced_bounces=2, **options), "integrator.light")
