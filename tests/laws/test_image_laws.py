"""Laws of images: what they do not depend on, what they may not exceed, and that derivatives are linear."""

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st
from scipy.spatial.transform import Rotation

from mi_refgs import constants
from mi_refgs.constants import ALPHA_MIN
from mi_refgs.kernels.device import upload_tensor
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.shading import Shading
from tests.helpers import with_grad
from tests.laws import law_scenes
from tests.laws.law_scenes import COUNT, SCENES, SEEDS, SHADINGS, Scene, View, differing, draw, gradients
from tests.scenes.integrator import plane_mesh, sky

ROWS = law_scenes.LIGHT_ROWS
EXACT = 2e-6  # between images of the same float32 arithmetic, but for fused operations and equal sums' order
GRADIENT = 1e-4  # relative L2 between gradients: sums by scatter come in any order
SILHOUETTE = 0.251  # |cos| to the ray up to which a normal may point away from the camera
BOTH = pytest.mark.parametrize("shading", SHADINGS, ids=("pixel", "surfel"))


def assert_same_rows(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> None:
    for name, values in a.items():
        assert np.linalg.norm(values - b[name]) <= GRADIENT * np.linalg.norm(b[name]) + 1e-7, name


@BOTH
@given(scene=SCENES, seed=SEEDS)
def test_order_in_memory_does_not_matter(shading: Shading, scene: Scene, seed: int) -> None:
    order = np.random.default_rng(seed).permutation(COUNT)
    permuted = scene.with_rows(order)
    assert differing(draw(permuted, shading), draw(scene, shading), EXACT) == 0
    before, after = (gradients(s, shading, seed) for s in (scene, permuted))
    assert_same_rows(after, {name: values[order] for name, values in before.items()})


def culled(scene: Scene, kind: str, seed: int) -> dict[str, np.ndarray]:
    """As many surfels again, none of which covers a pixel."""
    rng = np.random.default_rng(seed)
    raw = {name: values.copy() for name, values in scene.raw.items()}
    forward, origin = scene.view.to_world[:3, 2], scene.view.to_world[:3, 3]
    if kind == "behind":
        depth = (raw["position"] - origin) @ forward
        raw["position"] -= (depth + rng.uniform(0.5, 3, COUNT))[:, None] * forward
    elif kind == "transparent":
        raw["opacity"][:] = np.log(ALPHA_MIN) - rng.uniform(0.01, 20, (COUNT, 1))
    elif kind == "edge-on":  # its normal is perpendicular to the ray to its centre, t_u along that ray
        ray = raw["position"] - origin
        across = np.cross(ray, rng.normal(size=(COUNT, 3)))
        axes = np.stack([ray, np.cross(across, ray), across], axis=-1)
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        raw["rotation"][:] = Rotation.from_matrix(axes).as_quat()
    else:  # outside the image
        side = scene.view.to_world[:3, 0] * rng.choice([-1, 1], (COUNT, 1))
        raw["position"] += side * rng.uniform(50, 500, (COUNT, 1))
        raw["scale"][:] = np.log(0.1)
    return {name: values.astype(np.float32) for name, values in raw.items()}


@BOTH
@given(scene=SCENES, kind=st.sampled_from(["behind", "transparent", "edge-on", "beside"]), seed=SEEDS)
def test_culled_surfels_change_nothing(shading: Shading, scene: Scene, kind: str, seed: int) -> None:
    assume(kind != "edge-on" or scene.raw["scale"].shape[1] == 2)  # a 3D Gaussian has no edge
    place = np.random.default_rng(seed).permutation(2 * COUNT)
    added = culled(scene, kind, seed)
    more = Scene({n: np.concatenate([v, added[n]])[place] for n, v in scene.raw.items()}, scene.view)
    assert differing(draw(more, shading), draw(scene, shading), EXACT) == 0
    before, after = (gradients(s, shading, seed) for s in (scene, more))
    back = np.argsort(place)
    assert_same_rows({name: values[back[:COUNT]] for name, values in after.items()}, before)
    assert all(np.all(values[back[COUNT:]] == 0) for values in after.values())


@BOTH
@given(scene=SCENES, seed=SEEDS)
def test_zero_opacity_equals_removal(shading: Shading, scene: Scene, seed: int) -> None:
    """Exactly below α_min; and just above it by less than it shows, 1/255 a surfel."""
    rng = np.random.default_rng(seed)
    gone = rng.random(COUNT) < 0.5
    removed = draw(scene.with_rows(np.flatnonzero(~gone)), shading)
    opacity = scene.raw["opacity"].copy()
    opacity[gone] = np.log(ALPHA_MIN) - rng.uniform(0, 20, (gone.sum(), 1))
    assert differing(draw(scene.changed(opacity=opacity), shading), removed, EXACT) == 0
    opacity[np.flatnonzero(gone)[:1]] = np.log(ALPHA_MIN) + 0.01
    faint = draw(scene.changed(opacity=opacity), shading)["alpha"]
    assert np.abs(faint - removed["alpha"]).max() <= 1.02 * ALPHA_MIN


@BOTH
@given(scene=law_scenes.DISCS, seed=SEEDS)
def test_a_disc_has_no_front_and_no_first_axis(shading: Shading, scene: Scene, seed: int) -> None:
    """Turned over, turned by a half about its normal, axes exchanged, quaternions of the other sign: the same
    image. Discs near the silhouette, whose normals stay as they are, are not turned over."""
    rng = np.random.default_rng(seed)
    turn, scale = Rotation.from_quat(scene.raw["rotation"]), scene.raw["scale"].copy()
    ray = scene.raw["position"] - scene.view.to_world[:3, 3]
    cosine = np.sum(turn.apply([0, 0, 1]) * ray, axis=1) / np.linalg.norm(ray, axis=1)
    over = (np.abs(cosine) > SILHOUETTE) & (rng.random(COUNT) < 0.5)
    turn = turn * Rotation.from_rotvec(np.pi * over[:, None] * [1, 0, 0])
    quarters = rng.integers(0, 4, COUNT)
    turn = turn * Rotation.from_rotvec(np.pi / 2 * quarters[:, None] * [0, 0, 1])
    scale[quarters % 2 == 1] = scale[quarters % 2 == 1, ::-1]
    rotation = turn.as_quat() * rng.choice([-1, 1], (COUNT, 1)) * rng.uniform(0.1, 10, (COUNT, 1))
    other = draw(scene.changed(rotation=rotation, scale=scale), shading)
    # Quaternions are rounded anew; at a cut a pixel may change sides.
    assert differing(other, draw(scene, shading), 2e-4) <= 0.01


@given(seed=SEEDS, tile=st.sampled_from([size for _, size in constants.TILE_SIZES]))
def test_tiles_do_not_show(seed: int, tile: tuple[int, int]) -> None:
    """Layers whose planes keep their order within the reach of the sort: any tile sorts them alike."""
    rng = np.random.default_rng(seed)
    z = 3 + 0.1 * rng.permutation(COUNT)
    position = np.stack([*(0.15 * z * rng.normal(size=(2, COUNT))), z], axis=1)
    tilt = rng.normal(size=(COUNT, 3)) * [0.04, 0.04, 1]  # σ sin θ is far below the layers' distance
    rotation = Rotation.from_rotvec(tilt).as_quat()
    layers = law_scenes.random_scene(seed, size=0.3, opacity=1.0)
    scene = Scene(layers.changed(position=position, rotation=rotation).raw, View(np.eye(4)))
    shipped = draw(scene)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(constants, "TILE_SIZES", ((np.inf, tile),))
        assert scene.view.camera().tile == tile
        assert differing(draw(scene), shipped, EXACT) == 0


@BOTH
@given(scene=SCENES, decades=st.floats(-6, 6))
def test_units_do_not_matter(shading: Shading, scene: Scene, decades: float) -> None:
    factor = 10**decades
    pose = scene.view.to_world.copy()
    pose[:3, 3] *= factor
    larger = scene.changed(position=scene.raw["position"] * factor, scale=scene.raw["scale"] + np.log(factor))
    scaled = draw(Scene(larger.raw, View(pose, scene.view.near * factor)), shading)
    scaled["depth"] /= factor
    # Positions and log scales are rounded anew; at a cut a pixel may change sides.
    assert differing(scaled, draw(scene, shading), 2e-4) <= 0.01


@BOTH
@settings(max_examples=4)
@given(scene=SCENES, seed=SEEDS)
def test_view_does_not_depend_on_other_views(shading: Shading, scene: Scene, seed: int) -> None:
    """Gradients of views one by one add up to those of a set, and an image is the same in any set."""
    views = [scene.view, *map(scene.view.turned, Rotation.random(2, random_state=seed))]
    alone = draw(scene, shading)
    parts = [gradients(scene, shading, seed, (view,)) for view in views]
    together = gradients(scene, shading, seed, tuple(views))
    assert_same_rows(together, {name: np.sum([part[name] for part in parts], axis=0) for name in together})
    assert differing(draw(scene, shading), alone, 0) == 0


SETTINGS: dict[str, dict[str, Any]] = {
    "deferred, with a mesh": {"aovs": "n:normal,d:depth,a:alpha,r:roughness"},
    "at surfels": {"shade_at": "surfel", "diffuse": "irradiance"},
    "colour": {"reflectance": "radiance"},
}
ADJOINT = 1e-5  # |⟨δ, Jv⟩ - ⟨Jᵀδ, v⟩| over |δ| |Jv|: float32 sums of a few hundred products


def loaded(scene: Scene, light: Any, **changes: Any) -> "mi.Scene":
    channels = {name: upload_tensor(values) for name, values in scene.raw.items()}
    integrator = {"type": "refgs", **channels, "light": light} | changes
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": scene.view.sensor()})


def picture(*arguments: Any, **changes: Any) -> np.ndarray:
    return mi.render(loaded(*arguments, **changes)).numpy().astype(np.float64)


def envmap(radiance: np.ndarray, turn: np.ndarray | None = None) -> dict[str, Any]:
    to_world = np.eye(4)
    to_world[:3, :3] = np.eye(3) if turn is None else turn
    bitmap = mi.Bitmap(np.ascontiguousarray(radiance, np.float32))
    return {"type": "envmap", "bitmap": bitmap, "to_world": mi.ScalarTransform4f(to_world)}


@cache
def shared(setting: str) -> "mi.Scene":
    light = EnvironmentLight.from_radiance(sky(ROWS)).raw
    with TemporaryDirectory() as folder:
        mesh = {"mesh": plane_mesh(Path(folder))} if "mesh" in setting else {}
        return loaded(law_scenes.random_scene(0), light, **mesh, **SETTINGS[setting])


@pytest.mark.parametrize("setting", SETTINGS)
@settings(max_examples=3)
@given(scene=SCENES, seed=SEEDS)
def test_reverse_mode_is_the_transpose_of_forward_mode(setting: str, scene: Scene, seed: int) -> None:
    """⟨δ, Jv⟩ = ⟨Jᵀδ, v⟩ for every parameter alone and for all at once."""
    of, rng = shared(setting), np.random.default_rng(seed)
    params = mi.traverse(of)
    values = {f"integrator.{name}": raw for name, raw in scene.raw.items()}
    values["integrator.light"] = rng.normal(size=(ROWS, 2 * ROWS, 3)).astype(np.float32)
    tangents = {key: rng.normal(size=value.shape).astype(np.float32) for key, value in values.items()}

    def rendered() -> tuple[dict[str, Any], Any]:
        leaves = with_grad({key: upload_tensor(value) for key, value in values.items()})
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
    still = picture(scene, envmap(sky(ROWS)), diffuse="irradiance")
    other = envmap(sky(ROWS), turn.as_matrix())
    turned = picture(law_scenes.rotated(scene, turn), other, diffuse="irradiance")
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
    rgba = picture(uniform, EnvironmentLight.constant(1.0, ROWS).raw, diffuse="irradiance", **options)
    assert rgba.min() >= 0
    # Lookups are bilinear, a prefiltered 1 is 1 ± 1e-4.
    assert np.all(rgba[..., :3] <= rgba[..., 3:] * (1 + 1e-3) + 1e-5)
