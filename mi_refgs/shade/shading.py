"""How a method turns surfels into radiance, as data, and what is not allowed together."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, get_args, get_type_hints

from mi_refgs.errors import InputError, abbreviated
from mi_refgs.kernels.timing import phase
from mi_refgs.shade.accuracy import NEED_OCCLUSION, Accuracy
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.light.lobe_matrices import Levels
from mi_refgs.shade.points import RadianceTerms, ShadingPoints
from mi_refgs.shade.reflectance import MODELS, Reflectance
from mi_refgs.shade.split_sum import Diffuse


@dataclass(frozen=True)
class Shading:
    """How a method turns surfels into radiance: data, chosen per stage. The one place of its rules.

    A model whose radiance is blended linearly is the same in the two orders; `at` is then "surfel", which
    blends less. Raises InputError for what is not allowed together.
    """

    at: Literal["surfel", "pixel"] = "pixel"  # shade before or after blending
    reflectance: str = "split_sum"  # a name in `reflectance.MODELS`
    diffuse: Diffuse = "sh"  # view-dependent SH colour, or of albedo and light
    occlusion: bool = False  # trace visibility, and fill with what the model has for blocked rays
    accuracy: Accuracy = field(default_factory=Accuracy)  # what to pay for less error; rays need occlusion

    def __post_init__(self) -> None:
        """Raise InputError, or TypeError for an unknown key of `accuracy`, for what JSON may hold."""
        if isinstance(self.accuracy, Mapping):  # as JSON keeps it
            object.__setattr__(self, "accuracy", Accuracy(**self.accuracy))
        for name, kind in _HINTS.items():
            value, allowed = getattr(self, name), get_args(kind)
            if not (value in allowed if allowed else isinstance(value, kind)):
                raise InputError(f"shading: {name}: {abbreviated(value)} is not allowed; correct it")
        if self.reflectance not in MODELS:
            raise InputError(
                f"shading: reflectance: {abbreviated(self.reflectance)} is unknown; use {' or '.join(MODELS)}"
            )
        if self.model.order_independent:
            object.__setattr__(self, "at", "surfel")
        elif self.at not in self.model.orders:
            order = self.model.orders[0]
            raise InputError(f"shading: reflectance: {self.reflectance} needs shade_at = {order}; set it")
        if self.occlusion and not self.traceable:
            mirrors = " or ".join(name for name, model in MODELS.items() if model.visibility == "mirror")
            raise InputError(
                f"shading: occlusion: needs shade_at = pixel and reflectance = {mirrors}; set these"
            )
        if self.accuracy.ambient_rays and self.diffuse != "irradiance":
            raise InputError("shading: ambient_rays: need diffuse = irradiance; set it")
        chosen = self.accuracy.chosen()
        if not self.occlusion and {*chosen} & {*NEED_OCCLUSION}:
            raise InputError(f"shading: {', '.join(NEED_OCCLUSION)}: need occlusion; trace a `mesh`")
        if self.accuracy.antialias and self.at != "pixel":
            raise InputError("shading: antialias: needs shade_at = pixel; set it, or leave it out")
        for name in chosen:
            if name not in self.model.honours:
                able = " or ".join(other for other, model in MODELS.items() if name in model.honours)
                raise InputError(f"shading: {name}: needs reflectance = {able}; set it")

    @staticmethod
    def of(stage: Any, mesh: bool) -> Shading:
        """The shading of a stage by its fields of the same names, those of `Accuracy` among them.

        It is occluded if there is a `mesh` and the model can trace it in this order.
        """
        given: dict[str, Any] = {
            option.name: getattr(stage, option.name, option.default) for option in fields(Accuracy)
        }
        free = {name: value for name, value in given.items() if name not in NEED_OCCLUSION}
        shading = Shading(stage.at, stage.reflectance, stage.diffuse, accuracy=Accuracy(**free))
        if not (mesh and shading.traceable):
            return shading
        return replace(shading, occlusion=True, accuracy=Accuracy(**given))

    @staticmethod
    def default_reflectance(channels: Collection[str]) -> str:
        """The first model whose channels are there, with either diffuse; else the one that needs fewest."""
        needs = {name: min((model.channels(d) for d in DIFFUSE), key=len) for name, model in MODELS.items()}
        able = (name for name, needed in needs.items() if {*needed} <= {*channels})
        return next(able, min(needs, key=lambda name: len(needs[name])))

    @staticmethod
    def default_diffuse(reflectance: str, channels: Collection[str]) -> Diffuse:
        """The first diffuse whose channels are there; else the one that needs fewest."""
        needs: dict[Diffuse, set[str]] = {d: {*MODELS[reflectance].channels(d)} for d in DIFFUSE}
        able = (diffuse for diffuse in DIFFUSE if needs[diffuse] <= {*channels})
        return next(able, min(DIFFUSE, key=lambda diffuse: len(needs[diffuse])))

    @property
    def model(self) -> Reflectance:
        """The reflectance model."""
        return MODELS[self.reflectance]

    @property
    def traceable(self) -> bool:
        """Whether the model can trace visibility in this order."""
        return self.model.visibility == "own" or (self.model.visibility == "mirror" and self.at == "pixel")

    @property
    def neighbours(self) -> int:
        """Pixels along each axis that a pixel's colour depends on."""
        return int(self.accuracy.antialias)

    def light_of(self, environment: EnvironmentLight | None) -> Light | None:
        """The light as the model looks it up, under AD; None if there is none, or it asks for none."""
        if environment is None or self.model.light == "none":
            return None
        return (
            environment.prefilter(self.levels) if self.model.light == "filtered" else environment.unfiltered()
        )

    @property
    def levels(self) -> Levels:
        """The levels of roughness that a light is filtered to."""
        return Levels.some(self.accuracy.light_levels)

    def check(self, channels: Collection[str], light: bool = True, mesh: bool = True) -> None:
        """Raise InputError if surfels with these channels, and what is there beside them, lack something."""
        for name in self.model.channels(self.diffuse):
            if name not in channels:
                raise InputError(
                    f"shading: {name}: the surfels have no such channel; add it, or do without it"
                )
        if self.model.light != "none" and not light:
            free = " or ".join(name for name, model in MODELS.items() if model.light == "none")
            raise InputError(
                f"shading: light: reflectance = {self.reflectance} needs one; add it, or set reflectance = "
                f"{free}"
            )
        if self.occlusion and not mesh:
            raise InputError("shading: occlusion: there is no mesh to trace; give one, or trace nothing")


DIFFUSE: tuple[Diffuse, ...] = get_args(Diffuse)
"""Choices of `Shading.diffuse`."""

_HINTS = get_type_hints(Shading)


@phase("shade forward")
def shade(points: ShadingPoints, light: Light | None, shading: Shading) -> RadianceTerms:
    """Outgoing radiance towards the camera, by cause, of the shading's model."""
    return shading.model.shade(points, light, shading)
