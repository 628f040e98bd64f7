"""Primitives that are splatted: surfels and 3D Gaussians. A new one is another file, registered here."""

from mi_refgs.surfels.primitives.gaussian import Gaussian
from mi_refgs.surfels.primitives.primitive import register
from mi_refgs.surfels.primitives.surfel import Surfel

register(Surfel())
register(Gaussian())
