"""Arrays on the device: the values, and one kernel whatever the memory that they come from."""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import run_python

from mi_refgs.device import upload


@pytest.mark.parametrize("offset", range(5))
def test_an_upload_is_a_copy_that_needs_one_kernel(offset: int) -> None:
    """NumPy arrays at every alignment of 4 bytes: Dr.Jit's own memory is always aligned."""
    values = np.arange(1000, dtype=np.float32)[offset:]
    array = upload(values)
    np.testing.assert_array_equal(array.numpy(), values)
    values[0] = -1
    assert array[0] == offset

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        dr.eval(array * dr.opaque(mi.Float, 2))
        kernels = [kernel["ir"].getvalue() for kernel in dr.kernel_history() if "ir" in kernel]
    assert kernels
    assert "align 1," not in kernels[-1]


def test_other_shapes_types_and_nothing() -> None:
    table = np.arange(6).reshape(2, 3)
    np.testing.assert_array_equal(upload(table.T).numpy(), table.T.ravel())
    integers = upload(table, mi.UInt32)
    assert isinstance(integers, mi.UInt32)
    np.testing.assert_array_equal(integers.numpy(), table.ravel())
    assert dr.width(upload(np.zeros((0, 3)))) == 0


GARBAGE = """
import gc
import mi_refgs, mitsuba as mi, drjit as dr
mi.set_variant("llvm_ad_rgb")
from mi_refgs.device import replayed

def drop_a_scene():
    cycle = [mi.load_dict({"type": "scene", "plate": {"type": "rectangle"}})]
    dr.eval(cycle[0].ray_test(mi.Ray3f(mi.Point3f(0, 0, 1), mi.Vector3f(0, 0, -1))))
    cycle.append(cycle)

def double(x):
    gc.set_threshold(1, 1, 1)
    kept = [[] for _ in range(100)]  # enough new objects for the collector to run
    return 2 * x + len(kept) - 100

gc.set_threshold(10**6)
drop_a_scene()
y = replayed(double)(dr.opaque(mi.Float, 1, 10))
assert gc.isenabled()
gc.collect()
print(y[0])
"""


def test_garbage_is_not_collected_while_a_function_is_recorded(tmp_path: Path) -> None:
    """To release a scene then would abort the process."""
    assert run_python(GARBAGE, folder=tmp_path) == "2.0"
