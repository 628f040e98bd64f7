"""Mitsuba's own renderer of volumetric primitives, `volprim_rf_basic`: the same surfels as flat ellipsoids.

It blends three colour channels, where ours blends sixteen; it cuts a primitive off at three standard
deviations, and ends a pixel at 1 % of transmittance or 64 primitives (its default), where ours goes on to
1/255 of opacity and 0.01 %, however many they are.
Rebuilding its acceleration structure, which every step of an optimisation needs, is left out of its times.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.splatting.workload import COLOUR, Workload
from mi_refgs.reference.splat import PinholeCamera

FLATNESS = 1e-2
"""Thickness over the smaller standard deviation."""
SH_0 = 0.28209479177387814
"""The constant spherical harmonic: colour = SH_0 · coefficient + ½."""


class Volprim:
    """One workload on the device."""

    def __init__(self, workload: Workload) -> None:
        raw = {name: values.astype(np.float64) for name, values in workload.raw.items()}
        scale = np.exp(raw["scale"])
        thickness = FLATNESS * scale.min(axis=1, keepdims=True)
        rotation = raw["rotation"] / np.linalg.norm(raw["rotation"], axis=1, keepdims=True)
        self.scene = mi.load_dict(
            {
                "type": "scene",
                "primitives": {
                    "type": "ellipsoids",
                    "centers": _tensor(raw["position"]),
                    "scales": _tensor(np.concatenate([scale, thickness], axis=1)),
                    "quaternions": _tensor(rotation),
                    "opacities": _tensor(1 / (1 + np.exp(-raw["opacity"]))),
                    "sh_coeffs": _tensor((workload.features[:, :COLOUR] - 0.5) / SH_0),
                },
            }
        )
        self.sensor = mi.load_dict(_sensor(workload.pinhole))
        self.integrator = mi.load_dict({"type": "volprim_rf_basic", "srgb_primitives": False})
        self.params = mi.traverse(self.scene)
        self.keys = [f"primitives.{name}" for name in ("data", "opacities", "sh_coeffs")]
        shape = (workload.pinhole.height, workload.pinhole.width, COLOUR)
        self.weights = mi.TensorXf(workload.weights(COLOUR).T.reshape(shape))
        dr.eval(self.weights)

    def forward(self) -> Any:
        """The picture (H, W, 3)."""
        return mi.render(self.scene, sensor=self.sensor, integrator=self.integrator, spp=1)

    def both(self) -> list[Any]:
        """The gradients of every parameter for fixed adjoints of the picture."""
        for key in self.keys:
            self.params[key] = dr.detach(self.params[key])
            dr.enable_grad(self.params[key])
        picture = mi.render(self.scene, self.params, sensor=self.sensor, integrator=self.integrator, spp=1)
        dr.backward(dr.sum(picture * self.weights))
        return [dr.grad(self.params[key]) for key in self.keys]


def _tensor(values: np.ndarray) -> Any:
    return mi.TensorXf(np.ascontiguousarray(values, np.float32))


def _sensor(p: PinholeCamera) -> dict[str, Any]:
    """Mitsuba's camera of the oracle's; square pixels, the principal point in the middle."""
    return {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(0.5 * p.width / abs(p.fx)))),
        "fov_axis": "x",
        "to_world": mi.ScalarTransform4f(p.to_world.tolist()),
        "film": {
            "type": "hdrfilm",
            "width": p.width,
            "height": p.height,
            "pixel_format": "rgb",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": "independent", "sample_count": 1},
    }
