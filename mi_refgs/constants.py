"""Conventions and thresholds: the one place that fixes a letter, a frame or a number.

Frames      World is right-handed, in scene units. The camera frame is Mitsuba's: +z forward, +x left, +y up;
            data readers convert once, at the door.
Pixels      The centre of pixel (i, j) is (i + ½, j + ½); only `splat.camera.pixel_centres` says so in code.
Quaternions (x, y, z, w) everywhere but in PLY files, which store w first.
Colour      Linear radiance everywhere; the sRGB curve is applied once, at the camera (`render.display`).
Letters     N surfels, M surfel-tile pairs, P pixels, K channels, α opacity after the footprint,
            T transmittance, w = αT, δx the adjoint of x, a_from_b an index map."""

import math

MAX_NUMBER = 1e9  # largest |number| in a method or transforms file: its square fits float32
RIGID_TOLERANCE = 1e-3  # largest |RᵀR - 1| of a camera: float32 in text files is exact to 1e-6

# ---------------- footprint and compositing ----------------

ALPHA_MAX = 0.99  # of one surfel at one pixel: keeps 1/(1-α) ≤ 100 in the adjoint. [3DGS, appendix C]
ALPHA_MIN = 1.0 / 255.0  # below one 8-bit step α is skipped: the declared discontinuity. [3DGS, appendix C]
TRANSMITTANCE_MIN = 1e-4  # T at which a pixel ends: 8 bits show no more. [3DGS, appendix C]
LOW_PASS_INV_VARIANCE = 12.0  # 1/pixel²: the variance of a pixel's box; 2DGS has 2. [docs/decisions.md]

EDGE_ON_COSINE = 1e-4  # |cos| of plane and ray below which a surfel is culled: its point has no digits left

SIZE_RANGE = 1e7
"""Bounds of a standard deviation over the surfel's depth, 1/SIZE_RANGE and SIZE_RANGE: below, the low-pass
decides, above it is a plane. Fourth powers of such ratios fit float32."""

SORT_REACH = 1.0  # deviations up to which a surfel's plane tells its depth in a tile: best near-mirrors
SORT_DEPTH_RANGE = 5.0  # factor by which a surfel's depth in a tile may exceed its centre's in the sort
GAUSSIAN_LOW_PASS = 0.3  # pixel²: added to a 3D Gaussian's screen covariance, as elsewhere. [3DGS, code]

GAUSSIAN_SLOPE_MARGIN = 0.15
"""Part of the image around it beyond which a Gaussian is linearised at the border. [3DGS, released code]"""

TILE_SIZES = ((512.0, (4, 4)), (1024.0, (8, 4)), (math.inf, (8, 8)))
"""Tile width and height up to each focal length, pixels. [docs/decisions.md]"""
FINE_TILE = 512.0, (4, 2)  # instead, where normals vary over surfels: a tile's order shows in them

PATCH_EDGE = 8  # pixels: width and height of what one SIMD vector works on, one tile or several
LANE_PIXELS_PER_AXIS = 2  # pixels: edge of the square that a lane composites, reading each surfel once
FOCAL_TOLERANCE = 1e-5  # relative error that changes no tiles: rays of a Mitsuba sensor give 5e-7


def tile_size(focal: float, fine: bool = False) -> tuple[int, int]:
    """Tile width and height for a focal length, pixels; `fine`: where normals vary over surfels."""
    sizes = (FINE_TILE, *TILE_SIZES) if fine else TILE_SIZES
    return next(size for limit, size in sizes if focal < limit * (1 - FOCAL_TOLERANCE))


GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))  # between neighbours of a spherical Fibonacci lattice, radians


RAW_LIMIT = 1e18
"""Bound of |raw value| of positions, SH and the light, whose square fits float32: beyond it, and at NaN, a
surfel covers no pixel and gets zero gradient; a texel is black."""

NORM_FLOOR = 1e-20  # squared length below which a vector has no direction: callers have named fallbacks
MAX_TURN = 0.3  # rad, of a normal per standard deviation of its surfel: 99 % of those of a mirror need 0.23
COVERAGE_FLOOR = 1e-3  # alpha below which a pixel counts as empty: material maps are divided by alpha
FACING_TOLERANCE = 0.25  # cosine by which a normal may point away before it is turned: 14°
DEFAULT_PRESET = "standard"  # how long a fit takes where nothing is said
