"""Conversion of a fitted scene to materials that any light can illuminate."""

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from mi_refgs.errors import InputError
from mi_refgs.kernels.device import upload_tensor
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.ambient import ambient
from mi_refgs.shade.brdf import split_sum
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.reflectance.model import LIT
from mi_refgs.shade.reflectance.split_sum import DIELECTRIC_F0, SplitSum
from mi_refgs.shade.sh import sh_basis
from mi_refgs.shade.shading import RELIT_RAYS
from mi_refgs.surfels.attributes import logit
from mi_refgs.surfels.table import Surfels

COSINE_LOBE = (1.0, 2 / 3, 1 / 4, 0.0)  # by SH degree. [Ramamoorthi and Hanrahan 2001, eq. 8, over π]


def lacking(scene: TrainedScene) -> str:
    """Why a scene is not `relightable`; empty if it is."""
    fitted, shading = scene.shading, scene.shading.relit(scene.mesh is not None)
    if shading is None:
        return f"reflectance: {fitted.reflectance} shows the light of the fit only"
    if fitted.required_attributes != shading.required_attributes and not isinstance(fitted.model, SplitSum):
        return f"diffuse: no albedo follows from what {fitted.reflectance} fitted to the light"
    if scene.turntable is not None and "radiance_sh" in fitted.required_attributes:
        return "diffuse: no albedo follows from a colour that was fitted to a light that turned"
    missing = [name for name in shading.required_attributes if not scene.surfels.has(name)]
    missing += ["light"] if scene.light is None else []
    return f"{', '.join(missing)}: the run has none" if missing else ""


def relightable(scene: TrainedScene) -> TrainedScene:
    """Reduce a scene to attributes without light (`albedo_from_radiance` for an SH colour of `split_sum`):
    radiance, indirect and background go; interreflection is traced if there is a mesh; the light stays,
    infinitely far. Raises InputError for a scene without light, or whose model has no such attributes."""
    if why := lacking(scene):
        raise InputError(why, remedy="fit one with materials and a light, as `--for relighting` does")
    shading = scene.shading.relit(scene.mesh is not None)
    assert scene.light is not None and shading is not None  # by `lacking`
    surfels = scene.surfels.detach()
    if scene.shading.required_attributes != shading.required_attributes:
        surfels = albedo_from_radiance(surfels, scene.light.prefilter(), scene.mesh)
    surfels = Surfels({name: raw for name, raw in surfels.raw.items() if name not in LIT})
    return replace(scene, surfels=surfels, shading=shading, surroundings=None, near=None, turntable=None)


def albedo_from_radiance(surfels: Surfels, light: Light, mesh: Mesh | None) -> Surfels:
    """Convert the diffuse radiance to an albedo: that of the diffuse part is R / ((1 - S) E), clipped to 0 …
    1, with R the cosine-weighted mean radiance in front of a surfel, E the irradiance times the mesh's
    ambient visibility, S a dielectric's reflectance at normal incidence."""
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
            np.atleast_2d(np.array(x, dtype=np.float64)).T  # (N, C)
            for x in (radiance, arrives, surfels.value("metallic"), surfels.value("albedo"))
        )
        floor = 1e-4 * arrives_.max()  # darker surfels are dark whatever their albedo

        def with_shadows(ratio: Any) -> Surfels:
            diffuse = np.clip(radiance_ / np.maximum(arrives_ * ratio, floor), 0, 1)
            mixed = metallic * albedo + (1 - metallic) * diffuse
            return Surfels(surfels.raw | {"albedo": upload_tensor(logit(mixed))})

        found = with_shadows(1.0)
        if mesh is None or vertex is None:
            return found
        # Interreflection depends on the albedo of other parts: that without shadows is close enough.
        occluder = Occluder(mesh)
        occluder.set_materials(found)
        options = ShadingOptions(ambient_rays=RELIT_RAYS["ambient_rays"])
        return with_shadows(ambient(occluder, found, light, options).numpy()[vertex])


def outward(surfels: Surfels, mesh: Mesh | None) -> tuple[np.ndarray, np.ndarray | None]:
    """Outward unit normals (N, 3) float32 of the surfels, and their nearest vertices (N) of the mesh."""
    normal, position = surfels.primitive.normal(surfels).numpy().T, surfels.position().numpy().T
    vertex = None
    if mesh is None or not len(mesh.faces):
        out = position - np.average(position, axis=0, weights=surfels.opacity().numpy() + 1e-9)
    else:
        _, vertex = cKDTree(mesh.vertices).query(position)
        out = mesh.normals()[vertex]
    turned = np.where(np.sum(normal * out, axis=1, keepdims=True) < 0, -normal, normal)
    return np.ascontiguousarray(turned, np.float32), vertex
