"""Packed rows: values, additions and their memory; columns and joined arrays in both derivative modes."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.kernels import rows as rows_module
from mi_refgs.kernels.rows import PackedRows, columns_of, joined
from tests.helpers import with_grad

ROWS = 37


@pytest.mark.parametrize("width", [1, 2, 3, 4, 8, 12, 27, 48])
def test_columns_and_their_derivatives(width: int) -> None:
    """Whatever divides the width, columns are those of the surfel model, in value, tangent and adjoint."""
    table, tangent, adjoint = np.random.default_rng(width).normal(size=(3, ROWS, width)).astype(np.float32)
    array = with_grad(mi.Float(table.ravel()))
    columns = columns_of(array, width)
    np.testing.assert_array_equal(np.stack([c.numpy() for c in columns], axis=1), table)

    dr.backward(sum(dr.sum(c * mi.Float(np.ascontiguousarray(adjoint[:, i]))) for i, c in enumerate(columns)))
    np.testing.assert_allclose(dr.grad(array).numpy().reshape(ROWS, width), adjoint, rtol=1e-6)

    moved = dr.forward_to(columns_of(with_grad(mi.Float(table.ravel()), mi.Float(tangent.ravel())), width))
    np.testing.assert_allclose(np.stack([c.numpy() for c in moved], axis=1), tangent, rtol=1e-6)


def test_joined_arrays_and_their_derivatives() -> None:
    """Arrays of several lengths, one after the other; each part has an adjoint and a tangent of its own."""
    rng = np.random.default_rng(0)
    parts = [[rng.normal(size=n).astype(np.float32) for n in sizes] for sizes in ((5, 3, 7), (2, 4, 1))]
    first, second = with_grad([[mi.Float(x) for x in part] for part in parts])
    whole = joined(first, second)
    weights = [rng.normal(size=dr.width(x)).astype(np.float32) for x in whole]
    for found, a, b in zip(whole, *parts, strict=True):
        np.testing.assert_array_equal(found.numpy(), np.concatenate([a, b]))
    dr.backward(sum(dr.sum(x * mi.Float(w)) for x, w in zip(whole, weights, strict=True)))
    for a, b, w in zip(first, second, weights, strict=True):
        np.testing.assert_array_equal(dr.grad(a).numpy(), w[: dr.width(a)])
        np.testing.assert_array_equal(dr.grad(b).numpy(), w[dr.width(a) :])

    [whole] = joined([mi.Float(parts[0][0])], [with_grad(mi.Float(parts[1][0]), mi.Float([1, 2]))])
    np.testing.assert_array_equal(dr.forward_to(whole).numpy(), [0] * 5 + [1, 2])


def values(rows: PackedRows) -> np.ndarray:
    return np.stack([column.numpy() for column in rows.columns()], axis=1)


@pytest.mark.parametrize("copies", [rows_module.COPIES_BYTES, 0])
@pytest.mark.parametrize("width", [5, 8, 19])
def test_rows_pack_fetch_and_add(width: int, copies: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rows_module, "COPIES_BYTES", copies)
    rng = np.random.default_rng(width)
    table = rng.normal(size=(ROWS, width)).astype(np.float32)
    rows = PackedRows.pack([mi.Float(np.ascontiguousarray(column)) for column in table.T])
    np.testing.assert_array_equal(values(rows), table)

    picked = rng.integers(0, ROWS, 200).astype(np.uint32)
    active = rng.uniform(size=200) < 0.5
    fetched = rows.fetch(mi.UInt32(picked), mi.Bool(active))
    expected = np.where(active[:, None], table[picked], 0)
    np.testing.assert_array_equal(np.stack([c.numpy() for c in fetched[:width]], axis=1), expected)

    sums = PackedRows.zeros(ROWS, width)
    sums.add(mi.UInt32(picked), [mi.Float(np.ascontiguousarray(c)) for c in table[picked].T], mi.Bool(active))
    expected = np.zeros_like(table)
    np.add.at(expected, picked[active], table[picked][active])
    np.testing.assert_allclose(values(sums), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("threads", "mode"), [(2, dr.ReduceMode.Expand), (64, dr.ReduceMode.Local)])
def test_copies_of_a_gradient_are_bounded(
    threads: int, mode: dr.ReduceMode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A million surfels of 24 floats would be 6 GB on 64 threads: no copies then."""
    used = []
    monkeypatch.setattr(dr, "thread_count", lambda: threads)
    monkeypatch.setattr(dr, "scatter_add", lambda *_, mode: used.append(mode))
    rows = PackedRows(mi.Float(0) + dr.zeros(mi.Float, 24_000_000), 1_000_000, 24)
    rows.add(mi.UInt32(0), [mi.Float(1)] * 24, True)
    assert set(used) == {mode}
