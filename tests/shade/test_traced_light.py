"""What blocked mirror rays hit, shaded there: materials on the mesh, radiance, derivatives."""

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.reference import lobe as exact
from mi_refgs.reference.light import specular
from mi_refgs.reference.models import sh_basis
from mi_refgs.shade import reflection
from mi_refgs.shade.ggx_sampling import Lobe
from mi_refgs.shade.light.envmap import EnvironmentLight, PrefilteredLight
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.points import ShadingPoints
from mi_refgs.shade.reflectance.split_sum import MATERIALS, SplitSum
from mi_refgs.surfels.table import Surfels
from tests.helpers import refused, slow, unit, vector, with_grad
from tests.scenes import corner as scenes
from tests.scenes.shading_points import exact_light, exact_terms
from tests.scenes.splats import discs


def test_vertices_mix_surfels_by_opacity_and_footprint() -> None:
    """Three surfels by the formula, exp(-½ (u²/s_u² + v²/s_v² + distance²/voxel²)); one alone far away."""
    position = np.array([[0.2, 0.1, 0.0], [-0.1, 0.3, 0.05], [0.0, -0.4, -0.08]])
    scale = np.array([[0.3, 0.2], [0.25, 0.4], [0.5, 0.3]])
    opacity, colour = np.array([0.9, 0.5, 0.2]), np.array([0.1, 0.5, 0.9])
    logit = np.log(colour / (1 - colour))
    materials = {"albedo": np.tile(logit[:, None], 3), "metallic": logit, "roughness": logit}
    shape = {"scale": np.log(scale), "opacity": np.log(opacity / (1 - opacity))}
    surfels = Surfels.from_numpy(discs(position=position, **shape, **materials))
    vertices = np.array([[0, 0, 0], [0.4, 0, 0], [0, 0.4, 0.1], [50, 0, 0]], np.float32)
    mesh = Mesh(vertices, np.array([[0, 1, 2], [1, 3, 2]], np.uint32), 0.1)
    rows = np.array(scenes.with_materials(mesh, surfels).surface(surfels, MATERIALS).rows).reshape(4, 8)
    for vertex, row in zip(vertices[:3], rows, strict=False):
        u, v, w = (vertex - position).T
        weight = opacity * np.exp(-0.5 * ((u / scale[:, 0]) ** 2 + (v / scale[:, 1]) ** 2 + (w / 0.1) ** 2))
        np.testing.assert_allclose(row[:5], (weight @ colour) / weight.sum(), rtol=1e-4)
    np.testing.assert_allclose(rows[3, :5], 0.1, rtol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(rows[:, 5:], axis=1), 1, rtol=1e-5)


def test_normals_at_vertices_vary_over_the_surfels() -> None:
    """Discs on a sphere with its curvature, and one across: between them, the sphere's normals."""
    around = [[0.3 * np.cos(a), 0.3 * np.sin(a), 1] for a in range(12)]
    towards = unit(np.array([[0, 0, 1], [0, 0, 1], *around]))
    quaternion = np.stack([-towards[:, 1], towards[:, 0], 0 * towards[:, 0], 1 + towards[:, 2]], 1)
    quaternion[0] = [1, 0, 0, 1]  # across
    curved = {"rotation": quaternion, "curvature": np.tile([1.0, 0, 1.0], (14, 1)), "opacity": np.zeros(14)}
    surfels = Surfels.from_numpy(discs(position=towards, scale=np.full((14, 2), np.log(0.3)), **curved))
    ring = [[0.15 * np.cos(a), 0.15 * np.sin(a), 1] for a in np.linspace(0, 6, 20)]
    vertices = unit(np.array([[0, 0, 1], *ring, [0, 0, -1]]))
    faces = np.array([[0, k, k + 1] for k in range(1, 20)], np.uint32)
    mesh = Mesh(vertices.astype(np.float32), faces, 0.1)
    made: Any = scenes.with_materials(mesh, surfels).vertex_surfels
    found = made.normals(surfels).numpy().T[:21]
    assert np.degrees(np.arccos(np.sum(found * vertices[:21], axis=1))).max() < 2.5


def test_misuse_is_refused() -> None:
    occluder, surfels = Occluder(scenes.corner()), scenes.wall_surfels()
    refused(lambda: occluder.surface(surfels), "none are set")
    occluder.set_materials(surfels)
    refused(lambda: occluder.surface(surfels.gather(dr.arange(mi.UInt32, 399))), "399")
    refused(lambda: occluder.set_materials(surfels.gather(mi.UInt32())), "none to take")


