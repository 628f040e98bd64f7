"""Hard cases against a float64 reference.

    python -m benchmarks.stability                     every case, in 15 minutes on 2 cores
    python -m benchmarks.stability --only light -o out cases whose name contains a word; repeatable
    python -m benchmarks.stability --small -o out      one case

Writes stability.json; `python -m benchmarks.pages` makes the tables and the plot of docs/stability.md."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np
from tqdm import tqdm

from benchmarks.common.fits import make_trainer, sphere_data
from benchmarks.common.report import benchmark
from benchmarks.stability import bias, response
from benchmarks.stability.cases import catalogue
from benchmarks.stability.measure import IMAGE_LIMIT, measure as measure_case
from mi_refgs.data.images import Pixels
from mi_refgs.kernels.device import upload_tensor
from mi_refgs.methods.method import LIGHT

SURFELS, SIZE, VIEWS, STEPS = 300, 32, 3, 24


def _with_peak(view: Any) -> dict[str, Any]:
    image = view.image.copy()
    image[SIZE // 2, SIZE // 2] = 1e6
    return {"pixels": Pixels(image, view.alpha), "is_linear_radiance": True}


FITS: dict[str, dict[str, Any]] = {
    "plain": {},
    "a texel of the light starts at 1e6": {"light": lambda raw: np.where(np.arange(raw.size) < 3, 1e6, raw)},
    "the whole light starts at 1e6": {"light": lambda raw: np.full_like(raw, 1e6)},
    "the light starts black (raw -80)": {"light": lambda raw: np.full_like(raw, -80.0)},
    "a pixel of 1e6 in linear images": {"view": _with_peak},
    "over-exposed images": {"view": lambda v: {"pixels": Pixels(np.ones_like(v.image), v.alpha)}},
    "under-exposed images": {
        "view": lambda v: {"pixels": Pixels(1 - v.alpha[..., None] + 0 * v.image, v.alpha)}
    },
    "all-transparent images": {
        "view": lambda v: {"pixels": Pixels(np.ones_like(v.image), np.zeros_like(v.alpha))}
    },
}


def fit(name: str) -> dict[str, Any]:
    """STEPS steps in each stage of the full method: how many values are not finite.

    Images change after the start, which needs masks."""
    trainer = make_trainer(SURFELS, sphere_data(SIZE, VIEWS, np.random.default_rng(0)))
    case = FITS[name]
    if "view" in case:
        views = tuple(replace(view, **case["view"](view)) for view in trainer.data.views)
        data = replace(trainer.data, views=views, is_linear_radiance=views[0].is_linear_radiance)
        trainer.use(data)
    if "light" in case:
        raw = trainer.fit.params[LIGHT].numpy()
        trainer.fit.params[LIGHT] = upload_tensor(case["light"](raw.ravel()).reshape(raw.shape))
        trainer.fit.optimiser.reset(LIGHT)
    losses = []
    for _, stage in trainer.method.stages():
        if stage.shading.at == "pixel":
            trainer.method.event["mesh"].apply(trainer)
        for _ in range(STEPS):
            trainer.step()
            losses.append(float(trainer.loss[0]))
        trainer.fit.iteration = stage.until  # the next stage
    values = [*(x.numpy() for x in trainer.fit.params.values()), np.array(losses)]
    return {"name": name, "non_finite": sum(int(np.sum(~np.isfinite(x))) for x in values)}


@dataclass(frozen=True)
class Settings:
    """One run: all that the page shows, or `only` cases whose name contains one of these words."""

    only: tuple[str, ...] = ()


def measure(settings: Settings, quiet: bool) -> dict[str, Any]:
    """Measure; `failed` has a line for each case that does not hold."""
    only = settings.only
    chosen = [case for case in catalogue() if any(word in case.name for word in only or [""])]
    rows = []
    for case in tqdm(chosen, desc="cases", disable=quiet):
        rows.append(_finite(measure_case(case, floors=case.quick).record()))
        dr.flush_malloc_cache()  # an image of 4096² leaves gigabytes
    result: dict[str, Any] = {"rows": rows}
    result |= {name: [] for name in ("curve", "losses", "fits", "rules", "gradient")}
    if not only:
        result |= {name: [_finite(row) for row in found] for name, found in response.measure().items()}
        result |= bias.measure() | {"fits": [fit(name) for name in FITS]}
    return result | {"failed": failures(result)}


def _finite(row: dict[str, Any]) -> dict[str, Any]:
    """None for what is not finite."""
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()}


def failures(result: dict[str, Any]) -> list[str]:
    """What does not hold, one line each."""
    lines = [f"{row['case']}: {row['verdict']}" for row in result["rows"] if "FAILS" in row["verdict"]]
    for row in result["curve"]:
        if _misses(row):
            lines.append(f"sRGB at {row['at']}: value {row['value']}, slope {row['slope']}")
    for row in result["losses"]:
        if row["non_finite"] or _misses(row):
            lines.append(f"loss, {row['name']}: value {row['value']}, slope {row['slope']}")
    lines += [f"fit, {row['name']}: not finite" for row in result["fits"] if row["non_finite"]]
    return lines


def _misses(row: dict[str, Any]) -> bool:
    return not all(row[key] is not None and row[key] <= IMAGE_LIMIT for key in ("value", "slope"))


def main() -> int:
    """Measure; returns the exit code of `benchmark`."""
    return benchmark("stability", __doc__, measure, Settings(), Settings(("one surfel",)), ("--only", "only"))


if __name__ == "__main__":
    sys.exit(main())
