"""Environment maps in float64: prefiltered levels, lookups (texels (n, k) of the flat levels, and their
weights, which may be complex)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

Array = np.ndarray


@dataclass(frozen=True)
class Light:
    """Prefiltered levels, the map itself first, and the roughness of the others; the split-sum table."""

    levels: list[Array]  # (h, 2h, 3) each
    roughness: tuple[float, ...]
    table: Array  # (n, n, 2): [roughness, n·v]
    turn: Array | None = None  # (3, 3): from world directions to the map's
    nearness: float = 0.0  # 1 / distance of what the map shows, the same everywhere, from the `centre`
    centre: Array = field(default_factory=lambda: np.zeros(3))

    def flat(self) -> Array:
        """All texels (T, 3), level after level."""
        return np.concatenate([level.reshape(-1, 3) for level in self.levels])

    def split(self, flat: Array) -> list[Array]:
        """Inverse of `flat`."""
        ends = np.cumsum([level.size // 3 for level in self.levels])[:-1]
        return [x.reshape(y.shape) for x, y in zip(np.split(flat, ends), self.levels, strict=True)]

    def look_up(self, texel: Array, weight: Array) -> Array:
        """Weighted sums (n, 3) of texels."""
        return np.einsum("nk,nkc->nc", weight, self.flat()[texel])


def seen_from(light: Light, position: Array | None, direction: Array) -> Array:
    """Unit directions (n, 3) from the light's centre to where rays from positions (n, 3) meet its sphere."""
    if not light.nearness or position is None:
        return direction
    offset = position - light.centre
    along = np.sum(offset * direction, axis=1)
    t = np.sqrt(along**2 + light.nearness**-2 - np.sum(offset**2, axis=1)) - along
    return (offset + t[:, None] * direction) * light.nearness


def filtered(radiance: Array, filters: Sequence[Array]) -> list[Array]:
    """Levels of a map (h, 2h, 3): itself, and what each dense filter makes of it."""
    flat = [matrix @ radiance.reshape(-1, 3) for matrix in filters]
    return [radiance, *(x.reshape(h := math.isqrt(len(x) // 2), 2 * h, 3) for x in flat)]


def dense_filter(weights: Array) -> Array:
    """Matrix (2 h_out², 2 h²) of a filter from the Fourier coefficients of rows to rows, (h_out, h, M)."""
    rows, height, count = weights.shape
    φ_out, φ = ((np.arange(2 * h) + 0.5) * math.pi / h for h in (rows, height))
    across = np.cos(np.arange(count)[:, None, None] * (φ_out[:, None] - φ))
    return np.einsum("ikm,mab->iakb", weights, across, optimize=True).reshape(2 * rows**2, 2 * height**2)


def bilinear(light: Light, direction: Array, level: Array) -> tuple[Array, Array]:
    """Lookup (n, 4) of `level` (n,) in unit directions (n, 3), as Mitsuba's `envmap`: column centres are at
    half-integers, the first and last rows on the poles."""
    heights = np.array([len(x) for x in light.levels])
    firsts = np.concatenate([[0], np.cumsum(2 * heights**2)[:-1]])
    h = heights[level]
    w, first = 2 * h, firsts[level]
    x, y, z = direction.T if light.turn is None else light.turn @ direction.T
    pole = (x.real == 0) & (z.real == 0)
    sin = np.where(pole, 0, np.sqrt(np.where(pole, 1, x * x + z * z)))
    turn = atan2(np.where(pole, 0, x), np.where(pole, -1, -z)) / (2 * math.pi)
    u = np.where(turn.real < 0, turn + 1, turn) * w - 0.5
    v = atan2(sin, y) / math.pi * (h - 1)
    j = np.floor(u.real).astype(int)
    i = np.clip(np.floor(v.real).astype(int), 0, h - 2)
    s, t = u - j, v - i
    texel = [first + (i + a) * w + (j + b) % w for a in (0, 1) for b in (0, 1)]
    share = [(t if a else 1 - t) * (s if b else 1 - s) for a in (0, 1) for b in (0, 1)]
    return np.stack(texel, 1), np.stack(share, 1)


def specular(light: Light, direction: Array, roughness: Array) -> tuple[Array, Array]:
    """Lookup (n, 8) between two levels: linear in 1/r, in r⁴ below the first roughness."""
    first, r = light.roughness[0], roughness
    sharp = r.real <= first
    level = np.where(sharp, (np.where(sharp, r, first) / first) ** 4, 1.0)
    inverse = 1 / np.where(sharp, first, r)
    for a, b in zip(light.roughness, light.roughness[1:], strict=False):
        level = level + clip((inverse - 1 / a) / (1 / b - 1 / a), 0, 1)
    lower = np.clip(level.real.astype(int), 0, len(light.levels) - 2)
    t = (level - lower)[:, None]
    one, two = (bilinear(light, direction, lower + k) for k in range(2))
    return np.concatenate([one[0], two[0]], 1), np.concatenate([(1 - t) * one[1], t * two[1]], 1)


def irradiance(light: Light, direction: Array) -> tuple[Array, Array]:
    """Lookup (n, 4) of the roughest level."""
    return bilinear(light, direction, np.full(len(direction), len(light.levels) - 1))


def radiance_of(map_: Array, direction: Array) -> Array:
    """Radiance (…, 3) of a map (h, 2h, 3) in unit directions (…, 3)."""
    light, flat = Light([map_], (), np.empty(0)), direction.reshape(-1, 3)
    return light.look_up(*bilinear(light, flat, np.zeros(len(flat), int))).reshape(direction.shape)


def table_lookup(table: Array, n_dot_v: Array | float, roughness: Array | float) -> Array:
    """Bilinear (A, B) (…, 2) in a table [roughness, N·V], texel centres, outer half texels extrapolated."""
    n = len(table)
    x, y = clip(n_dot_v, 0, 1) * n - 0.5, clip(roughness, 0, 1) * n - 0.5
    j, i = (np.clip(np.floor(q.real), 0, n - 2).astype(int) for q in (x, y))
    s, t = (x - j)[..., None], (y - i)[..., None]
    upper = (1 - s) * table[i, j] + s * table[i, j + 1]
    lower = (1 - s) * table[i + 1, j] + s * table[i + 1, j + 1]
    return (1 - t) * upper + t * lower


def clip(x: Array | float, low: float, high: float) -> Array:
    """Clip real parts; complex numbers outside lose their derivative."""
    return np.where(np.real(x) < low, low, np.where(np.real(x) > high, high, x))


def atan2(y: Array, x: Array) -> Array:
    value = np.arctan2(y.real, x.real)
    if not (np.iscomplexobj(y) or np.iscomplexobj(x)):
        return value
    squared = x.real**2 + y.real**2
    slope = (x.real * np.imag(y) - y.real * np.imag(x)) / np.where(squared > 0, squared, 1)
    return value + 1j * slope
