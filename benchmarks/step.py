"""Where the time of a training step goes: milliseconds by phase, kernel launches, cache misses once warm.

    python benchmarks/step.py [--surfels 20000] [--size 200] [--steps 30] [--json]

Surfels cover a unit sphere, so every one of them is on the surface, about half of them seen. Each phase is
timed between barriers, in steps of their own; `step` is the wall time of undisturbed steps, which is less
than the sum because kernels fuse across phases; `splat` is that of the step's own splat and its gradients by
themselves, called as a user would. `refgs profile` does the same for a scene of yours, and
`python -m benchmarks.splatting` measures the splatter alone, its errors included.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

import mi_refgs  # noqa: F401  (chooses the LLVM before Dr.Jit loads)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

METHOD = "ref_gaussian"
SECONDS = 1.0
"""For which the splat alone is timed, at most."""


def sphere_data(size: int, views: int, rng: np.random.Generator) -> Any:
    """Views of a unit sphere with a smooth random image on it."""
    from mi_refgs.data.dataset import Dataset, View
    from mi_refgs.reference.camera import look_at

    focal = 0.5 * size / np.tan(np.radians(20))
    y, x = np.mgrid[0:size, 0:size] + 0.5 - size / 2
    inside = (np.hypot(x, y) / focal < np.tan(np.arcsin(0.25))).astype(np.float32)
    images = []
    for i in range(views):
        outward = rng.normal(size=3)
        to_world = look_at(4 * outward / np.linalg.norm(outward), np.zeros(3))
        waves = [np.sin(x * rng.uniform(0.02, 0.1) + y * rng.uniform(0.02, 0.1)) for _ in range(3)]
        colour = 0.5 + 0.4 * np.stack(waves, axis=-1)
        image = (inside[..., None] * colour + 1 - inside[..., None]).astype(np.float32)
        c = size / 2
        images.append(
            View(
                f"{i}",
                size,
                size,
                focal,
                focal,
                c,
                c,
                to_world,
                image,
                inside,
                None,
                None,
                is_linear_radiance=False,
            )
        )
    return Dataset(Path("sphere"), "train", tuple(images), np.ones(3, np.float32), False, None)


def make_trainer(surfels: int, data: Any, variant: str = METHOD) -> tuple[Any, Any]:
    """A trainer at the preset `standard` that keeps its number of surfels, and its method."""
    from mi_refgs import methods
    from mi_refgs.fitting.train import Trainer

    settings = [f"surfels.count={surfels}", f"surfels.max_count={surfels}", "surfels.inside=0", "refine={}"]
    method = methods.load(variant, "standard", settings)
    return Trainer(method, data), method


def step_times(surfels: int, size: int, steps: int, variant: str = METHOD) -> dict[str, Any]:
    """For every stage of the schedule: a step's time, launches, cache misses, and where its time goes."""
    from benchmarks.common.timing import milliseconds
    from benchmarks.splatting.renderers import Ours
    from mi_refgs.profiling.profile import profile_stage

    trainer, method = make_trainer(surfels, sphere_data(size, 8, np.random.default_rng(0)), variant)
    result = {}
    for name, stage in method.stages():
        if stage.shading.at == "pixel" and method.mesh is not None:
            trainer.extract_mesh()
        found = profile_stage(trainer, name, steps)
        with trainer.held_in_stage(name) as prepare:
            prepare()
            splat_ms = milliseconds({name: Ours.of_step(trainer).both}, SECONDS, steps)[name]
        result[name] = {
            "step_ms": round(found.step_ms, 2),
            "splat_ms": round(splat_ms, 2),
            "launches": found.launches,
            "cache_misses": found.misses,
            "phases_ms": {key: round(value, 2) for key, value in found.phases_ms.items()},
        }
    return result


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--surfels", type=int, default=20_000)
    parser.add_argument("--size", type=int, default=200, help="image edge, pixels")
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--variant", default=METHOD)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    result: dict[str, Any] = {"surfels": options.surfels, "size": options.size, "threads": dr.thread_count()}
    result |= step_times(options.surfels, options.size, options.steps, options.variant)
    json.dump(result, sys.stdout, indent=None if options.json else 2)
    print()


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))  # as a script it does not find its neighbours
    main()
