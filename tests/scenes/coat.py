"""A plugin: a clear coat over Ref-Gaussian's model, and one of each other thing that a fit can be given."""

from dataclasses import dataclass
from typing import Any, ClassVar

import drjit as dr

import mi_refgs
from mi_refgs import ShadingOptions, ShadingPoints, Surfels, SurfelView
from mi_refgs.shade.light.maps import Learnt
from mi_refgs.shade.points import reflect, safe_normalize
from mi_refgs.shade.reflectance.split_sum import SplitSum

mi_refgs.register_attribute(mi_refgs.Attribute("coat", (1,), "sigmoid", 0.01, ("coat",), 0.8, aov="Y"))


class Coated(SplitSum):
    """The split sum, and above it a share `coat` of the light in the mirror direction, a little blurred."""

    name = "coated"

    def required_attributes(self, options: ShadingOptions) -> tuple[str, ...]:
        return (*super().required_attributes(options), "coat")

    def values(self, surfels: Surfels, seen: SurfelView, options: ShadingOptions) -> dict[str, Any]:
        return super().values(surfels, seen, options) | {"coat": surfels.value("coat")}

    def shade(self, points: ShadingPoints, light: Any, options: ShadingOptions) -> mi_refgs.RadianceTerms:
        terms = super().shade(points, light, options)
        mirrored = reflect(safe_normalize(points.view), safe_normalize(points.normal))
        coat = points.coat * light.specular(mirrored, dr.minimum(points.roughness, 0.1))
        return mi_refgs.RadianceTerms(terms.diffuse, terms.specular + coat, terms.indirect)


mi_refgs.register_reflectance(Coated())
mi_refgs.register_loss(mi_refgs.Loss("thin", lambda inputs: dr.mean(inputs.frame.alpha)))
mi_refgs.register_initialiser(mi_refgs.Initialiser("nowhere", lambda wanted: None))


@dataclass(frozen=True)
class Rest(mi_refgs.Event[mi_refgs.Trainer]):
    """Does nothing."""

    name: ClassVar[str] = "rest"

    def due(self, trainer: mi_refgs.Trainer) -> bool:
        return False


@dataclass(frozen=True)
class Sky(Learnt):
    """The learnt light, by another name."""

    name: ClassVar[str] = "sky"


mi_refgs.register_event(Rest)
mi_refgs.register_light(Sky)
