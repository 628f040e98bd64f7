"""CONTRIBUTING's recipe "add a reflectance model", followed: Phong's, by one attribute and one class."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs import Reconstruction
from mi_refgs.cli import main
from mi_refgs.evaluation.decomposition import material_maps
from mi_refgs.evaluation.images import RenderedView
from mi_refgs.formats.baking import bake
from mi_refgs.formats.format import Shot
from mi_refgs.methods.method import APART
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade import reflectance
from mi_refgs.shade.light.constant import ConstantLight
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.options import QUALITY, ShadingOptions
from mi_refgs.shade.points import RadianceTerms, ShadingPoints, reflect, safe_normalize
from mi_refgs.shade.reflectance import Reflectance, SurfelView, TraceContext
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera
from mi_refgs.surfels import attributes
from mi_refgs.surfels.attributes import Attribute
from mi_refgs.surfels.ply import read_ply
from mi_refgs.surfels.table import Surfels
from tests.helpers import refused
from tests.scenes.corner import floor_points, seen, wall_surfels
from tests.scenes.integrator import check_derivatives, image, plane_mesh, raw_channels, scene
from tests.scenes.known import known_mesh, known_surfels
from tests.scenes.tiny import train_command, write_data, write_method

SHININESS = Attribute("shininess", (1,), "sigmoid", 0.02, ("shininess",), initial=0.5, aov="Y")
SHARE = 0.3  # of the light that the lobe reflects


class Phong(Reflectance):
    """albedo irradiance(n), and a lobe about the mirror direction, narrower with the shininess, that the mesh
    blocks, and is shaded where it does. Other programs show a rough dielectric."""

    name = "phong"
    visibility = "mirror"
    honoured = ("traced_bounces",)

    def required_attributes(self, options: ShadingOptions) -> tuple[str, ...]:
        return ("albedo", "shininess")

    def values(self, surfels: Surfels, seen: SurfelView, options: ShadingOptions) -> dict[str, Any]:
        return {name: surfels.value(name) for name in self.required_attributes(options)}

    def shade(self, points: ShadingPoints, light: Any, options: ShadingOptions) -> RadianceTerms:
        normal, view = safe_normalize(points.normal), safe_normalize(points.view)
        lobe, indirect = SHARE * light.specular(reflect(view, normal), 1 - points.shininess), None
        if points.get("indirect") is not None:
            indirect = SHARE * (1 - points.visibility) * points.indirect
            lobe *= points.visibility
        return RadianceTerms(points.albedo * light.irradiance(normal), lobe, indirect)

    def textures(self, values: Mapping[str, Any]) -> dict[str, Any]:
        dull = 1 - values["shininess"]
        return {"albedo": values["albedo"], "metallic": 0 * dull, "roughness": dull}


METHOD = """
iterations = 2000
[surfels]
attributes = ["albedo", "shininess"]
[light]
height = 8
[stage.only]
until = 2000
reflectance = "phong"
"""


@contextmanager
def registered(registry: Any, item: Any) -> Iterator[None]:
    registry.register(item)
    yield
    registry.unregister(item.name)


@pytest.fixture(autouse=True)
def phong() -> Iterator[None]:
    with registered(attributes.ATTRIBUTES, SHININESS), registered(reflectance.MODELS, Phong()):
        yield


def raw() -> dict[str, np.ndarray]:
    """Geometry and albedo of the usual discs, and their shininess."""
    usual = raw_channels()
    kept = {name: usual[name] for name in ("position", "rotation", "scale", "opacity", "albedo")}
    return kept | {"shininess": 0.3 * usual["metallic"]}


@pytest.mark.parametrize("order", ["pixel", "surfel"])
def test_the_plugin_renders_and_differentiates_it(order: str) -> None:
    """Chosen by its name alone, in both orders, with an AOV of its channel; slopes by differences."""
    of = scene(raw=raw(), reflectance="phong", shade_at=order, aovs="sh:shininess")
    assert np.ptp(image(of)[..., -1]) > 0.1, "the AOV shows the attribute"
    check_derivatives(of, "integrator.shininess")


def test_a_method_fits_it_and_a_run_keeps_it(tmp_path: Path) -> None:
    """`refgs train` with a table that names it; the exported surfels have the channel, and it has moved."""
    data, own = write_data(tmp_path / "data"), write_method(tmp_path, METHOD)
    assert main(train_command(data, tmp_path / "run", own)) == 0
    fitted = read_ply(tmp_path / "run" / "surfels.ply")
    assert fitted.has("shininess") and not fitted.has("roughness")
    moved = fitted.to_numpy()["shininess"]
    assert np.isfinite(moved).all() and np.ptp(moved) > 0
    rendered = mi.render(mi.load_file(str(tmp_path / "run" / "scene.xml")), spp=1).numpy()
    assert np.isfinite(rendered).all() and rendered.max() > 0.1


def test_it_shades_what_traced_rays_hit() -> None:
    """Under a light of 1 the floor of a corner sees albedo + SHARE, or albedo where the lobe is blocked."""
    place, points = floor_points(0.3, count=40)
    materials = wall_surfels()
    kept = {name: x for name, x in materials.raw.items() if name not in ("metallic", "roughness")}
    surfels = Surfels(kept | {"shininess": mi.TensorXf(materials.raw["roughness"])})
    options = ShadingOptions(reflectance="phong", traced_bounces=1)
    found = seen(points, place, options, surfels, ConstantLight(mi.Color3f(1)))  # type: ignore[arg-type]
    blocked = np.array(found.visibility) == 0
    albedo = 1 / (1 + np.exp(-materials.raw["albedo"].numpy()[0]))
    assert 0 < blocked.sum() < 40
    lit = found.indirect.numpy().T[blocked]
    assert all(np.allclose(x, albedo + SHARE, rtol=1e-4) or np.allclose(x, albedo, rtol=1e-4) for x in lit)


@pytest.mark.parametrize("aov", ["Y", ""])
def test_textures_are_baked_and_compared(aov: str) -> None:
    """What a model says of itself reaches textures and the maps that evaluations compare, shown or not."""
    attributes.ATTRIBUTES.unregister("shininess")
    attributes.register(replace(SHININESS, aov=aov))
    raw = {name: x for name, x in known_surfels().raw.items() if name != "metallic"}
    raw["shininess"] = raw.pop("roughness")
    light, shading = EnvironmentLight.constant(0.5, 8), Shading(reflectance="phong", diffuse="irradiance")
    scene = TrainedScene(Surfels(raw), light, known_mesh(), shading, 1, 0.0)
    camera = Camera.look_at([0.3, -3, 1], size=32)
    baked = bake(scene, (Shot("a", "train", camera),), 200, 16)
    shown = 1 / (1 + np.exp(-raw["shininess"].numpy()))
    assert np.all(baked.metallic == 0)
    assert abs(baked.roughness.mean() - (1 - shown.mean())) < 0.1
    rendered = RenderedView.maps_of(scene.renderer()(camera), 32, 32)
    view = RenderedView(np.zeros((32, 32, 3)), np.zeros((32, 32)), np.zeros((32, 32, 3)), rendered)
    np.testing.assert_array_equal(material_maps(scene)(camera, view)["roughness"], 1 - rendered["shininess"])


class Traced(Phong):
    """Rays of its own, whose result is not the visibility; an attribute of two columns, used as a vector."""

    name = "traced"
    visibility = "own"  # type: ignore[assignment]
    honoured = ()  # type: ignore[assignment]

    def required_attributes(self, options: ShadingOptions) -> tuple[str, ...]:
        return ("albedo", "shininess", "brushed")

    def trace(self, points: ShadingPoints, context: TraceContext, options: ShadingOptions) -> ShadingPoints:
        start, normal, hit = context.start(points.normal)
        return points.replaced(open=context.occluder.visible(start, normal, normal, hit))

    def shade(self, points: ShadingPoints, light: Any, options: ShadingOptions) -> RadianceTerms:
        return RadianceTerms(points.albedo * dr.norm(points.brushed) * dr.select(points.open, 1.0, 0.5))


@pytest.mark.parametrize("order", ["pixel", "surfel"])
def test_a_model_may_trace_its_own_rays(order: str, tmp_path: Path) -> None:
    brushed = Attribute("brushed", (2,), "identity", 0.01, ("brushed_0", "brushed_1"))
    with registered(attributes.ATTRIBUTES, brushed), registered(reflectance.MODELS, Traced()):
        own = raw() | {"brushed": np.full((len(raw()["albedo"]), 2), 0.6, np.float32)}
        of = scene(raw=own, reflectance="traced", shade_at=order, mesh=plane_mesh(tmp_path), antialias=False)
        expected, sensor = image(of), of.sensors()[0]
        found = Reconstruction.from_params(of).aovs(sensor, ["normal", "diffuse"])
        assert np.ptp(expected) > 0.1
        np.testing.assert_allclose(found["diffuse"], expected, atol=1e-5)


@pytest.mark.parametrize("aov, widths", [("S", (1,)), ("RGB", (1,)), ("Y", (3,))])
def test_suffixes_of_an_aov_are_those_of_its_columns(aov: str, widths: tuple[int, ...]) -> None:
    wrong = Attribute("sheen", widths, "sigmoid", 0.02, ("sheen",) * widths[0], aov=aov)
    refused(lambda: attributes.register(wrong), "attribute 'sheen': aov: ", "columns; use Mitsuba's")


@pytest.mark.parametrize(
    "change, message",
    [
        ({"name": "specular"}, "attribute 'specular': the name is taken"),  # one of the image's own maps
        ({"activation": "softplus"}, "'softplus' is unknown; use identity or exp or sigmoid or harmonics"),
        ({"widths": 1}, "widths, properties: not tuples"),
        ({"properties": "sheen"}, "widths, properties: not tuples"),
        ({"properties": ("the sheen",)}, "properties: not tuples, or not of names; write (1,)"),
        ({"widths": (3,)}, "properties: 1 for 3 columns; name one for each"),
        ({"properties": ("x",)}, "'position' has its PLY property"),
    ],
)
def test_attributes_that_no_file_or_fit_keeps_are_refused(change: dict[str, Any], message: str) -> None:
    sheen = Attribute("sheen", (1,), "sigmoid", 0.02, ("sheen",))
    refused(lambda: attributes.register(replace(sheen, **change)), message)
    assert {*APART, *QUALITY} <= {*attributes.RESERVED}
