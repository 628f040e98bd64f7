"""The share of diffuse light that arrives at a mesh: against rays one by one, and where it is used."""

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.occlusion.visibility import ALONG, OFFSET_VOXELS, Occluder
from mi_refgs.reference.light import specular
from mi_refgs.reference.occlusion import ambient as exact
from mi_refgs.shade import ambient
from mi_refgs.shade.ggx_sampling import lobe_turn
from mi_refgs.shade.light.envmap import EnvironmentLight, PrefilteredLight
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.reflection import TraceContext
from mi_refgs.surfels.table import Surfels
from tests.helpers import refused, unit, vector
from tests.scenes.corner import VOXEL, corner, gradient_sky, wall_surfels
from tests.scenes.integrator import hollow_mesh, raw_channels, sensor, sky
from tests.scenes.shading_points import exact_light, exact_terms

RAYS = 12
LOGIT: dict[str, Any] = {"albedo": (1.0, 0.0, -1.0), "metallic": -0.5, "roughness": 0.2}
"""Materials of every surfel, so that all hits have them."""


def parted_corner() -> Mesh:
    """A floor and a wall beside it that do not touch: no ray starts in a plane of the other plate."""
    mesh = corner(3)
    vertices = mesh.vertices.copy()
    vertices[len(vertices) // 2 :, 0] -= 0.15
    return Mesh(vertices, mesh.faces, VOXEL)


def directions(normals: np.ndarray, rays: int) -> np.ndarray:
    """The rays (V, K, 3) of vertices."""
    frame = mi.Frame3f(mi.Vector3f(normals.T.astype(np.float32)))
    turn, count = lobe_turn(dr.arange(mi.UInt32, len(normals))), mi.UInt32(rays)
    each = (ambient.ambient_direction(frame, turn, mi.UInt32(k), count) for k in range(rays))
    return np.stack([ray.numpy().T for ray in each], 1)


def with_ratios(mesh: Mesh, surfels: Surfels, light: PrefilteredLight, rays: int = 9) -> Any:
    """An occluder that has its ambient ratios."""
    occluder = Occluder(mesh)
    ambient.update_occluder_caches(occluder, surfels, light, ShadingOptions(ambient_rays=rays))
    return occluder


def test_ratios_against_rays_one_by_one() -> None:
    """With shadows of a light that is not the same from everywhere, and two bounces."""
    mesh, surfels = parted_corner(), wall_surfels(metallic=LOGIT["metallic"], roughness=LOGIT["roughness"])
    light = EnvironmentLight.from_radiance(gradient_sky()).prefilter()
    occluder = with_ratios(mesh, surfels, light, RAYS)
    found = occluder.ambient.numpy()

    exact_levels = exact_light(light)
    normals = occluder.surface(surfels).vertex_surfels.normals(surfels).numpy().T.astype(np.float64)
    share = {name: 1 / (1 + np.exp(-np.array(value))) for name, value in LOGIT.items()}

    def outgoing(normal: np.ndarray, view: np.ndarray, free: bool, ratio: np.ndarray) -> np.ndarray:
        here = {"normal": normal, "view": view, "visibility": float(free), "ambient": ratio, **share}
        values = {name: np.asarray(x)[None] for name, x in here.items()}
        return exact_terms(values, exact_levels, ShadingOptions(diffuse="irradiance")).sum((0, 1))

    def sky(ω: np.ndarray) -> np.ndarray:
        return exact_levels.look_up(*specular(exact_levels, ω[None], np.array([(4 * RAYS) ** -0.25])))[0]

    rays = directions(normals, RAYS).astype(np.float64)
    shape = (mesh.vertices.astype(np.float64), mesh.faces.astype(int), normals, rays)
    limits: dict[str, Any] = {"offset": OFFSET_VOXELS * VOXEL, "along": ALONG, "brightest": ambient.BRIGHTEST}
    expected, once = (exact(*shape, sky, outgoing, bounces=k, **limits) for k in (ambient.BOUNCES, 1))
    assert np.abs(once - expected).max() > 5e-3
    assert found.min() < 0.9 and np.ptp(found, axis=1).max() > 0.05
    # A ray may pass an edge on this side in one and on that side in the other.
    off = np.abs(found - expected).max(1)
    assert np.sort(off)[: int(0.9 * len(off))].max() < 2e-3 and off.max() < 0.1


def test_a_white_furnace_stays_white() -> None:
    """Between two plates of albedo 1 nothing is lost: what is blocked comes back from the other plate."""
    mesh, surfels = parted_corner(), wall_surfels(albedo=np.full((400, 3), 9.0), metallic=-9.0, roughness=3.0)
    occluder = with_ratios(mesh, surfels, EnvironmentLight.constant(1.0, 8).prefilter())
    np.testing.assert_allclose(occluder.ambient.numpy(), 1, atol=1e-3)


def test_rays_are_spread_as_the_cosine() -> None:
    """Mean cosine 2/3, mean squared cosine 1/2, no side preferred; above the surface."""
    normals = unit(np.random.default_rng(1).normal(size=(7, 3)))
    ω = directions(normals, 64)
    cosine = np.einsum("vkc,vc->vk", ω, normals)
    np.testing.assert_allclose(np.linalg.norm(ω, axis=2), 1, atol=1e-6)
    np.testing.assert_allclose(cosine.mean(1), 2 / 3, atol=2e-3)
    np.testing.assert_allclose((cosine**2).mean(1), 0.5, atol=1e-3)
    np.testing.assert_allclose(ω.mean(1), 2 / 3 * normals, atol=0.02)
    assert cosine.min() > 0 and np.ptp(ω[:, 0] - normals, axis=0).min() > 0.05


def test_pixels_read_what_the_mesh_holds() -> None:
    """Linear over a face, in the order of its corners; 1 where nothing is hit or covered."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    mesh = Mesh(vertices, np.array([[0, 1, 2]], np.uint32), 1e-3)
    occluder, surfels = Occluder(mesh), Surfels.from_numpy(raw_channels())
    eye = mi.Point3f(0, 0, 1)
    context = TraceContext(occluder, surfels, None, eye, mi.Vector3f(0, 0, -1))
    refused(lambda: ambient.ambient_of_pixels(context), "update_occluder_caches")
    colours = np.array([[0.1, 0.2, 0.3], [0.9, 0.4, 0.5], [0.6, 0.7, 0.8]])
    occluder.ambient = ambient.VertexColours(mesh, colours)
    at = np.array([[0.2, 0.3], [0.6, 0.1], [0.1, 0.1], [2, 2]])
    ray, covered = vector(np.column_stack([at, -np.ones(4)])), mi.Bool([True, True, False, True])
    ratio = ambient.ambient_of_pixels(TraceContext(occluder, surfels, None, eye, ray, covered))
    expected = np.where([[True], [True], [False], [False]], np.column_stack([1 - at.sum(1), at]) @ colours, 1)
    np.testing.assert_allclose(ratio.numpy().T, expected, atol=1e-5)
    occluder.update(mesh)
    assert occluder.ambient is None


def test_the_plugin_follows_its_parameters(tmp_path: Path) -> None:
    """Ratios are those of the present light and materials, whether the light is its own or the scene's."""
    own = {"type": "envmap", "bitmap": mi.Bitmap(sky())}
    surfels = {name: mi.TensorXf(x) for name, x in raw_channels().items()}
    path = hollow_mesh(tmp_path)

    options = {"type": "refgs", "mesh": path, "diffuse": "irradiance", "ambient_rays": 32, **surfels}
    for inner, outer, ending in (({"sun": own}, {}, ".light"), ({}, {"sun": own}, "sun.data")):
        integrator: dict[str, Any] = {**options, **inner}
        scene = mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor(), **outer})
        params = mi.traverse(scene)
        key = next(key for key in params.keys() if key.endswith(ending))
        before = mi.render(scene, params, spp=1).numpy()
        ratio = scene.integrator().occluder.ambient.numpy()
        assert ratio.min() < 0.99
        values = params[key].numpy().copy()
        values[..., : values.shape[1] // 2, :] *= 0.1
        params[key] = mi.TensorXf(values)
        params.update()
        after = mi.render(scene, params, spp=1).numpy()
        changed = scene.integrator().occluder.ambient.numpy()
        assert np.abs(changed - ratio).max() > 0.01 and np.abs(after - before).max() > 0.01