def oracle_of_walls(light: PrefilteredLight, surfels: Surfels, diffuse: Any) -> exact.Outgoing:
    """What leaves the walls of a channel, by the float64 `shade`."""
    exact_levels = exact_light(light)
    raw = {name: x.numpy().astype(np.float64)[[0, -1]] for name, x in surfels.raw.items()}
    logits = raw["albedo"], raw["metallic"][:, 0], raw["roughness"][:, 0]
    albedo, metallic, roughness = (1 / (1 + np.exp(-logit)) for logit in logits)

    def outgoing(wall: int, normal: np.ndarray, view: np.ndarray, free: float, beyond: np.ndarray) -> Any:
        own = sh_basis(-view, 1) @ raw["radiance_sh"][wall].reshape(4, 3) + 0.5
        here = {"albedo": albedo[wall], "metallic": metallic[wall], "roughness": roughness[wall]}
        here |= {"radiance": np.maximum(own, 0), "visibility": free, "indirect": beyond}
        values = {n: np.asarray(x)[None] for n, x in (here | {"normal": normal, "view": view}).items()}
        return exact_terms(values, exact_levels, ShadingOptions(diffuse=diffuse)).sum((0, 1))

    return outgoing


def harmonic_channel_surfels(albedo: np.ndarray | None = None, uneven: float = 0.0) -> Surfels:
    """Surfels of a channel with SH colours, those of a wall alike but for `uneven`."""
    rng, surfels = np.random.default_rng(4), scenes.channel_surfels(albedo)
    harmonics = np.repeat(0.2 * rng.normal(size=(2, 12)), 400, 0) + uneven * rng.normal(size=(800, 12))
    return Surfels(surfels.raw | {"radiance_sh": mi.TensorXf(harmonics.astype(np.float32))})


def lengths(place: np.ndarray, directions: np.ndarray) -> list[int]:
    """Number of walls that rays from points of the floor of a channel meet one after the other."""
    found = []
    for origin, direction in zip(place, directions, strict=True):
        count, hit = 0, scenes.wall_hit(origin, direction)
        while hit is not None:
            direction = direction * [-1, 1, 1]
            count, hit = count + 1, scenes.wall_hit(hit[0], direction)
        found.append(count)
    return found


@pytest.mark.parametrize(
    ("bounces", "diffuse"),
    [
        (2, "sh"),
        (3, "irradiance"),
        *(slow(*c) for c in ((1, "sh"), (1, "irradiance"), (2, "irradiance"), (3, "sh"))),
    ],
)
def test_bounces_of_a_mirror_ray_against_the_oracle(bounces: int, diffuse: Any) -> None:
    """Between two walls, recursion in float64: rays that end before the last bounce, and after."""
    place, points = scenes.floor_points(0.3, eye=scenes.LOW_EYE)
    surfels = harmonic_channel_surfels()
    light = EnvironmentLight.from_radiance(scenes.gradient_sky()).prefilter()
    occluder = scenes.with_materials(scenes.channel(), surfels)
    options = ShadingOptions(traced_bounces=bounces)
    found = scenes.seen(points, place, options, surfels, light, diffuse, occluder, scenes.LOW_EYE)
    indirect, visibility = found.indirect.numpy().T, np.array(found.visibility)
    outgoing, mirrors = oracle_of_walls(light, surfels, diffuse), scenes.mirrored(place, scenes.LOW_EYE)[:, 0]
    for k, mirror in enumerate(mirrors):
        expected = exact.chain(scenes.wall_hit, outgoing, place[k], mirror, bounces)
        assert visibility[k] == (expected is None)
        np.testing.assert_allclose(indirect[k], 0 if expected is None else expected, rtol=2e-3)
    assert {1, 2, 3, 4} <= set(lengths(place, mirrors))


