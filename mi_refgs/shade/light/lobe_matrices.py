"""The GGX lobe as a linear operator on a lat-long map, diagonal in azimuth. NumPy float64, no Dr.Jit.

With N = V = R the lobe depends only on the angle between R and L, so on a lat-long grid the filter commutes
with rotations about the pole: it acts on each azimuthal frequency m separately, as a small matrix from input
rows to output rows. Where a lobe is wide, all but the lowest frequencies vanish and cost nothing.

Rows are at θ = πi/(h-1) from +y (first and last row are the poles), columns at φ = 2π(j+½)/w with
φ = atan2(x, -z), as in Mitsuba's `envmap`. Radiance between texels is bilinear, as Mitsuba looks it up."""

import numpy as np
from scipy.sparse import csr_matrix

LEVEL_ROUGHNESS = (0.1, 0.15, 0.22, 0.32, 0.45, 0.65, 1.0)
"""Of the filtered levels (level 0 is the map): mixtures of two are within 6 % (L1) of the lobe between."""
LEVEL_MAX_HEIGHT = (128, 128, 128, 64, 32, 32, 32)  # rows at most: 1.4 % (L1)


def row_angles(h: int) -> np.ndarray:
    """Polar angles (h,) of the rows, radians from +y."""
    return np.linspace(0.0, np.pi, h)


def column_angles(w: int) -> np.ndarray:
    """Azimuths (w,) of the columns, radians, φ = atan2(x, -z)."""
    return (np.arange(w) + 0.5) * (2 * np.pi / w)


def map_directions(h: int) -> np.ndarray:
    """Unit world directions (h, 2h, 3) of the texels of a lat-long map."""
    θ, φ = np.meshgrid(row_angles(h), column_angles(2 * h), indexing="ij")
    return np.stack([np.sin(θ) * np.sin(φ), np.cos(θ), -np.sin(θ) * np.cos(φ)], axis=-1)


def lobe(cos_angle: np.ndarray, roughness: float) -> np.ndarray:
    """Unnormalised GGX lobe max(L·R, 0) D(R·H) of the angle between L and R, α = roughness². [Karis 2013]"""
    α2 = roughness**4
    d = 0.5 * (1 + α2) - (0.5 * (1 - α2)) * cos_angle  # = 1 + (α²-1) cos²(half the angle)
    return np.maximum(cos_angle, 0) / (d * d)


def row_areas(h: int) -> np.ndarray:
    """∫ hat_i(θ) sinθ dθ (h,): a row's share of the sphere, linear between rows; they sum to 2."""
    θ = row_angles(h)
    s, c, d = np.sin(θ), np.cos(θ), np.pi / (h - 1)
    # Exact integral of the linear ramp over one interval, seen from its left and from its right end.
    left = c[:-1] + (s[:-1] - s[1:]) / d
    right = -c[1:] + (s[1:] - s[:-1]) / d
    return np.concatenate([left, [0.0]]) + np.concatenate([[0.0], right])


def resampling(count: int, wanted: int, periodic: bool = False) -> csr_matrix:
    """Matrix (wanted, count) between grids of rows, or `periodic` columns: hats to coarsen, else linear."""
    last = 0 if periodic else 1  # rows are on both ends of their interval, columns are not
    ratio = (count - last) / (wanted - last)
    offset = 0.5 * (ratio - 1) if periodic else 0.0
    centre, reach = ratio * np.arange(wanted) + offset, max(ratio, 1.0)  # in steps of the given grid
    index = np.round(centre).astype(int)[:, None] + np.arange(-int(reach) - 1, int(reach) + 2)
    weight = np.maximum(0, 1 - np.abs(centre[:, None] - index) / reach)
    if periodic:
        index %= count
    else:
        weight[(index < 0) | (index >= count)] = 0
        index = np.clip(index, 0, count - 1)
        weight *= row_areas(count)[index] if wanted < count else 1
    weight /= weight.sum(axis=1, keepdims=True)
    row = np.repeat(np.arange(wanted), index.shape[1])
    matrix = csr_matrix((weight.ravel(), (row, index.ravel())), shape=(wanted, count))
    matrix.eliminate_zeros()
    return matrix


def resample(radiance: np.ndarray, height: int, width: int | None = None) -> np.ndarray:
    """Radiance (h, w, 3) at (height, width, 3), by default 2·height wide; coarser, it keeps its integral."""
    h, w, _ = radiance.shape
    width = width or 2 * height
    rows, columns = resampling(h, height), resampling(w, width, periodic=True)
    coarse = rows.astype(radiance.dtype) @ radiance.reshape(h, -1)
    turned = coarse.reshape(height, w, 3).swapaxes(0, 1).reshape(w, -1)
    return (columns.astype(radiance.dtype) @ turned).reshape(width, height, 3).swapaxes(0, 1)


