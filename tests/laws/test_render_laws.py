"""What mi.render does not depend on, and what it may not exceed: adjoints, turned lights, energy."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mi_refgs.kernels.device import upload_tensor
from mi_refgs.shade.light.envmap import EnvironmentLight
from tests.laws.law_scenes import (
    COUNT,
    FOCAL,
    HEIGHT,
    LIGHT_ROWS,
    SCENES,
    SEEDS,
    WIDTH,
    Scene,
    random_scene,
    rotated,
)
from tests.scenes.integrator import plane_mesh, sky

SETTINGS: dict[str, dict[str, Any]] = {
    "deferred, with a mesh": {"aovs": "n:normal,d:depth,a:alpha,r:roughness"},
    "at surfels": {"shade_at": "surfel", "diffuse": "irradiance"},
    "colour": {"reflectance": "radiance"},
}
ADJOINT = 1e-5  # |⟨δ, Jv⟩ - ⟨Jᵀδ, v⟩| over |δ| |Jv|: float32 sums of a few hundred products


def camera(scene: Scene) -> dict[str, Any]:
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "pixel_format": "rgba"}
    return {
        "type": "perspective",
        "fov": float(2 * np.degrees(np.arctan(WIDTH / 2 / FOCAL))),
        "to_world": mi.ScalarTransform4f(scene.view.to_world),
        "film": film | {"rfilter": {"type": "box"}},
        "sampler": {"type": "independent", "sample_count": 1},
    }


def loaded(scene: Scene, light: Any, **changes: Any) -> mi.Scene:
    channels = {name: upload_tensor(values) for name, values in scene.raw.items()}
    integrator = {"type": "refgs", **channels, "light": light} | changes
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": camera(scene)})


def picture(*arguments: Any, **changes: Any) -> np.ndarray:
    return mi.render(loaded(*arguments, **changes)).numpy().astype(np.float64)


def envmap(radiance: np.ndarray, turn: np.ndarray | None = None) -> dict[str, Any]:
    to_world = np.eye(4)
    to_world[:3, :3] = np.eye(3) if turn is None else turn
    bitmap = mi.Bitmap(np.ascontiguousarray(radiance, np.float32))
    return {"type": "envmap", "bitmap": bitmap, "to_world": mi.ScalarTransform4f(to_world)}


@cache
def shared(setting: str) -> mi.Scene:
    light = EnvironmentLight.from_radiance(sky(LIGHT_ROWS)).raw
    with TemporaryDirectory() as folder:
        mesh = {"mesh": plane_mesh(Path(folder))} if "mesh" in setting else {}
        return loaded(random_scene(0), light, **mesh, **SETTINGS[setting])


@pytest.mark.parametrize("setting", SETTINGS)
@settings(max_examples=3)
@given(scene=SCENES, seed=SEEDS)
def test_reverse_mode_is_the_transpose_of_forward_mode(setting: str, scene: Scene, seed: int) -> None:
    """⟨δ, Jv⟩ = ⟨Jᵀδ, v⟩ for every parameter alone and for all at once."""
    of, rng = shared(setting), np.random.default_rng(seed)
    params = mi.traverse(of)
    values = {f"integrator.{name}": raw for name, raw in scene.raw.items()}
    values["integrator.light"] = rng.normal(size=(LIGHT_ROWS, 2 * LIGHT_ROWS, 3)).astype(np.float32)
    tangents = {key: rng.normal(size=value.shape).astype(np.float32) for key, value in values.items()}

    def rendered() -> tuple[dict[str, Any], Any]:
        leaves = {key: upload_tensor(value) for key, value in values.items()}
        dr.enable_grad(list(leaves.values()))
        for key, leaf in leaves.items():
            params[key] = leaf
        params.update()
        return leaves, mi.render(of, params)

    leaves, image = rendered()
    δ = rng.normal(size=image.shape).astype(np.float32)
    dr.backward(dr.sum(image * upload_tensor(δ), axis=None))
    slopes = {key: dr.grad(leaf).numpy().astype(float) for key, leaf in leaves.items()}
    reverse = {key: float(np.sum(slope * tangents[key])) for key, slope in slopes.items()}

    for keys in [*([key] for key in values), list(values)]:
        leaves, image = rendered()
        for key in keys:
            dr.set_grad(leaves[key], upload_tensor(tangents[key]))
        forward = dr.forward_to(image).numpy().astype(float)
        error = abs(np.sum(forward * δ) - sum(reverse[key] for key in keys))
        assert error <= ADJOINT * np.linalg.norm(δ) * np.linalg.norm(forward), keys


@given(scene=SCENES, seed=SEEDS)
def test_the_world_has_no_preferred_direction(scene: Scene, seed: int) -> None:
    turn = Rotation.random(random_state=seed)
    still = picture(scene, envmap(sky(LIGHT_ROWS)), diffuse="irradiance")
    turned = picture(rotated(scene, turn), envmap(sky(LIGHT_ROWS), turn.as_matrix()), diffuse="irradiance")
    # Positions, quaternions and camera are rounded anew; at a cut a pixel may change sides.
    assert np.mean(np.any(np.abs(turned - still) > 5e-4, axis=2)) <= 0.01


@given(
    scene=SCENES,
    albedo=st.floats(0, 1),
    metallic=st.sampled_from([0.0, 0.5, 1.0]),
    roughness=st.floats(0, 1),
    dominant=st.booleans(),
    shade_at=st.sampled_from(["pixel", "surfel"]),
)
def test_no_more_light_leaves_than_arrives(
    scene: Scene, albedo: float, metallic: float, roughness: float, **options: Any
) -> None:
    """Under a constant light of 1 no pixel shows more than 1 (by 1e-3), whatever its material."""

    def logit(x: float) -> float:
        return float(np.log(max(x, 1e-12)) - np.log(max(1 - x, 1e-12)))

    uniform = scene.changed(
        albedo=np.full((COUNT, 3), logit(albedo)),
        metallic=np.full((COUNT, 1), logit(metallic)),
        roughness=np.full((COUNT, 1), logit(roughness)),
    )
    light = EnvironmentLight.constant(1.0, LIGHT_ROWS).raw
    rgba = picture(uniform, light, diffuse="irradiance", **options)
    assert rgba.min() >= 0
    # Lookups are bilinear, a prefiltered 1 is 1 ± 1e-4.
    assert np.all(rgba[..., :3] <= rgba[..., 3:] * (1 + 1e-3) + 1e-5)
