"""Arrays on the device: the values, and one kernel whatever the memory that they come from."""

import os
from collections.abc import Callable
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mi_refgs
from mi_refgs.kernels.device import upload, upload_tensor
from tests.helpers import refused, run_python
from tests.scenes.integrator import raw_channels, wall


@pytest.mark.parametrize("offset", [0, 1])
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
        *_, kernel = [kernel["ir"].getvalue() for kernel in dr.kernel_history() if "ir" in kernel]
    assert "align 1," not in kernel


def test_other_shapes_types_and_nothing() -> None:
    table = np.arange(6).reshape(2, 3)
    np.testing.assert_array_equal(upload(table.T).numpy(), table.T.ravel())
    assert dr.width(upload(np.zeros((0, 3)))) == 0
    for values, kind in ((table, mi.UInt32), (table - 3, mi.Int32), (table % 2 == 1, mi.Bool)):
        np.testing.assert_array_equal(upload(values, kind).numpy(), values.ravel())
    np.testing.assert_array_equal(upload_tensor(table, mi.TensorXu).numpy(), table)


UNUSABLE: dict[str, Callable[[], object]] = {
    "an array": lambda: upload(np.zeros(3)),
    "a tensor": lambda: upload_tensor(np.zeros((3, 2))),
    "surfels": lambda: mi_refgs.Surfels.from_numpy(raw_channels()),
    "a light": lambda: mi_refgs.EnvironmentLight.constant(),
    "a mesh": lambda: mi_refgs.Occluder(wall()),
    "points": lambda: mi_refgs.from_points(np.zeros((3, 3)), np.zeros((3, 3)), rng=np.random.default_rng()),
    "a PLY file": lambda: mi_refgs.import_splats("some.ply"),
    "a run": lambda: mi_refgs.load("some"),
    "a fit": lambda: mi_refgs.fit("some", "some"),
    "a plugin": lambda: mi.load_dict({"type": "refgs", "filename": "some.ply"}),
    "a material": lambda: mi.load_dict({"type": "refgs_bsdf"}),
}


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_spectral"])
@pytest.mark.parametrize("what", UNUSABLE)
def test_unsupported_variant_is_refused_in_one_sentence(what: str, variant: str) -> None:
    mi.set_variant(variant)
    with pytest.raises(Exception, match=f"variant: '{variant}' is not supported; call mi.set_variant"):
        UNUSABLE[what]()


def test_what_was_made_under_another_variant_is_not_rendered() -> None:
    surfels = mi_refgs.Surfels.from_numpy(raw_channels())
    camera, shading = mi_refgs.Camera.look_at([3, 0, 0], size=8), mi_refgs.Shading("surfel", "radiance")
    made = mi_refgs.TrainedScene(surfels, None, None, shading, 1, 1.0)
    mi.set_variant("scalar_rgb")
    scene = mi_refgs.SurfelScene(surfels, shading)
    for draw in (lambda: mi_refgs.render_frame(scene, camera), lambda: made.renderer()(camera)):
        refused(draw, "variant: 'scalar_rgb' is not supported")


GUARDED = """
import ctypes, mmap
import mi_refgs, mitsuba as mi, drjit as dr, numpy as np
mi.set_variant("llvm_ad_rgb")
from mi_refgs.kernels.device import upload, upload_tensor

def guarded(dtype, *shape):  # at the end of pages that none follows: to read beyond it ends the process
    values = (np.arange(np.prod(shape)) % 7).astype(dtype)
    size, pages = values.nbytes, -(-values.nbytes // mmap.PAGESIZE)
    memory = mmap.mmap(-1, (pages + 1) * mmap.PAGESIZE)
    end = ctypes.addressof(ctypes.c_char.from_buffer(memory)) + pages * mmap.PAGESIZE
    assert ctypes.CDLL(None).mprotect(ctypes.c_void_p(end), ctypes.c_size_t(mmap.PAGESIZE), 0) == 0
    own = np.frombuffer(memory, dtype, values.size, pages * mmap.PAGESIZE - size).reshape(shape)
    own[...] = values.reshape(shape)
    return own

flat, table = guarded("float32", 1001), guarded("float32", 1001, 3)
for values, array in [
    (flat, upload(flat)),
    (x := guarded("uint32", 1001), upload(x, mi.UInt32)),
    (x := guarded("bool", 1001), upload(x, mi.Bool)),
    (table, upload_tensor(table).array),
    (table, dr.ravel(mi.Point3f(table.T))),
    (table, dr.ravel(mi.Vector3f(np.ascontiguousarray(table.T)))),
]:
    numbers = dr.select(array, 1, 0) if dr.is_mask_v(array) else array + 0 * dr.opaque(type(array), 1)
    dr.eval(numbers)
    np.testing.assert_array_equal(numbers.numpy(), values.ravel())
"""


@pytest.mark.skipif(os.name != "posix", reason="pages are protected by mprotect")
def test_nothing_is_read_beyond_the_end_of_an_array(tmp_path: Path) -> None:
    """Kernels read whole SIMD vectors of flat arrays; arrays of vectors are copied by Dr.Jit itself."""
    run_python(GUARDED, folder=tmp_path)


GARBAGE = """
import gc
import mi_refgs, mitsuba as mi, drjit as dr
mi.set_variant("llvm_ad_rgb")
from mi_refgs.kernels.device import replayed

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
