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

MAX_NUMBER = 1e9  # largest |number| in a method or transforms file: its square fits float32

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
"""1/pixel²: the screen-space filter has the variance of a pixel's box. The 1/2 of 2DGS (§4.2) widens outlines
by about a pixel. [docs/decisions.md]"""

EDGE_ON_COSINE = 1e-4
"""|cos| between a surfel's plane and the ray to its centre below which it is culled: nothing of it is seen,
and its ray-plane intersection loses every float32 digit."""

SIZE_RANGE = 1e7
"""Bounds of a standard deviation over the surfel's depth, 1/SIZE_RANGE and SIZE_RANGE: below, the low-pass
decides, above it is a plane. Fourth powers of such ratios fit float32."""

SORT_REACH = 1.0
"""Standard deviations from its centre up to which a surfel's plane tells its depth in a tile. Near-mirrors
fitted with 0 (sorted by centres), 1 and 3 reach 26.0, 26.7 and 26.3 dB on test views."""

SORT_DEPTH_RANGE = 5.0
"""Factor by which a surfel's depth in a tile may exceed that of its centre in the sort."""

GAUSSIAN_LOW_PASS = 0.3
"""pixel²: added to the screen covariance of a 3D Gaussian, as in files of other programs. [3DGS, code]"""

GAUSSIAN_SLOPE_MARGIN = 0.15
"""Part of the image's width and height around it beyond which a 3D Gaussian is linearised at the margin's
border: far outside, the affine approximation would cover the image. [3DGS, released code: 1.3 tan(fov/2)]"""

TILE_SIZES = ((512.0, (4, 4)), (1024.0, (8, 4)), (math.inf, (8, 8)))
"""Rows of (limit of the focal length, (tile width, tile height)), pixels: a camera has the tiles of the first
row whose limit is above its focal length. [docs/decisions.md]"""

PATCH_EDGE = 8
"""Width and height, in pixels, of the patch that one SIMD vector works on: one tile or several."""

LANE_PIXELS_PER_AXIS = 2
"""Width and height, in pixels, of the square that a lane composites, reading each surfel once."""

FOCAL_TOLERANCE = 1e-5
"""Relative error of a focal length up to which its tiles stay the same: rays of a Mitsuba sensor give it back
with an error of 5e-7."""


def tile_size(focal: float) -> tuple[int, int]:
    """Width and height in pixels of the tiles of a camera of this focal length (pixels)."""
    return next(size for limit, size in TILE_SIZES if focal < limit * (1 - FOCAL_TOLERANCE))


GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))  # between neighbours of a spherical Fibonacci lattice, radians


RAW_LIMIT = 1e18
"""Bound of |raw value| of positions (scene units), SH and the light: its square fits float32. A surfel with a
value beyond it, or a NaN, covers no pixel and gets zero gradient; such a texel of the light is black."""

NORM_FLOOR = 1e-20
"""Squared length below which a vector has no direction; the caller then takes a named fallback."""

COVERAGE_FLOOR = 1e-3
"""Accumulated alpha below which a pixel counts as empty: material maps are divided by alpha."""

FACING_TOLERANCE = 0.25
"""Cosine by which a normal may point away before it is turned round: 14° behind the silhouette."""

DEFAULT_PRESET = "standard"  # how long a fit takes where nothing is said
