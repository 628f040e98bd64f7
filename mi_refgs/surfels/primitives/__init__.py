"""What is splatted: surfels and 3D Gaussians. A new primitive is one more file, registered here."""

from mi_refgs.surfels.primitives.gaussian import Gaussian
from mi_refgs.surfels.primitives.primitive import (
    PRIMITIVES,
    Adjoint,
    Footprints,
    Primitive,
    Sample,
    nearest_primitive,
    primitive_named,
    primitive_of,
    register,
    unregister,
    widths_of,
)
from mi_refgs.surfels.primitives.surfel import Surfel

__all__ = [
    "PRIMITIVES",
    "Adjoint",
    "Footprints",
    "Primitive",
    "Sample",
    "nearest_primitive",
    "primitive_named",
    "primitive_of",
    "register",
    "unregister",
    "widths_of",
]

register(Surfel())
register(Gaussian())
