"""Conventions and thresholds: the one place that fixes a letter, a frame or a number.

Frames      World is right-handed, in scene units. The camera frame is Mitsuba's: +z forward, +x left, +y up;
            data readers convert once, at the door.
Pixels      The centre of pixel (i, j) is (i + ½, j + ½); only `splat.camera.pixel_centres` says so in code.
Quaternions (x, y, z, w) everywhere but in PLY files, which store w first.
Colour      Linear radiance everywhere; the sRGB curve is applied once, at the camera (`render.display`).
Letters     N surfels, M surfel-tile pairs, P pixels, K channels, α opacity after the footprint,
            T transmittance, w = αT, δx the adjoint of x, a_from_b an index map.
"""

from __future__ import annotations

import math

# ---------------- input files ----------------

MAX_NUMBER = 1e9
"""Largest absolute value of a number in a method or a transforms file: no size, focal length, rate or count
has more, and its square fits float32."""

# ---------------- cameras ----------------

RIGID_TOLERANCE = 1e-3
"""Largest deviation of RᵀR from the identity in a camera: float32 in text files is exact to 1e-6."""

# ---------------- footprint and compositing ----------------

ALPHA_MAX = 0.99
"""Largest opacity of one surfel at one pixel: keeps 1/(1-α) ≤ 100 in the adjoint. [3DGS, appendix C]"""

ALPHA_MIN = 1.0 / 255.0
"""A contribution below one 8-bit step is skipped; the declared discontinuity. [3DGS, appendix C]"""

TRANSMITTANCE_MIN = 1e-4
"""A pixel ends before the surfel that would bring T below this: 8 bits show no more. [3DGS, appendix C]"""

LOW_PASS_INV_VARIANCE = 12.0
"""1/pixel²: the screen-space filter is a Gaussian of the variance of a pixel's box, 1/12. The 1/2 of 2DGS
(§4.2) widens outlines by about a pixel. [docs/decisions.md]"""

EDGE_ON_COSINE = 1e-4
"""|cos| between a surfel's plane and the ray to its centre below which it is culled: it covers less than
1/10000 of its area, and its ray-plane intersection loses every float32 digit."""

SIZE_RANGE = 1e7
"""A standard deviation counts as at least 1/SIZE_RANGE and at most SIZE_RANGE of the surfel's depth, and has
no gradient beyond: 10⁻⁷ of a depth is below every pixel, so that the low-pass decides, and 10⁷ is a plane.
The fourth powers of such ratios fit float32."""

SORT_REACH = 1.0
"""Standard deviations from its centre up to which a surfel's plane tells its depth in a tile. Near-mirrors
fitted with 0 (sorted by centres), 1 and 3 reach 26.0, 26.7 and 26.3 dB on test views."""

SORT_DEPTH_RANGE = 5.0
"""Factor by which a surfel's depth in a tile may exceed that of its centre in the sort: a plane that turns
away from the camera within its reach has no depth of its own there."""

GAUSSIAN_LOW_PASS = 0.3
"""pixel²: the screen-space filter adds it to the covariance of a 3D Gaussian. Files that others fitted were
fitted with it. [3DGS, released code]"""

GAUSSIAN_SLOPE_MARGIN = 0.15
"""Margin around the image, as a part of its width and height. A 3D Gaussian whose centre lies beyond it is
linearised at the margin's border instead of at the centre: far outside the view, the affine approximation
would cover the whole image. [3DGS, released code: 1.3 tan(fov/2)]"""

TILE_SIZES = ((512.0, (4, 4)), (1024.0, (8, 4)), (math.inf, (8, 8)))
"""Rows of (limit of the focal length, (tile width, tile height)), pixels: a camera has the tiles of the first
row whose limit is above its focal length. Large tiles evaluate more surfels that miss a pixel, small ones
need more lists. [docs/decisions.md]"""

PATCH_EDGE = 8
"""Width and height, in pixels, of the patch that one SIMD vector works on: one tile of 8 × 8, or several
smaller neighbours, whose lists are alike: a vector runs until the longest of them ends."""

LANE_PIXELS_PER_AXIS = 2
"""Width and height, in pixels, of the square that a lane composites. It reads each surfel once for all pixels
of the square, and adds the sum of their gradients to the surfel's."""


FOCAL_TOLERANCE = 1e-5
"""Relative error of a focal length up to which its tiles stay the same: the float32 rays of a Mitsuba sensor
give it back with an error of 5e-7, and common focal lengths are the limits themselves."""


def tile_size(focal: float) -> tuple[int, int]:
    """Width and height in pixels of the tiles of a camera of this focal length (pixels)."""
    return next(size for limit, size in TILE_SIZES if focal < limit * (1 - FOCAL_TOLERANCE))


# ---------------- directions ----------------

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
"""Azimuth between neighbours of a spherical Fibonacci lattice, radians."""

# ---------------- surfels ----------------

RAW_LIMIT = 1e18
"""Bound of |raw value| where an activation has none, in positions (scene units), SH and the light: its
square still fits float32. A surfel with a value beyond it, an infinite one or a NaN in any channel covers no
pixel and gets zero gradient; such a texel of the light is black."""

NORM_FLOOR = 1e-20
"""Squared length below which a vector has no direction; the caller then takes a named fallback."""

COVERAGE_FLOOR = 1e-3
"""Accumulated alpha below which a pixel counts as empty: material maps are divided by alpha, and a quarter of
an 8-bit step of coverage shows nothing worth dividing by."""

FACING_TOLERANCE = 0.25
"""Cosine by which a normal may point away from the camera before it is turned round: 14° behind the
silhouette."""

# ---------------- fits ----------------

DEFAULT_PRESET = "standard"
"""How long a fit takes where nothing is said: the preset for everyday use (`methods.read`)."""
