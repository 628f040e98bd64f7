"""The materials that Mitsuba's BSDFs declare, at surface points: albedo, roughness, metallic.

Which of them a BSDF defines follows from the names of its parameters (T: textures count):

    parameters                      albedo                          roughness   metallic   BSDFs
    albedo, roughness, metallic     albedo                          roughness   metallic   refgs_bsdf
    base_color, roughness           base_color                      roughness   metallic   principled
    reflectance                     reflectance                     -           0          diffuse
    eta, k                          F0 specular_reflectance         √α          1          (rough)conductor
    diffuse_reflectance             what the base reflects          √α          0          (rough)plastic

Albedo is that of the shading here: what the diffuse base reflects of the light that reaches it, or a metal's
F0. A plastic whose base is nonlinear multiplies the light inside by ρ (1 - Fᵢ) / (1 - ρ Fᵢ). α of an
anisotropic metal is the geometric mean of both; a smooth interface has roughness 0. `diffuse` has no
roughness: nothing shows it. `twosided`, `mask`, `bumpmap` and `normalmap` are what they hold, and a
`blendbsdf` is the one that it shows alone. Anything else (glass, hair, measured, a `principled` that
transmits) is unknown, and its maps have A = 0 there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, ClassVar

from mi_refgs.constants import MAX_NUMBER

OPAQUE = 1e-3
"""Share of transmitted light, or of the other BSDF of a blend, below which a material counts as pure."""


@dataclass(frozen=True)
class Materials:
    """Materials at points: (mi.Color3f or mi.Float, mi.Bool: defined there) each; values are 0 elsewhere."""

    albedo: tuple[Any, Any]
    roughness: tuple[Any, Any]
    metallic: tuple[Any, Any]

    def where(self, mask: Any, other: Materials) -> Materials:
        """These under the mask, the others elsewhere."""
        import drjit as dr

        pairs = ((getattr(self, f.name), getattr(other, f.name)) for f in fields(self))
        return Materials(*((dr.select(mask, a[0], b[0]), dr.select(mask, a[1], b[1])) for a, b in pairs))

    def only(self, mask: Any) -> Materials:
        """These where they are under the mask, unknown elsewhere."""
        return self.where(mask, unknown())

    def cleaned(self) -> Materials:
        """Unknown where a value is not finite; the others in 0 … 1."""
        import drjit as dr
        import mitsuba as mi

        def clean(value: Any, known: Any) -> tuple[Any, Any]:
            finite = known
            for x in value if dr.depth_v(value) > 1 else [value]:
                finite = finite & (dr.abs(x) < MAX_NUMBER)
            return type(value)(dr.select(finite, dr.clip(value, 0, 1), 0)), mi.Bool(finite)

        return Materials(*(clean(*getattr(self, f.name)) for f in fields(self)))


def unknown() -> Materials:
    """Nothing is defined."""
    import mitsuba as mi

    nothing = (mi.Float(0), mi.Bool(False))
    return Materials((mi.Color3f(0), mi.Bool(False)), nothing, nothing)


def materials_at(scene: Any, si: Any) -> Materials:
    """Materials of the scene's shapes at their surface interactions `si`.

    Instances of groups of shapes are unknown: their BSDFs are not the scene's.
    """
    import mitsuba as mi

    found = unknown()
    seen: list[Any] = []
    here = si.bsdf()
    for shape in scene.shapes():
        bsdf = shape.bsdf()
        if bsdf is None or any(bsdf is other for other in seen):
            continue
        seen.append(bsdf)
        mask = si.is_valid() & (here == mi.BSDFPtr(bsdf))
        found = _of(bsdf, si, mask).cleaned().where(mask, found)
    return found


class _Parameters:
    """The parameters of one BSDF by name, evaluated at surface interactions."""

    def __init__(self, bsdf: Any, si: Any, active: Any) -> None:
        import mitsuba as mi

        class Children(mi.TraversalCallback):
            found: ClassVar[dict[str, Any]] = {}

            def put_object(self, name: str, value: Any, flags: Any) -> None:
                self.found[name] = value

            def put(self, name: str, value: Any, flags: Any, *more: Any) -> None:
                self.found[name] = value

            put_value = put

        Children.found = {}
        bsdf.traverse(Children())
        self.bsdf, self.si, self.active = bsdf, si, active
        self.children = Children.found
        self.values = mi.traverse(bsdf)

    def __contains__(self, name: str) -> bool:
        return name in self.children

    def number(self, name: str, default: float = 0.0) -> Any:
        """A parameter as mi.Float; `default` without one."""
        import mitsuba as mi

        if name not in self.children:
            return mi.Float(default)
        texture = self.children[name]
        if isinstance(texture, mi.Texture):
            return mi.Float(texture.eval_1(self.si, self.active))
        return mi.Float(self.values[name])

    def colour(self, name: str, default: float = 1.0) -> Any:
        """A parameter as mi.Color3f; `default` without one."""
        import mitsuba as mi

        if name not in self.children:
            return mi.Color3f(default)
        return mi.Color3f(self.children[name].eval(self.si, self.active))

    def nested(self, name: str, si: Any = None) -> Materials:
        """The materials of a BSDF that this one holds."""
        return _of(self.children[name], self.si if si is None else si, self.active)


def _of(bsdf: Any, si: Any, active: Any) -> Materials:
    """Materials of one BSDF, by the first rule whose parameters it has."""
    parameters = _Parameters(bsdf, si, active)
    for needed, rule in RULES:
        if all(name in parameters for name in needed):
            return rule(parameters)
    return unknown()


def _declared(p: _Parameters) -> Materials:
    import mitsuba as mi

    yes = mi.Bool(True)
    return Materials((p.colour("albedo"), yes), (p.number("roughness"), yes), (p.number("metallic"), yes))


def _principled(p: _Parameters) -> Materials:
    opaque = p.number("spec_trans") < OPAQUE
    return Materials(
        (p.colour("base_color"), opaque), (p.number("roughness"), opaque), (p.number("metallic"), opaque)
    )


def _diffuse(p: _Parameters) -> Materials:
    import mitsuba as mi

    yes = mi.Bool(True)
    return Materials((p.colour("reflectance"), yes), (mi.Float(0), mi.Bool(False)), (mi.Float(0), yes))


def _conductor(p: _Parameters) -> Materials:
    import drjit as dr
    import mitsuba as mi

    eta, k, yes = p.colour("eta"), p.colour("k"), mi.Bool(True)
    # Reflectance at normal incidence; η = 0 (`material = none`) gives 1.
    f0 = (dr.square(eta - 1) + dr.square(k)) / (dr.square(eta + 1) + dr.square(k))
    α = dr.sqrt(p.number("alpha_u") * p.number("alpha_v")) if "alpha_u" in p else p.number("alpha")
    return Materials((f0 * p.colour("specular_reflectance"), yes), (dr.sqrt(α), yes), (mi.Float(1), yes))


def _plastic(p: _Parameters) -> Materials:
    import drjit as dr
    import mitsuba as mi

    albedo, yes = p.colour("diffuse_reflectance"), mi.Bool(True)
    if "nonlinear = 1" in str(p.bsdf):  # no parameter says so
        inside = mi.fresnel_diffuse_reflectance(1 / p.number("eta", 1.5))
        albedo = albedo * (1 - inside) / (1 - albedo * inside)
    return Materials((albedo, yes), (dr.sqrt(p.number("alpha")), yes), (mi.Float(0), yes))


def _two_sided(p: _Parameters) -> Materials:
    import drjit as dr

    front = p.si.wi.z > 0
    behind = type(p.si)(p.si)
    behind.wi.z = dr.abs(p.si.wi.z)
    return p.nested("brdf_0").where(front, p.nested("brdf_1", behind))


def _blend(p: _Parameters) -> Materials:
    weight = p.number("weight")
    first, second = p.nested("bsdf_0").only(weight < OPAQUE), p.nested("bsdf_1").only(1 - weight < OPAQUE)
    return first.where(weight < OPAQUE, second)


RULES: tuple[tuple[tuple[str, ...], Callable[[_Parameters], Materials]], ...] = (
    (("brdf_0", "brdf_1"), _two_sided),
    (("bsdf_0", "bsdf_1", "weight"), _blend),
    (("nested_bsdf",), lambda p: p.nested("nested_bsdf")),
    (("albedo", "roughness", "metallic"), _declared),
    (("diff_trans",), lambda p: unknown()),
    (("base_color", "roughness"), _principled),
    (("diffuse_reflectance",), _plastic),
    (("eta", "k"), _conductor),
    (("transmittance",), lambda p: unknown()),
    (("reflectance",), _diffuse),
)
"""What parameters a BSDF has, and what they mean; the first that fits."""
