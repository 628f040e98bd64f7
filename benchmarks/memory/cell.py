"""One image or gradient in a process of its own, whose peak memory is printed.

Discs that cover a sphere twice, however many there are; deferred split-sum shading with spherical harmonics.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import mi_refgs  # noqa: F401  (chooses the LLVM before Dr.Jit loads)

import drjit as dr  # isort: skip
import mitsuba as mi
import numpy as np

from benchmarks.common.scenes import discs
from benchmarks.common.timing import peak_bytes
from mi_refgs.shade.light.envmap import EnvironmentLight

AOVS = "n:normal,d:depth,al:albedo,r:roughness,m:metallic,di:diffuse,sp:specular"
CHANNELS = {"image": 5, "AOVs": 5 + 3 + 1 + 3 + 1 + 1 + 3 + 3, "gradient": 5}
"""Channels of R, G, B, alpha, the weight and the AOVs."""
KINDS = tuple(CHANNELS)


def scene(kind: str, size: int, surfels: int) -> Any:
    """A Mitsuba scene of a sphere of discs, seen by a camera of size² pixels."""
    rng = np.random.default_rng(0)
    raw = discs(surfels, degree=1) | {
        "scale": np.log(rng.uniform(0.5, 1.5, (surfels, 2)) * 2.5 / np.sqrt(surfels)),
        "opacity": rng.uniform(0, 4, (surfels, 1)),
    }
    del raw["indirect_sh"]
    tensors = {name: mi.TensorXf(values.astype(np.float32)) for name, values in raw.items()}
    light = EnvironmentLight.from_radiance(np.ones((64, 128, 3), np.float32)).raw
    aovs = {"aovs": AOVS} if kind == "AOVs" else {}
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgba"}
    camera = {
        "type": "perspective",
        "fov": 40,
        "to_world": mi.ScalarTransform4f().look_at([0, -3, 0.5], [0, 0, 0], [0, 0, 1]),
        "film": film | {"rfilter": {"type": "box"}},
    }
    integrator = {"type": "refgs", **tensors, "light": light, **aovs}
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": camera})


def main(kind: str, size: int, samples: int, surfels: int) -> None:
    """Render, and differentiate for a gradient by all channels; print the peak and the seconds as JSON."""
    mi.set_variant("llvm_ad_rgb")
    of = scene(kind, size, surfels)
    start = time.perf_counter()
    if kind == "gradient":
        params = mi.traverse(of)
        leaves = [params[key] for key in params.keys() if key.startswith("integrator.")]
        dr.enable_grad(leaves)
        params.update()
        dr.backward(dr.mean(mi.render(of, params, spp=samples), axis=None))
        dr.eval([dr.grad(leaf) for leaf in leaves])
    else:
        mi.render(of, spp=samples).numpy()
    dr.sync_thread()
    seconds = time.perf_counter() - start
    print(json.dumps({"measured": peak_bytes(), "seconds": seconds}))


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
