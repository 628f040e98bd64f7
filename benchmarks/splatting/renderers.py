"""The product's splatter, whole and phase by phase, and Mitsuba's `volprim` on the same surfels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.splatting.cases import COLOUR, Workload
from mi_refgs.kernels.device import upload
from mi_refgs.kernels.timing import listening
from mi_refgs.render.scene_xml import sensors_of
from mi_refgs.splat import Camera, Composited, list_by_tile, project, splat
from mi_refgs.splat.lanes import advance
from mi_refgs.surfels.table import Surfels


class Counts(NamedTuple):
    """Splatting work of one view."""

    pairs: int  # surfel-tile pairs listed
    evaluated: int  # surfel-pixel pairs of a tile at all of its pixels, until the last of these has ended
    contributing: int  # surfel-pixel pairs with α ≥ ALPHA_MIN, before the pixel's end


class Ours:
    """One call of `splat`, on the device."""

    def __init__(self, surfels: Surfels, columns: list[Any], camera: Camera, weights: np.ndarray) -> None:
        self.camera, self.raw, self.columns = camera, surfels.raw, columns
        self.weights = [upload(row) for row in weights]  # adjoints of the maps: features, depth, alpha
        dr.eval(self.raw, self.columns, self.weights)

    @staticmethod
    def of(workload: Workload, features: int) -> Ours:
        """A workload with so many features."""
        columns, weights = workload.columns(features), workload.weights(features + 2)
        return Ours(workload.surfels(), columns, workload.camera(), weights)

    @staticmethod
    def of_step(step: Callable[[], None]) -> Ours:
        """The call that a step of a fit makes."""
        heard = _Arguments()
        with listening(heard):
            step()
        (surfels,), camera = heard.arguments["project"]
        columns = dr.detach(heard.arguments["splat forward"][1])
        shape = (len(columns) + 2, camera.width * camera.height)
        weights = np.random.default_rng(0).normal(size=shape)
        bare = Surfels({name: dr.detach(surfels.raw[name]) for name in surfels.primitive.widths})
        return Ours(bare, columns, camera, weights)

    def forward(self) -> list[Any]:
        """Every map."""
        with dr.suspend_grad():
            return _maps(splat([Surfels(self.raw)], self.columns, self.camera))

    def both(self) -> list[Any]:
        """Every map, and the gradients of every parameter for fixed adjoints of the maps."""
        raw, columns = dr.detach(self.raw), dr.detach(self.columns)
        dr.enable_grad(raw, columns)
        maps = _maps(splat([Surfels(raw)], columns, self.camera))
        for image, weight in zip(maps, self.weights, strict=True):
            dr.set_grad(image, weight)
        dr.enqueue(dr.ADMode.Backward, maps)
        dr.traverse(dr.ADMode.Backward)
        return [*maps, *(dr.grad(leaf) for leaf in (*raw.values(), *columns))]

    def counts(self) -> Counts:
        """Walk the lists as `splat.composite` does, and count; waits for the device."""
        camera, footprints = self.camera, project([Surfels(dr.detach(self.raw))], self.camera)
        lists, (width, height) = list_by_tile(footprints, camera), camera.tile
        if not lists.pairs:
            return Counts(0, 0, 0)
        lane = dr.arange(mi.UInt32, camera.tiles[0] * camera.tiles[1] * width * height)
        tile, local = lane // (width * height), lane % (width * height)
        x = (tile % camera.tiles[0]) * width + local % width - camera.tile_offset[0]
        y = (tile // camera.tiles[0]) * height + local // width - camera.tile_offset[1]
        pixel = mi.Point2f(mi.Float(x) + 0.5, mi.Float(y) + 0.5)
        begin = dr.gather(mi.UInt32, lists.pair_begin, tile)
        end = dr.gather(mi.UInt32, lists.pair_end, tile)

        def body(pair: Any, active: Any, transmittance: Any, steps: Any, hits: Any) -> Any:
            surfel = dr.gather(mi.UInt32, lists.surfel_from_pair, pair, active)
            row = [dr.gather(mi.Float, column, surfel, active) for column in footprints.columns]
            sample = footprints.primitive.evaluate(row, pixel, camera.near)
            weight, after, goes_on = advance(sample, active, transmittance)
            hits = hits + dr.select(weight > 0, mi.UInt32(1), mi.UInt32(0))
            return pair + 1, goes_on, after, steps + 1, hits

        inside = (x < camera.width) & (y < camera.height)
        state = (begin, inside, mi.Float(1), mi.UInt32(0), mi.UInt32(0))
        *_, steps, hits = dr.while_loop(state, lambda pair, active, *_: active & (pair < end), body)
        dr.eval(steps, hits)
        visited = int(dr.sum(dr.block_reduce(dr.ReduceOp.Max, steps, width * height))[0])
        return Counts(lists.pairs, width * height * visited, int(dr.sum(hits)[0]))


class _Arguments:
    """A listener that keeps what each phase is given first."""

    def __init__(self) -> None:
        self.arguments: dict[str, Any] = {}

    def call(self, phase: str, function: Callable[[], Any], arguments: Any) -> Any:
        self.arguments.setdefault(phase, arguments[0])
        return function()

    def boundary(self, value: Any, phase: str) -> Any:
        return value


def _maps(blended: Composited) -> list[Any]:
    """Those that have derivatives."""
    return [*blended.features, blended.depth, blended.alpha]


FLATNESS = 1e-2  # thickness over the smaller standard deviation
SH_0 = 0.28209479177387814  # the constant spherical harmonic: colour = SH_0 · coefficient + ½


class Volprim:
    """One workload on the device."""

    def __init__(self, workload: Workload) -> None:
        raw = {name: values.astype(np.float64) for name, values in workload.raw.items()}
        scale = np.exp(raw["scale"])
        thickness = FLATNESS * scale.min(axis=1, keepdims=True)
        rotation = raw["rotation"] / np.linalg.norm(raw["rotation"], axis=1, keepdims=True)
        ellipsoids = {
            "type": "ellipsoids",
            "centers": _tensor(raw["position"]),
            "scales": _tensor(np.concatenate([scale, thickness], axis=1)),
            "quaternions": _tensor(rotation),
            "opacities": _tensor(1 / (1 + np.exp(-raw["opacity"]))),
            "sh_coeffs": _tensor((workload.features[:, :COLOUR] - 0.5) / SH_0),
        }
        self.scene = mi.load_dict({"type": "scene", "primitives": ellipsoids})
        [self.sensor] = sensors_of([workload.camera()])
        self.integrator = mi.load_dict({"type": "volprim_rf_basic", "srgb_primitives": False})
        self.params = mi.traverse(self.scene)
        self.keys = [f"primitives.{name}" for name in ("data", "opacities", "sh_coeffs")]
        weights = np.pad(workload.weights(COLOUR), ((0, 1), (0, 0)))  # none of alpha
        shape = (workload.pinhole.height, workload.pinhole.width, COLOUR + 1)
        self.weights = mi.TensorXf(weights.T.reshape(shape))
        dr.eval(self.weights)

    def forward(self) -> Any:
        """The image (H, W, 4), with alpha."""
        return mi.render(self.scene, sensor=self.sensor, integrator=self.integrator, spp=1)

    def both(self) -> list[Any]:
        """The gradients of every parameter for fixed adjoints of the image."""
        for key in self.keys:
            self.params[key] = dr.detach(self.params[key])
            dr.enable_grad(self.params[key])
        image = mi.render(self.scene, self.params, sensor=self.sensor, integrator=self.integrator, spp=1)
        dr.backward(dr.sum(image * self.weights))
        return [dr.grad(self.params[key]) for key in self.keys]


def _tensor(values: np.ndarray) -> Any:
    return mi.TensorXf(np.ascontiguousarray(values, np.float32))
