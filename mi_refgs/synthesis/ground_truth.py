"""Ground truth from a Mitsuba scene: materials of its BSDFs at surface points (RULES), its surface as a mesh.

Albedo is the reflectance of the diffuse base, or F0 of a metal; the base of a nonlinear plastic multiplies
the light inside by ρ (1 - Fᵢ) / (1 - ρ Fᵢ). Roughness is √α, for an anisotropic metal of the geometric mean;
that of `diffuse`, and all of glass, hair, measured and transmitting `principled` BSDFs, is unknown."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.errors import InputError
from mi_refgs.kernels.device import children_of
from mi_refgs.occlusion.visibility import mesh_arrays
from mi_refgs.types import Bool, Color3f, Float, Scene

OPAQUE = 1e-3  # fraction of transmitted light, or weight of the other BSDF of a blend, that is neglected
SPHERE_SUBDIVISIONS = 5  # of an icosahedron: the centres of 20,480 triangles are 1.5e-4 radii inside
ROUND_SIDES = 256  # sides of a circle: the centre of a side is 8e-5 radii inside it


class Materials(NamedTuple):
    """Materials at points: each a value, 0 where undefined, and whether it is defined."""

    albedo: tuple[Color3f, Bool]
    roughness: tuple[Float, Bool]
    metallic: tuple[Float, Bool]

    @staticmethod
    def of(albedo: Any = None, roughness: Any = None, metal: Any = None, known: Bool = True) -> "Materials":
        """Materials of these values, where `known`; None is undefined."""

        def pair(kind: Any, value: Any) -> tuple[Any, Bool]:
            return (kind(0), mi.Bool(False)) if value is None else (kind(value), mi.Bool(known))

        return Materials(pair(mi.Color3f, albedo), pair(mi.Float, roughness), pair(mi.Float, metal))

    def where(self, mask: Bool, other: "Materials") -> "Materials":
        pairs = zip(self, other, strict=True)
        return Materials(*((dr.select(mask, a[0], b[0]), dr.select(mask, a[1], b[1])) for a, b in pairs))

    def cleaned(self) -> "Materials":
        """Unknown where a value is not finite; clipped to 0 … 1 elsewhere."""

        def clean(value: Any, known: Bool) -> tuple[Any, Bool]:
            finite = known
            for x in value if dr.depth_v(value) > 1 else [value]:
                finite = finite & (dr.abs(x) < MAX_NUMBER)
            return type(value)(dr.select(finite, dr.clip(value, 0, 1), 0)), mi.Bool(finite)

        return Materials(*(clean(*pair) for pair in self))


def materials_at(scene: Scene, si: Any) -> Materials:
    """Materials of the scene's shapes at surface interactions `si`; of instances of groups unknown."""
    found, here = Materials.of(), si.bsdf()
    bsdfs = {id(bsdf): bsdf for shape in scene.shapes() if (bsdf := shape.bsdf()) is not None}
    for bsdf in bsdfs.values():
        mask = si.is_valid() & (here == mi.BSDFPtr(bsdf))
        found = _of(bsdf, si, mask).cleaned().where(mask, found)
    return found


class _Parameters:
    """The parameters of one BSDF by name, evaluated at surface interactions."""

    def __init__(self, bsdf: Any, si: Any, active: Bool) -> None:
        self.bsdf, self.si, self.active = bsdf, si, active
        self.children, self.values = dict(children_of(bsdf)), mi.traverse(bsdf)

    def __contains__(self, name: str) -> bool:
        return name in self.children

    def number(self, name: str, default: float = 0.0) -> Float:
        """A parameter as mi.Float; `default` without one."""
        if isinstance(texture := self.children.get(name), mi.Texture):
            return mi.Float(texture.eval_1(self.si, self.active))
        return mi.Float(self.values[name] if name in self.children else default)

    def colour(self, name: str, default: float = 1.0) -> Color3f:
        """A parameter as mi.Color3f; `default` without one."""
        texture = self.children.get(name)
        return mi.Color3f(default if texture is None else texture.eval(self.si, self.active))

    def nested(self, name: str, si: Any = None) -> Materials:
        return _of(self.children[name], self.si if si is None else si, self.active)


def _of(bsdf: Any, si: Any, active: Bool) -> Materials:
    """Materials of one BSDF, by the first rule whose parameters it has."""
    parameters = _Parameters(bsdf, si, active)
    for needed, rule in RULES:
        if all(name in parameters for name in needed):
            return rule(parameters)
    return Materials.of()