@pytest.mark.parametrize("rays", [slow(2), 6])
def test_bounces_of_rays_of_the_lobe_against_the_oracle(rays: int) -> None:
    """The mean over the blocked rays, one by one, and a single bright ray among them held back."""
    place, points = scenes.floor_points(0.4, count=25, eye=scenes.LOW_EYE)
    surfels = harmonic_channel_surfels()
    sky = scenes.gradient_sky()
    sky[1:4, 4:7] += 40.0  # a lamp
    light = EnvironmentLight.from_radiance(sky).prefilter()
    options = ShadingOptions(visibility_rays=rays, traced_bounces=2)
    occluder = scenes.with_materials(scenes.channel(), surfels)
    found = scenes.seen(points, place, options, surfels, light, "irradiance", occluder, scenes.LOW_EYE)
    indirect, visibility = found.indirect.numpy().T, np.array(found.visibility)
    lobe = Lobe.of(points.normal, points.view, points.roughness, mi.Color3f(0.8, 0.7, 0.6))
    samples = [lobe.sample(mi.UInt32(i), mi.UInt32(rays)) for i in range(rays)]
    direction = np.stack([d.numpy().T for d, _ in samples], 1).astype(np.float64)
    weight = np.stack([np.array(w) for _, w in samples], 1).astype(np.float64)
    outgoing, levels, held = oracle_of_walls(light, surfels, "irradiance"), exact_light(light), 0
    for k, mirror in enumerate(scenes.mirrored(place, scenes.LOW_EYE)[:, 0]):
        arriving = [exact.chain(scenes.wall_hit, outgoing, place[k], d, 2) for d in direction[k]]
        blocked = np.array([x is not None for x in arriving]) & (weight[k] > 0)
        radiance = np.array([np.zeros(3) if x is None else x for x in arriving])
        [free] = levels.look_up(*specular(levels, mirror[None], np.array([0.4])))
        np.testing.assert_allclose(visibility[k], weight[k][~blocked].sum() / weight[k].sum(), atol=1e-4)
        if blocked.any():
            expected = exact.blocked_mean(radiance, weight[k], blocked, free, 1 - 3 * 0.4**2)
            np.testing.assert_allclose(indirect[k], expected, rtol=5e-3)
            plain = weight[k][blocked] @ radiance[blocked] / weight[k][blocked].sum()
            held += bool((expected < 0.9 * plain).any())
    assert held > 2


