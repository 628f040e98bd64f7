"""The machine, supported variants, NumPy arrays on the device, functions that are traced once."""

import contextlib
import functools
import gc
import os
import platform
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.errors import InputError

LOOK_AHEAD = 64  # elements that kernels read beyond an array's end, at most: the widest SIMD vector
ALIGNMENT = 64  # bytes of the widest SIMD vector


def machine() -> dict[str, Any]:
    """Processor, threads and versions, for reports of times."""
    found = None
    with contextlib.suppress(OSError):
        found = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text("utf-8"), re.MULTILINE)
    return {
        "cpu": found.group(1) if found else platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "threads": int(dr.thread_count()),
        "system": f"{platform.system()} {platform.machine()}",
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
        "mitsuba_variant": mi.variant(),
    }


def is_supported(variant: str | None) -> bool:
    """Whether the renderer supports a variant: arrays with derivatives, and RGB colour."""
    return variant is not None and variant.endswith("_ad_rgb")


def require_supported_variant(what: str) -> None:
    """Raise InputError that starts with `what` under a variant that is not supported."""
    if not is_supported(mi.variant()):
        remedy = "call mi.set_variant('llvm_ad_rgb') or mi.set_variant('cuda_ad_rgb') first"
        raise InputError(f"'{mi.variant()}' is not supported", what, "variant", remedy)


def children_of(parent: Any) -> list[tuple[str, Any]]:
    """What an object of Mitsuba hands to `mi.traverse`, by names: its objects, which that opens, and its
    values."""
    found: list[tuple[str, Any]] = []

    class Children(mi.TraversalCallback):
        def put(self, name: str, value: Any, *flags: Any) -> None:
            found.append((name, value))

        put_object = put_value = put

    parent.traverse(Children())
    return found


def aligned(values: np.ndarray, dtype: Any = np.float32) -> np.ndarray:
    """A flat copy aligned to SIMD vectors, LOOK_AHEAD zeros after its end: others need more kernels."""
    size, count = np.dtype(dtype).itemsize, np.size(values)
    whole: np.ndarray = np.zeros((count + LOOK_AHEAD) * size + ALIGNMENT, np.uint8)
    start = -whole.ctypes.data % ALIGNMENT
    padded: np.ndarray = whole[start : start + (count + LOOK_AHEAD) * size].view(dtype)
    padded[:count] = np.ravel(values)
    return padded


def upload(values: np.ndarray, kind: Any = None) -> Any:
    """A flat mi.Float (or another `kind`) in memory of Dr.Jit: kernels read beyond the end of what
    `mi.Float(values)` wraps on the CPU. Raises InputError under a variant that is not supported."""
    require_supported_variant("mi_refgs")
    kind = mi.Float if kind is None else kind
    dtypes = {mi.Float: np.float32, mi.UInt32: np.uint32, mi.Int32: np.int32, mi.Bool: np.bool_}
    count = np.size(values)
    padded = aligned(values, dtypes[kind])
    own = dr.empty(kind, count)
    if count:
        index = dr.arange(mi.UInt32, count)
        dr.scatter(own, dr.gather(kind, kind(padded), index), index)
        dr.eval(own)
        dr.sync_thread()  # the kernel reads NumPy's memory, which may go with the caller's last reference
    return own


def upload_tensor(values: np.ndarray, kind: Any = None) -> Any:
    """The same as an mi.TensorXf (or another `kind` of tensor)."""
    require_supported_variant("mi_refgs")
    kind = mi.TensorXf if kind is None else kind
    return kind(upload(values, dr.array_t(kind)), shape=values.shape)


def replayed(function: Callable[..., Any], limit: int | None = None) -> Callable[..., Any]:
    """Trace a function by `dr.freeze` per kind of arguments (at most `limit` are kept) and replay it.
    Python's garbage collector is off meanwhile: to free a scene while recording aborts the process."""
    frozen = dr.freeze(function, limit=limit, warn_after=10**9)

    @functools.wraps(function)
    def call(*args: Any) -> Any:
        collects = gc.isenabled()
        gc.disable()
        try:
            return frozen(*args)
        finally:
            if collects:
                gc.enable()

    return call
