"""Materials of a run that can be relit: recovered, required, kept."""

from functools import partial
from pathlib import Path

import drjit as dr
import numpy as np
import pytest

from mi_refgs.runs.relightable import relightable
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.attributes import SH_DC
from mi_refgs.surfels.table import Surfels
from tests.helpers import refused
from tests.scenes.known import CLAY, METAL, known_mesh, known_scene, known_surfels


@pytest.mark.parametrize("with_mesh", [False, True])
def test_relightable_recovers_albedo_from_fitted_radiance(known: Path, with_mesh: bool) -> None:
    """A radiance that changes with direction, (1 - S) albedo × irradiance on average over the hemisphere."""
    mesh, surfels = known_mesh() if with_mesh else None, known_surfels()
    light = EnvironmentLight.from_file(known / "data/environment.exr")
    normal = surfels.primitive.normal(surfels)
    irradiance = light.prefilter().irradiance(normal).numpy().T
    raw = surfels.to_numpy()
    clay = raw["metallic"][:, 0] < 0
    truth = np.where(clay[:, None], CLAY["albedo"], METAL["albedo"])
    slope = np.random.default_rng(0).normal(0, 0.03, (len(truth), 3, 3))  # of each colour along x, y, z
    # A linear function has two thirds of its largest value as its cosine-weighted mean.
    mean = -np.einsum("ncx,nx->nc", slope, normal.numpy().T) * 2 / 3
    constant = (0.96 * irradiance * truth - mean - 0.5) / SH_DC
    linear = -slope[:, :, [1, 2, 0]] * [1, -1, 1] / np.sqrt(3 / (4 * np.pi))
    raw["radiance_sh"] = np.concatenate([constant, linear.transpose(0, 2, 1).reshape(-1, 9)], 1).astype("f4")
    others = dict.fromkeys(("albedo", "indirect_sh", "residual_sh"), np.zeros((len(truth), 3), np.float32))
    scene = TrainedScene(Surfels.from_numpy(raw | others), light, mesh, Shading(occlusion=with_mesh), 1, 0.0)
    found = relightable(scene)
    assert set(found.surfels.raw) == set(raw) - {"radiance_sh"}
    assert found.shading.diffuse == "irradiance" and found.light is light
    assert (found.shading.ambient_rays > 0) == with_mesh
    albedo = np.array(found.surfels.value("albedo")).T
    far = np.abs(np.array(surfels.position()).T[:, 0]) > 0.45  # from the other ball
    np.testing.assert_allclose(albedo[clay & far], truth[clay & far], atol=0.04)
    np.testing.assert_allclose(albedo[~clay], 0.5, atol=0.01)  # of metals, the fitted attribute


def test_relightable_requires_materials_and_light() -> None:
    surfels = known_surfels()
    raw = {name: x for name, x in surfels.raw.items() if name != "metallic"}
    light = EnvironmentLight.constant(0.5, 8)
    for scene, words in (
        (TrainedScene(surfels, None, None, Shading(), 1, 0.0), "light: the run has none"),
        (TrainedScene(Surfels(raw), light, None, Shading(), 1, 0.0), "metallic: the run"),
        (TrainedScene(surfels, light, None, Shading("surfel", "radiance"), 1, 0.0), "reflectance: radiance"),
        (TrainedScene(surfels, light, None, Shading("pixel", "mirror"), 1, 0.0), "reflectance: mirror"),
    ):
        refused(partial(relightable, scene), words)


def test_relightable_keeps_fitted_materials() -> None:
    scene = known_scene()
    found = relightable(scene)
    for name in ("albedo", "metallic", "roughness", "position"):
        assert dr.all(found.surfels.raw[name].array == scene.surfels.raw[name].array)
