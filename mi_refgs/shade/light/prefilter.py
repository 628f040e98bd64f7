"""The GGX prefilter: FFTs of the rows, and between their coefficients `lobe_matrices` as one sparse matrix.

    radiance ─ FFT ─► coefficients ─ matrix ─► coefficients of every level ─ inverse FFT ─► levels

`analyse` and `synthesise` are each other's transpose. All of it runs on the host, since a light is small, but
for a GPU, which would wait for it: `prefilter_kernels`. The levels are one flat buffer, TEXEL floats per
texel: RGBA, A unused; the map itself comes first."""

import functools
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
from scipy import fft
from scipy.sparse import csc_matrix

from mi_refgs.kernels.device import upload
from mi_refgs.kernels.linear import linear
from mi_refgs.shade.light.lobe_matrices import build_levels
from mi_refgs.shade.light.prefilter_kernels import TEXEL, Kernels
from mi_refgs.types import Float, TensorXf, UInt32


@dataclass(frozen=True)
class Operator:
    """The prefilter of maps with `height` rows, and where each level is in the result."""

    height: int
    matrix: csc_matrix  # float32, from coefficients of the map to those of all levels, one after the other
    info: UInt32  # 4 a level: first texel, h, w, 0; level 0 is the map itself
    shapes: tuple[tuple[int, int], ...]  # (first texel, h) of each level, the same on the host
    texels: int  # of all levels
    kernels: Kernels | None  # in place of `apply` and `apply_transposed`

    def apply(self, radiance: np.ndarray) -> np.ndarray:
        """Levels (texels, TEXEL) float32 of radiance (h, 2h, 3)."""
        levels = np.zeros((self.texels, TEXEL), np.float32)
        levels[: 2 * self.height**2, :3] = radiance.reshape(-1, 3)
        coefficients = _product(self.matrix, analyse(radiance))
        ends = np.cumsum([h * (h + 1) for _, h in self.shapes[1:]])
        for (first, h), end in zip(self.shapes[1:], ends, strict=True):
            filtered = synthesise(coefficients[end - h * (h + 1) : end], h)
            levels[first : first + 2 * h * h, :3] = filtered.reshape(-1, 3)
        return levels

    def apply_transposed(self, δlevels: np.ndarray) -> np.ndarray:
        """Adjoint of `apply`: δradiance (h, 2h, 3) of δlevels (texels, TEXEL)."""
        δmap, *maps = (δlevels[f : f + 2 * h * h, :3].reshape(h, 2 * h, 3) for f, h in self.shapes)
        coefficients = np.concatenate([analyse(level) for level in maps])
        return δmap + synthesise(_product(self.matrix.T, coefficients), self.height)


def analyse(rows: np.ndarray) -> np.ndarray:
    """Σ_j x_j exp(-i mφ_j) of the rows of (h, 2h, 3), by frequency: ((h + 1) h, 3) complex64."""
    phase = np.exp(-1j * _first_angles(len(rows))).astype(np.complex64)
    return np.asarray(fft.rfft(rows.swapaxes(0, 1), axis=0) * phase[:, None, None]).reshape(-1, 3)


def synthesise(coefficients: np.ndarray, height: int) -> np.ndarray:
    """Re Σ_m c_m exp(i mφ_j) of what `analyse` returns: rows (h, 2h, 3) float32."""
    weight = np.full(height + 1, float(height))  # the inverse FFT counts inner frequencies twice
    weight[[0, -1]] = 2 * height
    scale = (weight * np.exp(1j * _first_angles(height))).astype(np.complex64)
    rows = fft.irfft(coefficients.reshape(height + 1, height, 3) * scale[:, None, None], axis=0)
    return np.asarray(rows.swapaxes(0, 1))


def _first_angles(height: int) -> np.ndarray:
    return np.arange(height + 1) * (np.pi / (2 * height))


def _product(matrix: csc_matrix, coefficients: np.ndarray) -> np.ndarray:
    """Real matrix times complex64 columns (n, 3)."""
    parts: np.ndarray = matrix @ np.ascontiguousarray(coefficients).view(np.float32)
    return parts.view(np.complex64)


@functools.lru_cache(maxsize=4)
def operator(variant: str, height: int) -> Operator:
    """The prefilter for maps (height, 2·height), built once per variant of Mitsuba (64 rows: 1 s)."""
    built, values, rows, columns, first = build_levels(height), [], [], [], 0
    for weights in built:
        i, k, m = np.nonzero(weights)
        values.append(weights[i, k, m].astype(np.float32))
        rows.append(first + m * len(weights) + i)
        columns.append(m * height + k)
        first += len(weights) * (len(weights) + 1)
    places = np.concatenate(rows), np.concatenate(columns)
    matrix = csc_matrix((np.concatenate(values), places), shape=(first, height * (height + 1)))
    heights = [height, *(len(weights) for weights in built)]
    *firsts, texels = np.cumsum([0, *(2 * h * h for h in heights)]).tolist()
    shapes = tuple(zip(firsts, heights, strict=True))
    info = upload(np.array([(first, h, 2 * h, 0) for first, h in shapes]), mi.UInt32)
    kernels = Kernels(height, shapes, matrix, texels) if variant.startswith("cuda") else None
    return Operator(height, matrix, info, shapes, texels, kernels)


def prefilter(radiance: TensorXf) -> tuple[Operator, Any]:
    """Operator and levels (flat RGBA, under AD) of a radiance tensor (h, 2h, 3), h a multiple of 4."""
    shape = tuple(radiance.shape)
    found = operator(mi.variant(), shape[0])
    if found.kernels is not None:
        return found, linear(radiance.array, found.kernels.apply, found.kernels.apply_transposed)

    def levels(texels: Float) -> Float:
        return upload(found.apply(texels.numpy().reshape(shape)))

    def adjoint(δlevels: Float) -> Float:
        return upload(found.apply_transposed(δlevels.numpy().reshape(-1, TEXEL)))

    return found, linear(radiance.array, levels, adjoint)
