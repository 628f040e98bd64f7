"""A trained scene as materials alone, which any light may shine on."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh
from scipy.spatial import cKDTree

from mi_refgs.errors import SceneError
from mi_refgs.kernels.device import upload_tensor
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.occlusion.tsdf import bounds_from_points
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.ambient import ambient
from mi_refgs.shade.brdf import split_sum
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.reflectance.split_sum import MATERIALS
from mi_refgs.shade.sh import sh_basis
from mi_refgs.shade.shading import Shading
from mi_refgs.shade.split_sum import DIELECTRIC_F0
from mi_refgs.surfels.attributes import logit
from mi_refgs.surfels.table import Surfels

COSINE_LOBE = (1.0, 2 / 3, 1 / 4, 0.0)
"""Factors by degree that turn harmonics into their cosine-weighted mean over a hemisphere. [Ramamoorthi and
Hanrahan 2001, eq. 8, over π]"""
IRRADIANCE_FLOOR = 1e-4
"""Share of the light's brightest irradiance: below, a surfel is dark whatever its albedo."""
RELIGHT_RAYS = 16
"""Rays of the lobe of each pixel. Two balls of known materials, relit at 128² and 2 × 2 samples, are 33.6 dB
from the path tracer's with one, 34.2 with 4, 34.4 with 16 and 34.5 with 64 rays."""
RELIGHT_BOUNCES = 2
"""Times that what these rays hit is shaded. Of the self-reflecting instances of `benchmarks.visibility`, two
bounces leave 9 % of the light in a bowl unaccounted for, one 27 %, four 3 %."""
AMBIENT_RAYS = 128
"""Rays of each vertex of the mesh."""


def lacking(scene: TrainedScene) -> str:
    """What a scene lacks to be `relightable`: some materials or a light, by name; nothing if it is."""
    missing = [name for name in MATERIALS if not scene.surfels.has(name)]
    return ", ".join(missing) or ("light" if scene.light is None else "")


def relightable(scene: TrainedScene) -> TrainedScene:
    """The scene with albedo, metallic and roughness alone, shaded by whatever light it is given.

    A diffuse part that was fitted as a colour of its own ("sh") becomes an albedo (`albedo_from_radiance`).
    What is fitted to the light, the radiance and indirect channels, goes; light that other parts of the
    object send is traced instead, where the scene has a mesh. The light stays, and so do other options of
    accuracy. Surroundings go: they are as bright as they were photographed. A scene that has only materials
    keeps them as they are.

    Raises InputError for a scene without light or one of the materials.
    """
    if what := lacking(scene):
        raise SceneError(
            f"{what}: the run has none; fit one with materials and a light, as `--for relighting` does"
        )
    assert scene.light is not None
    surfels = scene.surfels.detach()
    mesh = scene.mesh
    if mesh is not None and scene.surroundings is not None:
        mesh = _near(mesh, surfels)
    if scene.shading.diffuse == "sh":
        surfels = albedo_from_radiance(surfels, scene.light.prefilter(), mesh)
    kept = {name: raw for name, raw in surfels.raw.items() if name not in ("radiance_sh", "indirect_sh")}
    rays, bounces, ambient_rays = (1, 0, 0) if mesh is None else (RELIGHT_RAYS, RELIGHT_BOUNCES, AMBIENT_RAYS)
    shading = replace(
        scene.shading if scene.shading.reflectance == "split_sum" else Shading(),
        at="pixel",
        diffuse="irradiance",
        occlusion=mesh is not None,
        visibility_rays=rays,
        traced_bounces=bounces,
        ambient_rays=ambient_rays,
    )
    return replace(scene, surfels=Surfels(kept), mesh=mesh, shading=shading, surroundings=None)


def _near(mesh: Mesh, surfels: Surfels) -> Mesh:
    """The triangles in the box of the surfels: what is around them stands in no other light's way."""
    low, high = bounds_from_points(surfels.to_numpy()["position"])
    return mesh.of_vertices(np.all((mesh.vertices >= low) & (mesh.vertices <= high), axis=1))


def albedo_from_radiance(surfels: Surfels, light: Light, mesh: Mesh | None) -> Surfels:
    """The table with the diffuse radiance of each surfel as an albedo, under the light that it was fitted to.

    With R, the cosine-weighted mean of the radiance over the directions in front of a surfel, E, the light's
    irradiance there, times what the mesh leaves of it (`shade.ambient`), and S, a dielectric's reflectance at
    normal incidence, the diffuse albedo is R / ((1 - S) E), in 0 … 1; the table's albedo becomes
    metallic albedo + (1 - metallic) that. Front is the mesh's outside, without a mesh that away from the
    surfels' middle. Raises InputError without the channels radiance_sh, albedo, metallic and roughness.
    """
    with dr.suspend_grad():
        surfels = surfels.cleaned()
        normal, vertex = outward(surfels, mesh)
        facing = mi.Vector3f(normal.T)
        coefficients = surfels.value("radiance_sh")
        basis = sh_basis(-facing, surfels.sh_degree())
        radiance = mi.Color3f(0.5)
        for index, (coefficient, function) in enumerate(zip(coefficients, basis, strict=True)):
            radiance += COSINE_LOBE[int(index**0.5)] * function * coefficient
        scale, bias = split_sum(mi.Float(1), surfels.value("roughness"))
        arrives = light.irradiance(facing) * (1 - (DIELECTRIC_F0 * scale + bias))
        radiance_, arrives_, metallic, albedo = (
            _rows(x) for x in (radiance, arrives, surfels.value("metallic"), surfels.value("albedo"))
        )
        floor = IRRADIANCE_FLOOR * arrives_.max()

        def with_shadows(ratio: Any) -> Surfels:
            diffuse = np.clip(radiance_ / np.maximum(arrives_ * ratio, floor), 0, 1)
            mixed = metallic * albedo + (1 - metallic) * diffuse
            return Surfels(surfels.raw | {"albedo": upload_tensor(logit(mixed))})

        found = with_shadows(1.0)
        if mesh is None or vertex is None:
            return found
        # Light from other parts of the object has their albedo: that without shadows is near enough for it.
        occluder = Occluder(mesh)
        occluder.set_materials(found)
        ratios = ambient(occluder, found, light, ShadingOptions(ambient_rays=AMBIENT_RAYS)).numpy()
        return with_shadows(ratios[vertex])


def _rows(value: Any) -> np.ndarray:
    """Values of all surfels (N, C)."""
    return np.atleast_2d(np.array(value, dtype=np.float64)).T


def outward(surfels: Surfels, mesh: Mesh | None) -> tuple[np.ndarray, np.ndarray | None]:
    """Unit normals (N, 3) float32 of the surfels, turned outwards, and the nearest vertex (N) of the mesh."""
    normal = surfels.primitive.normal(surfels).numpy().T
    position = surfels.position().numpy().T
    vertex = None
    if mesh is None or not len(mesh.faces):
        out = position - np.average(position, axis=0, weights=surfels.opacity().numpy() + 1e-9)
    else:
        _, vertex = cKDTree(mesh.vertices).query(position)
        scaled = (mesh.vertices - mesh.vertices[0]) / mesh.voxel
        out = np.asarray(trimesh.Trimesh(scaled, mesh.faces, process=False).vertex_normals)[vertex]
    turned = np.where(np.sum(normal * out, axis=1, keepdims=True) < 0, -normal, normal)
    return np.ascontiguousarray(turned, np.float32), vertex
