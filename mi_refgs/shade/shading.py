"""Shading options that fit together, and the light and attributes that they require."""

from collections.abc import Collection, Iterable
from dataclasses import asdict, dataclass, replace
from typing import Any

from mi_refgs.errors import InputError
from mi_refgs.kernels.timing import phase
from mi_refgs.shade.ambient import ambient_of_pixels
from mi_refgs.shade.light.kind import FittedLight
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.options import DIFFUSE, TRACED, Diffuse, ShadedAt, ShadingOptions
from mi_refgs.shade.points import RadianceTerms, ShadingPoints
from mi_refgs.shade.reflectance import MODELS, Reflectance, TraceContext
from mi_refgs.shade.reflectance.model import LIT
from mi_refgs.shade.reflection import reflection
from mi_refgs.surfels.attributes import ATTRIBUTES

UNTRACED: dict[str, Any] = {name: getattr(ShadingOptions, name) for name in ("occlusion", *TRACED)}

RELIT_RAYS = {"visibility_rays": 16, "traced_bounces": 2, "ambient_rays": 128}
"""Under another light: PSNR of two balls 33.6 dB with 1, 34.4 with 16; two bounces miss 9 % of a bowl."""


def spare(attributes: Iterable[str], used: Collection[str]) -> list[str]:
    """Materials among the attributes that are not used."""
    kept = {*used, *LIT, "confidence"}
    return [name for name in attributes if name not in kept and not ATTRIBUTES[name].geometry]


@dataclass(frozen=True)
class Shading(ShadingOptions):
    """Shading options that are allowed together; raises InputError with a remedy for any others."""

    def __post_init__(self) -> None:
        super().__post_init__()
        model, chosen = MODELS.find(self.reflectance, "shading: reflectance"), self.chosen()
        mirrors = " or ".join(name for name, other in MODELS.items() if other.visibility == "mirror")
        unused = self.ambient_rays > 0 and self.diffuse != "irradiance"
        untraced = not self.occlusion and bool({*chosen} & {*TRACED})
        untraceable = self.occlusion and not self.traceable
        blended = self.antialias and self.shaded_at != "pixel"
        needed = f"{self.reflectance} needs shading at {model.shaded_at[0]}"
        # (what is not allowed, its option, what is wrong, the remedy)
        rules = [
            (self.shaded_at not in model.shaded_at, "reflectance", needed, "set it"),
            (untraceable, "occlusion", f"needs shading at pixel and reflectance = {mirrors}", "set these"),
            (unused, "ambient_rays", "need diffuse = irradiance", "set it"),
            (untraced, ", ".join(TRACED), "need occlusion", "trace a `mesh`"),
            (blended, "antialias", "needs shading at pixel", "set it, or leave it out"),
        ]
        for name in chosen:
            able = " or ".join(other for other in MODELS if name in MODELS[other].honoured)
            rules.append((name not in model.honoured, name, f"needs reflectance = {able}", "set it"))
        for refused, option, wrong, remedy in rules:
            if refused:
                raise InputError(wrong, "shading", option, remedy)

    @staticmethod
    def resolve(options: ShadingOptions, mesh: bool) -> "Shading":
        """The options of a stage: occluded if `traceable` and there is a `mesh`; else without TRACED ones."""
        untraced = Shading(**asdict(options) | UNTRACED)
        traced = mesh and untraced.traceable
        return Shading(**asdict(options) | {"occlusion": True}) if traced else untraced

    def relit(self, mesh: bool) -> "Shading | None":
        """The shading under another light, occluded if there is a `mesh`; None: the model cannot be relit."""
        at = "pixel" if "pixel" in self.model.shaded_at else self.at
        options = self.model.relit(replace(self, at=at, **UNTRACED))
        if options is None:
            return None
        traced = {name: rays for name, rays in RELIT_RAYS.items() if name in self.model.honoured}
        return Shading.resolve(ShadingOptions(**asdict(options) | traced), mesh)

    def untraced(self) -> "Shading":
        """Without visibility, for renders of materials only."""
        return replace(self, antialias=False, **UNTRACED)

    def antialiased(self) -> "Shading":
        """With `antialias` where it has an effect: for displayed images."""
        able = self.shaded_at == "pixel" and "antialias" in self.model.honoured
        return replace(self, antialias=True) if able else self

    @staticmethod
    def default(attributes: Collection[str], models: Collection[str] = MODELS) -> tuple[str, Diffuse]:
        """The first of some models and diffuse that uses all attributes, else some; else that of fewest."""
        needs: dict[tuple[str, Diffuse], set[str]] = {
            (name, diffuse): {*MODELS[name].required_attributes(ShadingOptions(diffuse=diffuse))}
            for name in models
            for diffuse in DIFFUSE
        }
        able = [chosen for chosen, needed in needs.items() if needed <= {*attributes}]
        fewest = min(needs, key=lambda chosen: len(needs[chosen]))
        return min(able, key=lambda chosen: bool(spare(attributes, needs[chosen])), default=fewest)

    @property
    def model(self) -> Reflectance:
        return MODELS[self.reflectance]

    @property
    def shaded_at(self) -> ShadedAt:
        """Where it is shaded: `at`, but "surfel", which blends less, if the image is the same either way."""
        return "surfel" if self.model.order_independent else self.at

    @property
    def required_attributes(self) -> tuple[str, ...]:
        """Attributes beside the geometry that the surfels must have."""
        return self.model.required_attributes(self)

    @property
    def traceable(self) -> bool:
        """Whether the model can trace visibility where it is shaded."""
        rays = self.model.visibility
        return rays == "own" or (rays == "mirror" and self.shaded_at == "pixel")

    @property
    def neighbours(self) -> int:
        """Pixels along each axis that a pixel's colour depends on."""
        return int(self.antialias)

    def light_of(self, environment: FittedLight | None) -> Light | None:
        """The light as the model looks it up, under AD; None without one, or if the model uses none."""
        if environment is None or self.model.light == "none":
            return None
        return environment.prefilter() if self.model.light == "filtered" else environment.unfiltered()

    def require_inputs(self, attributes: Collection[str], light: bool = True, mesh: bool = True) -> None:
        """Raise InputError if an attribute, the light or the mesh that the model needs is missing."""
        for name in self.required_attributes:
            if name not in attributes:
                raise InputError("the surfels have no such attribute", "shading", name, "add it, or drop it")
        if self.model.light != "none" and not light:
            unlit = " or ".join(name for name, model in MODELS.items() if model.light == "none")
            needs = f"reflectance = {self.reflectance} needs one"
            raise InputError(needs, "shading", "light", f"add it, or set reflectance = {unlit}")
        if self.occlusion and not mesh:
            raise InputError("there is no mesh to trace", "shading", "occlusion", "give one")


def trace(points: ShadingPoints, context: TraceContext, shading: Shading) -> ShadingPoints:
    """The points with what rays find of the light and of other surfaces; needs `occlusion`."""
    if shading.model.visibility == "own":
        return shading.model.trace(points, context, shading)
    points = reflection(points, context, shading)
    missing = shading.ambient_rays and points.get("ambient") is None
    return points.replaced(ambient=ambient_of_pixels(context)) if missing else points


@phase("shade forward")
def shade(points: ShadingPoints, light: Any, shading: Shading) -> RadianceTerms:
    """Outgoing radiance towards the camera, as separate terms; `light` is None if the model uses none."""
    return shading.model.shade(points, light, shading)