@pytest.mark.parametrize(
    ("name", "rays"),
    [
        ("light", 5),
        ("roughness", 5),
        ("albedo", 1),
        ("radiance_sh", 1),
        ("rotation", 1),
        ("normal", 1),
        slow("rotation", 5),
        slow("metallic", 5),
        slow("light", 1),
    ],
)
def test_derivatives_of_traced_light(name: str, rays: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bounces, both modes against central differences of the indirect radiance, with random weights and
    steps; "normal" is that of the points, "rotation" that of the hits. What is held back of bright rays stays
    as it was, as the derivative has it."""
    rng = np.random.default_rng(8)
    place, points = scenes.floor_points(0.4, count=60, eye=scenes.LOW_EYE)
    surfels = harmonic_channel_surfels(rng.normal(size=(400, 3)), 0.1)
    occluder = scenes.with_materials(scenes.channel(), surfels)
    sky = scenes.gradient_sky()
    sky[1:4, 4:7] += 20.0  # a lamp
    leaves = surfels.raw | {"light": EnvironmentLight.from_radiance(sky).raw}
    leaves |= {"normal": mi.TensorXf(points.normal.numpy().T.copy())}
    bounces = 1 if name in ("normal", "rotation") else 2  # their derivatives end at the first hit
    options = ShadingOptions(visibility_rays=rays, traced_bounces=bounces)
    diffuse = "sh" if name == "radiance_sh" else "irradiance"
    weight = vector(rng.normal(size=(len(place), 3)))

    def indirect(value: Any) -> Any:
        changed = leaves | {name: value}
        light = EnvironmentLight(changed.pop("light")).prefilter()
        turned = ShadingPoints(
            dr.unravel(mi.Vector3f, changed.pop("normal").array), points.view, points.attributes
        )
        made = Surfels(changed)
        return scenes.seen(turned, place, options, made, light, diffuse, occluder, scenes.LOW_EYE).indirect

    kept: list[Any] = []
    held_back = reflection._firefly_clamp

    def keep(*arguments: Any) -> Any:
        if not kept:
            kept.append(held_back(*arguments))
            dr.eval(kept)
        return kept[0]

    assert max(lengths(place, scenes.mirrored(place, scenes.LOW_EYE)[:, 0])) > 1
    monkeypatch.setattr(reflection, "_firefly_clamp", keep)

    base = leaves[name].numpy().copy()
    step = rng.normal(size=base.shape).astype(np.float32)
    size = 1e-3 if bounces == 1 else 1e-2  # few rays then leave their triangles
    moved = (mi.TensorXf(base + t * step) for t in (-size, 0, size))
    low, middle, high = (indirect(x).numpy().astype(np.float64) for x in moved)
    bend = np.linalg.norm(high - 2 * middle + low, axis=0)
    kept_rays = bend < 0.05 * np.linalg.norm(high - low, axis=0) + 1e-6
    assert kept_rays.mean() > 0.7
    weight *= mi.Float(kept_rays.astype(np.float32))
    difference = np.sum((high - low) * weight.numpy()) / (2 * size)
    assert abs(difference) > 1e-3
    assert rays == 1 or 0 < (kept[0].numpy() < 0.9).mean() < 0.5

    leaf = with_grad(mi.TensorXf(base))
    dr.backward(dr.sum(dr.dot(mi.Vector3f(indirect(leaf)), weight)))
    reverse = float(np.sum(dr.grad(leaf).numpy().astype(np.float64) * step))
    tangent = dr.forward_to(indirect(with_grad(mi.TensorXf(base), mi.TensorXf(step))))
    forward = float(np.sum(tangent.numpy().astype(np.float64) * weight.numpy()))
    scale = float(np.linalg.norm(tangent.numpy()) * np.linalg.norm(weight.numpy())) / np.sqrt(len(place))
    assert abs(reverse - forward) < 1e-4 * scale
    assert abs(forward - difference) < 5e-3 * scale


def test_places_are_detached() -> None:
    """Of hits, and of several rays the directions; visibility."""
    place, points = scenes.floor_points(0.4)
    surfels, light = scenes.wall_surfels(), EnvironmentLight.from_radiance(scenes.gradient_sky()).prefilter()
    occluder = scenes.with_materials(scenes.corner(), surfels)
    surfels.enable_grad()
    dr.enable_grad(points.normal, points.view, points.roughness, points.albedo)
    for rays in (1, 3):
        options = ShadingOptions(visibility_rays=rays, traced_bounces=1)
        found = scenes.seen(points, place, options, surfels, light, occluder=occluder)
        assert not dr.grad_enabled(found.visibility)
        dr.backward(dr.sum(found.indirect.x))
        assert dr.all(dr.grad(points.roughness) == 0) and dr.all(dr.grad(points.view) == 0, axis=None)
        assert dr.all(dr.grad(points.normal) == 0, axis=None) == (rays > 1)
        assert dr.all(dr.grad(surfels.raw["position"]).array == 0)
        assert not dr.all(dr.grad(surfels.raw["roughness"]).array == 0)
        dr.set_grad(points.normal, 0)


def test_degenerate_pixels_stay_finite() -> None:
    """Views from behind and along surfaces, no normal, roughness out of range, rays that miss, no mesh."""
    rng = np.random.default_rng(2)
    cases = [
        (n, r)
        for n in ([0, 1, 0], [0, -1, 0], [1, 0, 0], [0, 0, 0], [1e-25, 0, 0], [1e15, 1e15, 0])
        for r in (-1.0, 0.0, 1e-6, 0.5, 1.0, 9.0)
    ]
    normal, roughness = (np.array(x, np.float64) for x in zip(*cases, strict=True))
    count = len(cases)
    place = np.stack([rng.uniform(-0.5, 0.9, count), np.zeros(count), rng.uniform(-3, 0.6, count)], 1)
    points = ShadingPoints(
        normal=vector(normal),
        view=vector(unit(scenes.EYE - place)),
        albedo=mi.Color3f(5, -1, 0.5) + dr.zeros(mi.Color3f, count),
        metallic=dr.full(mi.Float, 1, count),
        roughness=mi.Float(roughness.astype(np.float32)),
    )
    light, surfels = EnvironmentLight.from_radiance(scenes.gradient_sky()), scenes.wall_surfels()
    empty = Occluder(Mesh.empty())
    empty.set_materials(surfels)
    options = ShadingOptions(dominant=True, visibility_rays=7, traced_bounces=2)
    for occluder, chosen in (
        (scenes.with_materials(scenes.corner(), surfels), options),
        (empty, replace(options, visibility_rays=1)),
    ):
        raw = with_grad(mi.TensorXf(light.raw))
        prefiltered = EnvironmentLight(raw).prefilter()
        found = scenes.seen(points, place, chosen, surfels, prefiltered, occluder=occluder)
        assert dr.all((found.visibility >= 0) & (found.visibility <= 1))
        total = SplitSum().shade(found, prefiltered, replace(chosen, diffuse="irradiance")).total()
        dr.backward(dr.sum(total.x + total.y + total.z))
        assert dr.all(dr.isfinite(total), axis=None) and dr.all(dr.isfinite(dr.grad(raw)), axis=None)
