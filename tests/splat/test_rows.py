"""Packed rows: values, additions, and the memory that these take."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.splat import rows as rows_module
from mi_refgs.splat.rows import PackedRows

ROWS = 37


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
