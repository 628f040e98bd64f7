"""Conventions and thresholds: the one place that fixes a letter, a frame or a number.

Frames      World is right-handed, in scene units. The camera frame is Mitsuba's: +z forward, +x left, +y up;
            data readers convert once, at the door.
Pixels      The centre of pixel (i, j) is (i + ½, j + ½); only `splat.camera.pixel_centres` says so in code.
Quaternions (x, y, z, w) everywhere but in PLY files, which store w first.
Colour      Linear radiance everywhere; the sRGB curve is applied once, at the camera (`fit.losses`).
Letters     N surfels, M surfel-tile pairs, P pixels, K channels, α opacity after the footprint,
            T transmittance, w = αT, δx the adjoint of x, a_from_b an index map.
"""

# ---------------- cameras ----------------

RIGID_TOLERANCE = 1e-3
"""Largest deviation of RᵀR from the identity in a camera: float32 in text files carries about 1e-6."""

# ---------------- footprint and compositing ----------------

ALPHA_MAX = 0.99
"""Largest opacity of one surfel at one pixel: keeps 1/(1-α) ≤ 100 in the adjoint. [3DGS, appendix C]"""

ALPHA_MIN = 1.0 / 255.0
"""A contribution below one 8-bit step is skipped; the declared discontinuity. [3DGS, appendix C]"""

TRANSMITTANCE_MIN = 1e-4
"""A pixel ends before the surfel that would bring T below this: 8 bits show no more. [3DGS, appendix C]"""

LOW_PASS_INV_VARIANCE = 12.0
"""1/pixel²: the screen-space filter is a Gaussian of the variance of a pixel's box, 1/12. The 1/2 of 2DGS
(§4.2) widens every outline by about a pixel, and a fit then shrinks the surface behind it
(docs/decisions.md)."""

EDGE_ON_COSINE = 1e-4
"""|cos| between a surfel's plane and the ray to its centre below which it is culled: it covers less than
1/10000 of its area, and its ray-plane intersection loses every float32 digit."""

MEDIAN_TRANSMITTANCE = 0.5
"""The median depth is that of the last surfel met while T is above one half. [2DGS, §5]"""

SORT_REACH = 1.0
"""Standard deviations from its centre up to which a surfel's plane tells its depth in a tile. Near-mirrors
fitted with 0 (sorted by centres), 1 and 3 reach 26.0, 26.7 and 26.3 dB on test views: with a longer reach
the order follows every error of a normal."""

SORT_DEPTH_RANGE = 5.0
"""Factor by which a surfel's depth in a tile may exceed that of its centre in the sort: a plane that turns
away from the camera within its reach has no depth of its own there."""

TILE = (4, 4)
"""Width and height in pixels of a tile, whose pixels share a list of surfels. Larger tiles need fewer lists,
but give one order to more pixels and evaluate more surfels that they miss: measurements in
docs/decisions.md."""

TILE_LANES = (2, 2)
"""SIMD lanes of a tile, along x and y. A lane does the pixel at its place in each block of this size: what it
reads of a surfel then serves them all, and what it adds to the surfel's gradient is their sum."""

PACKET_TILES = (2, 2)
"""Tiles along x and y that stand side by side in the 16 lanes of AVX-512. A packet waits for the longest of
their lists; those of neighbours are alike, and hold the same surfels."""

# ---------------- surfels ----------------

NORM_FLOOR = 1e-20
"""Squared length below which a vector has no direction; the caller then takes a named fallback."""

COVERAGE_FLOOR = 1e-3
"""Accumulated alpha below which a pixel counts as empty: material maps are divided by alpha, and a quarter of
an 8-bit step of coverage shows nothing worth dividing by."""

FACING_TOLERANCE = 0.25
"""Cosine by which a normal may point away from the camera before it is turned round: 14° behind the
silhouette."""
