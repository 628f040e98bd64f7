"""Block-sparse products of Fourier buffers in Dr.Jit: rows of one grid to rows of others, by frequency."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.kernels.device import upload
from mi_refgs.shade.light.fourier import BLOCK, COEFFICIENT, read, to_device, write


@dataclass(frozen=True)
class Mixing:
    """A block-sparse matrix between Fourier buffers: a lane owns four outputs, entries [begin, end)."""

    outputs: int
    begin: Any
    end: Any
    slot: Any  # first of the four outputs
    step: Any  # from one output to the next
    source: Any  # input coefficient of each entry
    weights: Any  # four floats an entry


def make_mixing(blocks: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]], outputs: int) -> Mixing:
    """The matrix of pieces (rows, columns, M), each with slots of its columns, slots and limits of its rows.

    Pieces that share output rows add up.
    """
    slots, steps, sources, weights = [], [], [], []
    for matrix, slot_in, slot_out, limit_out in blocks:
        quads = matrix.reshape(-1, BLOCK, *matrix.shape[1:])
        b, m, k = np.nonzero((quads != 0).any(1).swapaxes(1, 2))
        slots.append(slot_out[BLOCK * b] + m)
        steps.append(limit_out[BLOCK * b])
        sources.append(slot_in[k] + m)
        weights.append(quads[b, :, k, m])
    slot, step, source, weight = (np.concatenate(a) for a in (slots, steps, sources, weights))
    order = np.lexsort((source, slot))
    slot, step, source, weight = slot[order], step[order], source[order], weight[order]
    begin = np.flatnonzero(np.diff(slot, prepend=-1))
    end = np.append(begin[1:], len(slot))
    # Equally long lanes side by side: a packet runs until its longest lane ends.
    lanes = np.argsort(begin - end, kind="stable")
    begin, end = begin[lanes], end[lanes]
    first, last, place, stride, origin = to_device(begin, end, slot[begin], step[begin], source)
    entries = upload(weight)
    return Mixing(outputs, first, last, place, stride, origin, entries)


def mix_rows(matrix: Mixing, coefficients: Any) -> Any:
    """The block-sparse product of a `Mixing` and a Fourier buffer."""

    def body(n: Any, *acc: Any) -> tuple[Any, ...]:
        out = list(acc)
        source = dr.gather(mi.UInt32, matrix.source, n)
        weight = dr.gather(mi.Vector4f, matrix.weights, n)
        for c, x in enumerate(read(COEFFICIENT, coefficients, source)[:6]):
            for row in range(BLOCK):
                out[6 * row + c] = dr.fma(weight[row], x, out[6 * row + c])
        return (n + 1, *out)

    zeros = [dr.zeros(mi.Float, dr.width(matrix.begin)) for _ in range(6 * BLOCK)]
    state = dr.while_loop((mi.UInt32(matrix.begin), *zeros), lambda n, *_: n < matrix.end, body)
    out = dr.zeros(mi.Float, COEFFICIENT * matrix.outputs)
    for row in range(BLOCK):
        write(out, list(state[1 + 6 * row : 7 + 6 * row]), matrix.slot + row * matrix.step)
    return out
