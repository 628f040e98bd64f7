"""Where the time of a training step goes: milliseconds by stage, kernel launches, cache misses once warm.

    python benchmarks/step.py [--surfels 20000] [--size 200] [--steps 30] [--json]

Surfels cover a unit sphere, so every one of them is on the surface, about half of them seen. Each stage is
timed between barriers, in steps of their own; `step` is the wall time of undisturbed steps, which is less
than the sum because kernels fuse across stages. Error: the splatter against its float64 oracle on the same
surfels (a 32² crop of the view).
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import mi_refgs  # noqa: F401  (chooses the LLVM before Dr.Jit loads)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip


def sphere_data(size: int, views: int, rng: np.random.Generator) -> Any:
    """Views of a unit sphere with a smooth random picture on it."""
    from mi_refgs.fit.data import Dataset, View
    from mi_refgs.reference.camera import look_at

    focal = 0.5 * size / np.tan(np.radians(20))
    y, x = np.mgrid[0:size, 0:size] + 0.5 - size / 2
    inside = (np.hypot(x, y) / focal < np.tan(np.arcsin(0.25))).astype(np.float32)
    pictures = []
    for i in range(views):
        outward = rng.normal(size=3)
        to_world = look_at(4 * outward / np.linalg.norm(outward), np.zeros(3))
        waves = [np.sin(x * rng.uniform(0.02, 0.1) + y * rng.uniform(0.02, 0.1)) for _ in range(3)]
        colour = 0.5 + 0.4 * np.stack(waves, axis=-1)
        image = (inside[..., None] * colour + 1 - inside[..., None]).astype(np.float32)
        c = size / 2
        pictures.append(
            View(f"{i}", size, size, focal, focal, c, c, to_world, image, inside, None, None, linear=False)
        )
    return Dataset(Path("sphere"), "train", tuple(pictures), np.ones(3, np.float32), False, None)


class StageClock:
    """Wraps functions so that each call is evaluated, waited for and booked under a name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._undo: list[tuple[Any, str, Any]] = []

    def wrap(self, module: Any, attribute: str, stage: str) -> None:
        """Replace module.attribute by a timed version until `restore`."""
        original = getattr(module, attribute)

        def timed(*args: Any, **kwargs: Any) -> Any:
            dr.eval(args)  # what the stage is given is not its own time
            return self.measure(stage, lambda: original(*args, **kwargs))

        self._undo.append((module, attribute, original))
        setattr(module, attribute, timed)

    def measure(self, stage: str, call: Callable[[], Any]) -> Any:
        """Run, evaluate, wait, book."""
        dr.eval()
        dr.sync_thread()
        begin = time.perf_counter()
        result = call()
        dr.eval(result)
        dr.sync_thread()
        self.seconds[stage] += time.perf_counter() - begin
        return result

    def restore(self) -> None:
        """Put the originals back."""
        for module, attribute, original in self._undo:
            setattr(module, attribute, original)


def stage_times(trainer: Any, steps: int) -> dict[str, float]:
    """Milliseconds a step by stage, between barriers."""
    splat = importlib.import_module("mi_refgs.splat")
    blend = importlib.import_module("mi_refgs.splat.blend")
    pipeline = importlib.import_module("mi_refgs.render.pipeline")
    objective = importlib.import_module("mi_refgs.fit.objective")
    optim = importlib.import_module("mi_refgs.fit.optim")
    envmap = importlib.import_module("mi_refgs.shade.envmap")
    clock = StageClock()
    clock.wrap(splat, "project", "project")
    clock.wrap(splat, "list_by_tile", "sort")
    clock.wrap(splat, "blend", "splat forward")
    clock.wrap(blend, "_blend_backward", "splat backward")
    clock.wrap(pipeline, "shade", "shade forward")
    clock.wrap(envmap.EnvironmentLight, "prefilter", "prefilter forward")
    clock.wrap(objective.losses, "ssim", "ssim forward")
    clock.wrap(optim.Adam, "step", "optimiser")
    clock.wrap(dr, "backward", "all backward")
    rows = []
    try:
        for _ in range(steps):
            clock.seconds.clear()
            clock.measure("barriered step", trainer.step)
            row = dict(clock.seconds)
            row["shade, light, loss backward"] = row.pop("all backward") - row["splat backward"]
            rows.append(row)
    finally:
        clock.restore()
    return {stage: round(1e3 * float(np.median([row[stage] for row in rows])), 2) for stage in rows[0]}


def splat_error(surfels: Any, camera: Any, view: Any) -> dict[str, float]:
    """Image error of the splatter outside the declared band, on a crop of the view.

    The largest one is that of a pair whose depths float32 cannot tell apart, blended in the other order.
    """
    from mi_refgs.reference import splat as oracle
    from mi_refgs.splat import Camera, splat

    size, corner = 32, view.width // 3
    pinhole = oracle.PinholeCamera(
        size, size, -view.fx, -view.fy, view.cx - corner, view.cy - corner, view.to_world
    )
    fast = Camera.look(
        size, size, pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy, view.to_world, pinhole.near
    )
    raw = {name: values.astype(np.float64) for name, values in surfels.to_numpy().items()}
    features = np.random.default_rng(0).uniform(size=(surfels.count, 3)).astype(np.float32)
    columns = [mi.Float(np.ascontiguousarray(column)) for column in features.T]
    with dr.suspend_grad():
        blended = splat(surfels, columns, fast)
        got = np.stack([f.numpy() for f in blended.features], axis=-1).reshape(size, size, 3)
    expected = oracle.splat(raw, features.astype(np.float64), pinhole)
    error = np.abs(got - expected.features)[~expected.band]
    return {
        "median": float(np.median(error)),
        "q99": float(np.quantile(error, 0.99)),
        "max": float(error.max()),
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--surfels", type=int, default=20_000)
    parser.add_argument("--size", type=int, default=200, help="image edge, pixels")
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--variant", default="ref_gaussian")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")

    from mi_refgs.fit import config
    from mi_refgs.fit.train import Trainer

    settings = [f"surfels.count={options.surfels}", f"surfels.max_count={options.surfels}", "refine={}"]
    method = config.load(options.variant, "standard", settings)
    data = sphere_data(options.size, 8, np.random.default_rng(0))
    trainer = Trainer(method, data)
    result: dict[str, Any] = {"surfels": options.surfels, "size": options.size, "threads": dr.thread_count()}
    for name, stage in method.stages():
        trainer.iteration = stage.until - options.steps * 3
        if stage.at == "pixel" and method.mesh is not None:
            trainer.extract_mesh()
        for _ in range(4):
            trainer.step()
        dr.sync_thread()
        launches, _, misses = dr.detail.launch_stats()
        times = []
        for _ in range(options.steps):
            begin = time.perf_counter()
            trainer.step()
            dr.sync_thread()
            times.append(time.perf_counter() - begin)
        after, _, misses_after = dr.detail.launch_stats()
        result[name] = {
            "step_ms": round(1e3 * float(np.median(times)), 2),
            "launches": (after - launches) / options.steps,
            "cache_misses": misses_after - misses,
            "stages_ms": stage_times(trainer, max(options.steps // 3, 5)),
        }
    result["splat_error"] = splat_error(trainer.surfels, trainer.targets[0].camera, data.views[0])
    json.dump(result, sys.stdout, indent=None if options.json else 2)
    print()


if __name__ == "__main__":
    main()
