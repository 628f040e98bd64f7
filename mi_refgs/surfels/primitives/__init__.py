"""Primitives that are splatted: surfels and 3D Gaussians. A new one is another file, registered here."""

from mi_refgs.surfels.primitives.gaussian import Gaussian
from mi_refgs.surfels.primitives.primitive import PRIMITIVES as PRIMITIVES
from mi_refgs.surfels.primitives.primitive import Adjoint as Adjoint
from mi_refgs.surfels.primitives.primitive import Footprints as Footprints
from mi_refgs.surfels.primitives.primitive import FootprintSample as FootprintSample
from mi_refgs.surfels.primitives.primitive import Primitive as Primitive
from mi_refgs.surfels.primitives.primitive import evaluating_both as evaluating_both
from mi_refgs.surfels.primitives.primitive import nearest_primitive as nearest_primitive
from mi_refgs.surfels.primitives.primitive import primitive_of as primitive_of
from mi_refgs.surfels.primitives.primitive import register as register
from mi_refgs.surfels.primitives.surfel import Surfel

register(Surfel())
register(Gaussian())