def fourier_rows(roughness: float, h: int, h_out: int) -> np.ndarray:
    """Matrices (h_out, h, h+1) of the lobe: entry (i, k, m) times Σ_j x[k, j] (cos, sin)(mφ_j), summed over
    k, is (a_m, b_m) of Σ_m (a_m cos mφ + b_m sin mφ), the filtered radiance of row i; m = 0 … h, w = 2h."""
    w, texel = 2 * h, np.pi / (h - 1)
    core = 2 * roughness**2  # the lobe falls to a quarter at this angle, radians
    s = max(2, int(np.ceil(2.5 * texel / core)) + 1)  # samples along a texel
    t = (np.arange(s) + 0.5) / s
    θ = (np.arange((h - 1) * s) + 0.5) * (texel / s)
    # A sample lies between the texels d and d + 1: its bilinear weights, then the transform of the texels.
    shares = np.stack([1 - t, t], axis=1)
    m = np.arange(h + 1)
    # Over half the circle, the other half is its mirror image: (h+1, h+1).
    cosines = np.cos(2 * np.pi / w * m * np.arange(h + 1)[:, None])
    cos_φ = np.cos((np.arange(h * s) + 0.5) * (2 * np.pi / (w * s)))
    out, half = np.zeros((h_out, h, h + 1)), (h_out + 1) // 2  # the other half is mirrored below
    for i, θ_out in enumerate(row_angles(h_out)[:half]):
        near = θ <= θ_out + 0.5 * np.pi  # rows beyond hold no light of this hemisphere
        cos_angle = np.outer(np.sin(θ_out) * np.sin(θ[near]), cos_φ)
        cos_angle += (np.cos(θ_out) * np.cos(θ[near]))[:, None]
        parts = (lobe(cos_angle, roughness).reshape(-1, s) @ shares).reshape(-1, h, 2)
        texels = np.zeros((len(θ), h + 1))
        texels[near, :-1] = parts[..., 0]
        texels[near, 1:] += parts[..., 1]
        texels *= np.sin(θ)[:, None]
        rows = shares.T @ texels.reshape(h - 1, s, h + 1)
        out[i, :-1] += rows[:, 0]
        out[i, 1:] += rows[:, 1]
    out[:half] = (out[:half].reshape(-1, h + 1) @ cosines).reshape(half, h, h + 1)
    out[:half] /= out[:half, :, :1].sum(axis=1, keepdims=True)  # a constant map stays constant, exactly
    out[half:] = out[: h_out - half][::-1, ::-1]
    scale = np.full(h + 1, 2.0 / w)
    scale[[0, -1]] = 1.0 / w
    return out * scale


def build_levels(h: int) -> list[np.ndarray]:
    """Weights (h_out, h, M) of each filtered level, from Fourier coefficients of the rows of a map (h, 2h) to
    its own; a map of more rows than the finest is averaged down to it first."""
    h_in = min(h, LEVEL_MAX_HEIGHT[0])
    built = []
    for roughness, cap in zip(LEVEL_ROUGHNESS, LEVEL_MAX_HEIGHT, strict=True):
        weights = fourier_rows(roughness, h_in, min(h_in, cap))
        if h_in < h:
            m = np.arange(h_in + 1)
            first = resampling(2 * h, 2 * h_in, periodic=True).toarray()[0]
            offset = column_angles(2 * h) - column_angles(2 * h_in)[0]
            transfer = (first[:, None] * np.cos(m * offset[:, None])).sum(0) * (h_in / h)
            rows = resampling(h, h_in).toarray()
            weights = np.einsum("ikm,kn,m->inm", weights, rows, transfer, optimize=True)
        rows = weights.shape[0]
        weights = weights[:, :, : rows + 1]  # a level of w columns has frequencies up to w/2
        if rows < h_in and roughness > 0.5:  # the lobe ends at the horizon rather than before it
            # The edge at the horizon rings, and light would turn negative: Lanczos' factors fade it out.
            weights = weights * np.sinc(np.arange(rows + 1) / (rows + 1))
        kept = np.abs(weights) > 1e-5 * np.abs(weights).max()  # the rest is 0.05 % of a lobe (L1)
        kept[:, :, 0] = True  # the mean is never thinned: constants stay constant
        built.append(np.where(kept, weights, 0))
    return built
