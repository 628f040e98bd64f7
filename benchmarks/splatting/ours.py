"""The product's splatter, called as its user would: whole, and stage by stage."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.splatting.workload import Workload
from mi_refgs.device import upload
from mi_refgs.fit.train import Trainer
from mi_refgs.profiling.counts import Counts, count
from mi_refgs.render import pipeline
from mi_refgs.splat import Blended, Camera, blend, list_by_tile, project, splat
from mi_refgs.surfels.table import Surfels


class Ours:
    """One call of `splat`, on the device."""

    def __init__(self, surfels: Surfels, columns: list[Any], camera: Camera, weights: np.ndarray) -> None:
        self.camera, self.raw, self.columns = camera, surfels.raw, columns
        self.set_weights(weights)
        dr.eval(self.raw, self.columns)

    @staticmethod
    def of(workload: Workload, features: int) -> Ours:
        """A workload with so many features."""
        columns, weights = workload.columns(features), workload.weights(features + 2)
        return Ours(workload.surfels(), columns, workload.camera(), weights)

    @staticmethod
    def of_step(trainer: Trainer) -> Ours:
        """The call that a trainer's next step makes, which it takes."""
        calls = []

        def noted(surfels: Surfels, features: list[Any], camera: Camera, shift: Any = None) -> Blended:
            calls.append((surfels.detach(), dr.detach(features), camera))
            return splat(surfels, features, camera, shift)

        pipeline.splat = noted
        try:
            trainer.step()
        finally:
            pipeline.splat = splat
        surfels, columns, camera = calls[0]
        bare = Surfels({name: surfels.raw[name] for name in surfels.primitive.widths})
        shape = (len(columns) + 2, camera.width * camera.height)
        return Ours(bare, columns, camera, np.random.default_rng(0).normal(size=shape))

    def set_weights(self, weights: np.ndarray) -> None:
        """Adjoints (maps, H·W) of the maps: features, depth, alpha."""
        self.weights = [upload(row) for row in weights]
        dr.eval(self.weights)

    def forward(self) -> list[Any]:
        """Every map."""
        with dr.suspend_grad():
            blended = splat(Surfels(self.raw), self.columns, self.camera)
        return _maps(blended)

    def both(self) -> list[Any]:
        """Every map, and the gradients of every parameter for fixed adjoints of the maps."""
        raw, columns = self._leaves()
        blended = splat(Surfels(raw), columns, self.camera)
        maps = _maps(blended)
        self._send_back(maps)
        gradients = [dr.grad(leaf) for leaf in [*raw.values(), *columns]]
        return [*maps, *gradients]

    def counts(self) -> Counts:
        """The work of a view."""
        with dr.suspend_grad():
            footprints = project(Surfels(self.raw), self.camera)
            return count(footprints, list_by_tile(footprints, self.camera), self.camera)

    def launches(self, call: Callable[[], Any]) -> tuple[int, int]:
        """Kernel launches of a warm call, and the kernels that it compiled."""
        before = dr.detail.launch_stats()
        dr.eval(call())
        dr.sync_thread()
        after = dr.detail.launch_stats()
        return after[0] - before[0], after[2] - before[2]

    def stages(self, repeats: int) -> dict[str, float | None]:
        """Median milliseconds of project, bin, sort, blend, adjoint, scatter, project backward.

        Between barriers. `scatter` is what the adjoint's accumulation costs, by leaving it out; None where it
        does not accumulate by Dr.Jit's scatters of whole rows.
        """
        rows = [self._staged() for _ in range(repeats + 1)][1:]
        return {
            stage: None if first is None else float(np.median([row[stage] for row in rows]))
            for stage, first in rows[0].items()
        }

    def _staged(self) -> dict[str, Any]:
        found: dict[str, Any] = {}
        raw, columns = self._leaves()
        footprints = _timed(found, "project", lambda: project(Surfels(raw), self.camera))
        with dr.suspend_grad():
            with _sorts_timed() as sorts:
                lists = _timed(found, "bin", lambda: list_by_tile(footprints, self.camera))
            found["sort"] = 1e3 * sum(sorts)
            found["bin"] -= found["sort"]
            _timed(found, "blend", lambda: _maps(blend(footprints, columns, lists, self.camera)))
        for stage, changed in (("adjoint", False), ("without scatter", True)):
            detached = dr.detach(footprints), dr.detach(columns)
            leaves = [*detached[0].columns, *detached[1]]
            dr.enable_grad(leaves)
            maps = _maps(blend(*detached, lists, self.camera))
            dr.eval(maps)
            with _scatter_left_out(changed) as met:
                _timed(found, stage, partial(self._gradients, maps, leaves))
            if changed:
                lean = found.pop(stage)
                found["scatter"] = max(found["adjoint"] - lean, 0.0) if met else None
            else:
                δcolumns = [dr.grad(leaf) for leaf in detached[0].columns]
        dr.set_grad(footprints.columns, δcolumns)

        def back() -> Any:
            dr.enqueue(dr.ADMode.Backward, footprints.columns)
            dr.traverse(dr.ADMode.Backward)
            return [dr.grad(leaf) for leaf in raw.values()]

        _timed(found, "project backward", back)
        return found

    def _gradients(self, maps: list[Any], leaves: list[Any]) -> list[Any]:
        self._send_back(maps)
        return [dr.grad(leaf) for leaf in leaves]

    def _leaves(self) -> tuple[dict[str, Any], list[Any]]:
        raw, columns = dr.detach(self.raw), dr.detach(self.columns)
        dr.enable_grad(raw, columns)
        return raw, columns

    def _send_back(self, maps: list[Any]) -> None:
        for image, weight in zip(maps, self.weights, strict=True):
            dr.set_grad(image, weight)
        dr.enqueue(dr.ADMode.Backward, maps)
        dr.traverse(dr.ADMode.Backward)


