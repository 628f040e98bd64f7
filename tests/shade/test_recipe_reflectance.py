"""CONTRIBUTING's recipe "add a reflectance model", followed: Lambert and Phong under a light.

One channel, one class and two `register`s are all that is added.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import mi_refgs
from mi_refgs.cli import main
from mi_refgs.io.exr import write_exr
from mi_refgs.shade import reflectance
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.points import RadianceTerms, ShadingPoints, reflect, safe_normalize
from mi_refgs.shade.reflectance import Reflectance, SurfelView
from mi_refgs.surfels import attributes
from mi_refgs.surfels.attributes import Attribute
from mi_refgs.surfels.ply import read_ply
from mi_refgs.surfels.table import Surfels
from tests.helpers import refused
from tests.scenes.integrator import check_derivatives, image, raw_channels, scene
from tests.scenes.tiny import train_command, write_data

SHININESS = Attribute("shininess", (1,), "sigmoid", 0.02, ("shininess",), initial=0.5, aov="Y")
SHARE = 0.3  # of the light that the lobe reflects


class Phong(Reflectance):
    """albedo irradiance(n), and a lobe about the mirror direction that narrows with the shininess."""

    name = "phong"

    def required_attributes(self, options: ShadingOptions) -> tuple[str, ...]:
        return ("albedo", "shininess")

    def values(self, surfels: Surfels, seen: SurfelView, options: ShadingOptions) -> dict[str, Any]:
        return {name: surfels.value(name) for name in self.required_attributes(options)}

    def shade(self, points: ShadingPoints, light: Any, options: ShadingOptions) -> RadianceTerms:
        normal, view = safe_normalize(points.normal), safe_normalize(points.view)
        lobe = light.specular(reflect(view, normal), 1 - points.shininess)
        return RadianceTerms(points.albedo * light.irradiance(normal), SHARE * lobe)


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


@pytest.fixture(autouse=True)
def phong() -> Iterator[None]:
    attributes.register(SHININESS)
    reflectance.register(Phong())
    reflectance.register(Velvet())
    yield
    reflectance.unregister("velvet")
    if "phong" in reflectance.MODELS:
        reflectance.unregister("phong")
    if "shininess" in attributes.ATTRIBUTES:
        attributes.ATTRIBUTES.unregister("shininess")


class Velvet(Phong):
    """Phong's model, of all materials."""

    name = "velvet"

    def required_attributes(self, options: ShadingOptions) -> tuple[str, ...]:
        return ("albedo", "metallic", "roughness", "shininess")


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


def test_the_picture_is_what_the_model_says() -> None:
    """Under a constant light of 1 the radiance is albedo + SHARE: blending is linear."""
    white = {"type": "constant", "radiance": 1.0}
    of = scene(raw=raw(), reflectance="phong", shade_at="surfel", aovs="n:albedo,a:alpha", light=white)
    seen = image(of)
    alpha = seen[..., -1:]
    full = alpha[..., 0] > 0.1
    assert full.sum() > 20
    expected = alpha * (seen[..., -4:-1] + SHARE)
    np.testing.assert_allclose(seen[full][:, :3], expected[full], rtol=2e-3)


def test_a_method_fits_it_and_a_run_keeps_it(tmp_path: Path) -> None:
    """`refgs train` with a table that names it; the exported surfels have the channel, and it has moved."""
    (tmp_path / "own.toml").write_text(METHOD)
    data = write_data(tmp_path / "data")
    assert main(train_command(data, tmp_path / "run", tmp_path / "own.toml")) == 0
    fitted = read_ply(tmp_path / "run" / "surfels.ply")
    assert fitted.has("shininess") and not fitted.has("roughness")
    moved = fitted.to_numpy()["shininess"]
    assert np.isfinite(moved).all() and np.ptp(moved) > 0
    rendered = mi.render(mi.load_file(str(tmp_path / "run" / "scene.xml")), spp=1).numpy()
    assert np.isfinite(rendered).all() and rendered.max() > 0.1
    # Without what it needs, the run is whole, and nothing is to be written or removed.
    reflectance.unregister("phong")
    command = ["train", data, "-o", tmp_path / "run", "--resume"]
    view = ["render", tmp_path / "run", "-o", tmp_path / "view.exr"]
    assert "export" not in refused(view, "model.json", "'phong' is unknown", "register it")
    reflectance.register(Phong())
    attributes.ATTRIBUTES.unregister("shininess")
    assert "export" not in refused(view, "model.json", "'shininess' is unknown", "register it")
    assert "damaged" not in refused(command, "0000006.npz: surfels: shininess", "register it")


def test_runs_of_a_model_of_all_materials_are_scored_and_relit(tmp_path: Path) -> None:
    """No SH colour is converted to an albedo where the model does not use it."""
    needed = '"albedo", "metallic", "roughness", "shininess"'
    text = METHOD.replace('"albedo", "shininess"', needed).replace("phong", "velvet")
    (tmp_path / "own.toml").write_text(text)
    data = write_data(tmp_path / "data")
    assert main(train_command(data, tmp_path / "run", tmp_path / "own.toml")) == 0
    run = mi_refgs.load(tmp_path / "run")
    assert run.evaluate()["psnr"] > 0
    write_exr(tmp_path / "sky.exr", np.full((4, 8, 3), 0.5, np.float32))
    relit = run.relight(tmp_path / "sky.exr")
    assert np.isfinite(relit.render(0)).all()
    fitted = run.trained.surfels.to_numpy()["albedo"]
    assert np.array_equal(relit.trained.surfels.to_numpy()["albedo"], fitted)


@pytest.mark.parametrize("aov, widths", [("S", (1,)), ("RGB", (1,)), ("Y", (3,))])
def test_suffixes_of_an_aov_are_those_of_its_columns(aov: str, widths: tuple[int, ...]) -> None:
    wrong = Attribute("sheen", widths, "sigmoid", 0.02, ("sheen",) * widths[0], aov=aov)
    refused(lambda: attributes.register(wrong), "attribute 'sheen': aov: ", "columns; use Mitsuba's")
