"""Primitives that are splatted: surfels and 3D Gaussians. A new one is another file, registered here."""

from mi_refgs.surfels.primitives.gaussian import Gaussian
from mi_refgs.surfels.primitives.primitive import (
    PRIMITIVES as PRIMITIVES,
    Adjoint as Adjoint,
    Footprints as Footprints,
    FootprintSample as FootprintSample,
    Primitive as Primitive,
    evaluating_both as evaluating_both,
    nearest_primitive as nearest_primitive,
    primitive_of as primitive_of,
    register as register,
)
from mi_refgs.surfels.primitives.surfel import Surfel

register(Surfel())
register(Gaussian())