def _principled(p: _Parameters) -> Materials:
    colour, opaque = p.colour("albedo" if "albedo" in p else "base_color"), p.number("spec_trans") < OPAQUE
    return Materials.of(colour, p.number("roughness"), p.number("metallic"), opaque)


def _conductor(p: _Parameters) -> Materials:
    eta, k = p.colour("eta"), p.colour("k")
    # Reflectance at normal incidence; η = 0 (`material = none`) gives 1.
    f0 = (dr.square(eta - 1) + dr.square(k)) / (dr.square(eta + 1) + dr.square(k))
    α = dr.sqrt(p.number("alpha_u") * p.number("alpha_v")) if "alpha_u" in p else p.number("alpha")
    return Materials.of(f0 * p.colour("specular_reflectance"), dr.sqrt(α), 1)


def _plastic(p: _Parameters) -> Materials:
    albedo = p.colour("diffuse_reflectance")
    if "nonlinear = 1" in str(p.bsdf):  # no parameter says so
        inside = mi.fresnel_diffuse_reflectance(1 / p.number("eta", 1.5))
        albedo = albedo * (1 - inside) / (1 - albedo * inside)
    return Materials.of(albedo, dr.sqrt(p.number("alpha")), 0)


def _two_sided(p: _Parameters) -> Materials:
    front = p.si.wi.z > 0
    behind = type(p.si)(p.si)
    behind.wi.z = dr.abs(p.si.wi.z)
    return p.nested("brdf_0").where(front, p.nested("brdf_1", behind))


def _blend(p: _Parameters) -> Materials:
    weight = p.number("weight")
    second = p.nested("bsdf_1").where(1 - weight < OPAQUE, Materials.of())
    return p.nested("bsdf_0").where(weight < OPAQUE, second)


RULES: tuple[tuple[tuple[str, ...], Callable[[_Parameters], Materials]], ...] = (
    (("brdf_0", "brdf_1"), _two_sided),
    (("bsdf_0", "bsdf_1", "weight"), _blend),
    (("nested_bsdf",), lambda p: p.nested("nested_bsdf")),
    (("albedo", "roughness", "metallic"), _principled),
    (("diff_trans",), lambda p: Materials.of()),
    (("base_color", "roughness"), _principled),
    (("diffuse_reflectance",), _plastic),
    (("eta", "k"), _conductor),
    (("transmittance",), lambda p: Materials.of()),
    (("reflectance",), lambda p: Materials.of(p.colour("reflectance"), None, 0)),
)
"""Parameters of a BSDF → its materials; the first entry that fits."""


def surface_mesh(shapes: Sequence[Any]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float64 and faces (F, 3) of shapes of a scene, concatenated. Spheres, disks and
    cylinders are tessellated. Raises InputError that names another shape but a mesh."""
    vertices, faces = zip(*map(triangles, shapes), strict=True)
    return trimesh.util.append_faces(vertices, faces)


def triangles(shape: Any) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of one shape, as `surface_mesh` has them."""
    if shape.is_mesh():
        return mesh_arrays(shape)
    name = shape.class_name()
    params = mi.traverse(shape)
    if name not in UNIT_SHAPES or "to_world" not in params:
        remedy = "use a mesh, sphere, disk or cylinder"
        raise InputError(f"a {name} cannot be tessellated", field=f"shape '{shape.id()}'", remedy=remedy)
    unit = UNIT_SHAPES[name]()
    matrix = np.array(params["to_world"].matrix, dtype=np.float64).reshape(4, 4)
    return np.asarray(unit.vertices) @ matrix[:3, :3].T + matrix[:3, 3], np.asarray(unit.faces)


def _cylinder(wall: bool) -> trimesh.Trimesh:
    """The open cylinder of radius 1 from z = 0 to z = 1; without the wall, the unit disk."""
    closed = trimesh.creation.cylinder(radius=1, segment=[(0, 0, 0), (0, 0, 1)], sections=ROUND_SIDES)
    up = closed.face_normals[:, 2]
    closed.update_faces(np.abs(up) < 0.5 if wall else up > 0.5)
    closed.remove_unreferenced_vertices()
    closed.vertices *= (1, 1, wall)
    return closed


UNIT_SHAPES = {
    "Sphere": lambda: trimesh.creation.icosphere(subdivisions=SPHERE_SUBDIVISIONS),
    "Disk": lambda: _cylinder(wall=False),
    "Cylinder": lambda: _cylinder(wall=True),
}
"""Tessellations of the unit shapes that Mitsuba transforms by `to_world`."""
