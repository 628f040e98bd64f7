"""Split-sum table: brute-force quadrature, derivatives, and the cache."""

from collections.abc import Callable
from itertools import product
from pathlib import Path
from unittest.mock import Mock

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.reference.light import table_lookup
from mi_refgs.reference.lobe import split_sum_entry
from mi_refgs.shade import brdf
from tests.helpers import with_grad


def test_a_lookup_needs_one_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wherever NumPy has put the table: kernels on disk serve every later process."""
    table = brdf.table()
    memory = np.empty(table.size + 64, np.float32)
    first = -memory.ctypes.data % 64 // 4
    kernels = []
    for offset in (0, 1):
        moved = memory[first + offset : first + offset + table.size].reshape(table.shape)
        moved[:] = table
        monkeypatch.setattr(brdf, "table", lambda moved=moved: moved)
        brdf.device_table.cache_clear()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            dr.eval(brdf.split_sum(dr.opaque(mi.Float, 0.3, 8), dr.opaque(mi.Float, 0.4, 8)))
            kernels.append([kernel["ir"].getvalue() for kernel in dr.kernel_history() if "ir" in kernel])
    brdf.device_table.cache_clear()
    assert kernels[0] == kernels[1] != []


def test_against_brute_force() -> None:
    places = [*product([0.05, 0.15, 0.35, 0.6, 0.9, 1.0], [0.06, 0.15, 0.5, 0.95, 1.0])]
    n_dot_v, roughness = np.array(places, np.float32).T
    found = [np.array(x) for x in brdf.split_sum(mi.Float(n_dot_v), mi.Float(roughness))]
    np.testing.assert_allclose(np.stack(found, 1), [split_sum_entry(*place) for place in places], atol=5e-4)


def test_derivatives_in_both_arguments(rng: np.random.Generator) -> None:
    n = 200
    # Half-way between grid lines of the bilinear patches, so that no difference straddles one.
    n_dot_v = (rng.integers(1, 254, n) + 0.5 + rng.uniform(0.2, 0.8, n)) / 256
    roughness = (rng.integers(1, 254, n) + 0.5 + rng.uniform(0.2, 0.8, n)) / 256
    weight = rng.normal(size=(2, n))
    x, y = with_grad((mi.Float(n_dot_v), mi.Float(roughness)))
    a, b = brdf.split_sum(x, y)
    dr.backward(a * mi.Float(weight[0]) + b * mi.Float(weight[1]))
    table = brdf.table().astype(np.float64)
    ε = 1e-5

    def value(u: float, v: float, w: np.ndarray) -> float:
        return float(table_lookup(table, u, v) @ w)

    for k in range(n):
        u, v, w = n_dot_v[k], roughness[k], weight[:, k]
        for got, plus, minus in (
            (dr.grad(x)[k], value(u + ε, v, w), value(u - ε, v, w)),
            (dr.grad(y)[k], value(u, v + ε, w), value(u, v - ε, w)),
        ):
            assert abs(got - (plus - minus) / (2 * ε)) < 1e-3 + 1e-3 * abs(got)


def test_finite_outside_the_table() -> None:
    x, y = with_grad((mi.Float(-1, 0, 0, 1, 1, 2, 0.5, -3), mi.Float(-1, 0, 1, 0, 1, 2, -2, 7)))
    a, b = brdf.split_sum(x, y)
    dr.backward(a + b)
    for value in (a, b, dr.grad(x), dr.grad(y)):
        assert dr.all(dr.isfinite(value))
    assert dr.all((a > -1e-4) & (b > -1e-4) & (a + b < 1 + 2e-4))


def test_cache_is_written_read_and_survives_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    computed = brdf.table()
    compute = Mock(return_value=computed)
    monkeypatch.setattr(brdf, "compute_table", compute)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    path, fresh = tmp_path / "mi_refgs" / brdf.CACHE_NAME, brdf.table.__wrapped__
    damage: list[Callable[[], object]] = [
        lambda: path.write_bytes(path.read_bytes()[:1000]),
        lambda: np.save(path, np.zeros((2, 2))),
    ]
    for count, change in ((1, None), (1, None), (2, damage[0]), (3, damage[1])):
        if change is not None:
            change()
        np.testing.assert_array_equal(fresh(), computed)
        assert compute.call_count == count and [*path.parent.iterdir()] == [path]


def test_the_cached_table_is_the_one_that_this_code_computes() -> None:
    """Otherwise the cache of an earlier version hides from every other test what was changed since."""
    np.testing.assert_allclose(brdf.table(), brdf.compute_table(), atol=1e-6)