def _maps(blended: Blended) -> list[Any]:
    """Those that have derivatives."""
    return [*blended.features, blended.depth, blended.alpha]


def _timed(found: dict[str, Any], stage: str, call: Callable[[], Any]) -> Any:
    dr.eval()
    dr.sync_thread()
    begin = time.perf_counter()
    result = call()
    dr.eval(result)
    dr.sync_thread()
    found[stage] = 1e3 * (time.perf_counter() - begin)
    return result


SORTS = ((dr, "argsort"), (dr.detail, "block_mkperm"))
"""Dr.Jit's functions that sort."""


@contextmanager
def _sorts_timed() -> Iterator[list[float]]:
    """The seconds of each call of SORTS in the block; where one calls another, those of the outer."""
    seconds: list[float] = []
    inside: list[bool] = []

    def timed(original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        if inside:
            return original(*args, **kwargs)
        dr.eval(args)
        dr.sync_thread()
        begin = time.perf_counter()
        inside.append(True)
        try:
            result = original(*args, **kwargs)
        finally:
            inside.pop()
        dr.eval(result)
        dr.sync_thread()
        seconds.append(time.perf_counter() - begin)
        return result

    originals = [getattr(owner, name) for owner, name in SORTS]
    try:
        for (owner, name), original in zip(SORTS, originals, strict=True):
            setattr(owner, name, partial(timed, original))
        yield seconds
    finally:
        for (owner, name), original in zip(SORTS, originals, strict=True):
            setattr(owner, name, original)


@contextmanager
def _scatter_left_out(really: bool) -> Iterator[list[int]]:
    """Replace each accumulation of whole rows by one store of a number a lane; the list counts them.

    The number is the sum of the row's, so that everything that makes the row is still computed. Wrong
    gradients come out of it: only its time is of use.
    """
    if not really:
        yield []
        return
    original, met = dr.scatter_add, []

    def lean(target: Any, value: Any, index: Any, active: Any = True, **options: Any) -> None:
        if not isinstance(value, mi.ArrayXf):
            original(target, value, index, active, **options)
            return
        met.append(1)
        lane = dr.arange(mi.UInt32, dr.width(index)) % dr.width(target)
        dr.scatter(target, sum(value[1:], value[0]), lane, active)

    dr.scatter_add = lean
    try:
        yield met
    finally:
        dr.scatter_add = original
