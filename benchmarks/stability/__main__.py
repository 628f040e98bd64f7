"""Hard cases against a float64 reference.

    python -m benchmarks.stability                     every case, in 15 minutes on 2 cores
    python -m benchmarks.stability --quick -o out      without large cases, fits, the method's own error
    python -m benchmarks.stability --only light -o out cases whose name contains a word; repeatable

Writes stability.json; `python -m benchmarks.pages` makes the tables and the plot of docs/stability.md. The
exit code is 1 if a case fails."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np
from tqdm import tqdm

from benchmarks.common.fits import make_trainer, sphere_data
from benchmarks.common.report import make_parser, write_measured
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
    """STEPS steps in each stage of the full method: first and last loss, values that are not finite.

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
    return {
        "name": name,
        "steps": len(losses),
        "first": losses[0],
        "last": losses[-1],
        "non_finite": sum(int(np.sum(~np.isfinite(x))) for x in values),
    }


def measure(quick: bool = False, only: list[str] | None = None, quiet: bool = False) -> dict[str, Any]:
    """Measure everything on the page; `only`: cases whose name contains one of these words."""
    words = only or [""]
    cases = [case for case in catalogue() if case.quick or not quick]
    chosen = [case for case in cases if any(word in case.name for word in words)]
    rows = []
    for case in tqdm(chosen, desc="cases", disable=quiet):
        rows.append(_finite(measure_case(case, floors=case.quick).record()))
        dr.flush_malloc_cache()  # an image of 4096² leaves gigabytes
    result: dict[str, Any] = {"rows": rows}
    result |= {name: [] for name in ("curve", "losses", "fits", "rules", "gradient")}
    if not only:
        result |= {name: [_finite(row) for row in found] for name, found in response.measure().items()}
    if not (only or quick):
        result |= bias.measure() | {"fits": [fit(name) for name in FITS]}
    return result


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


def main(arguments: list[str] | None = None) -> int:
    """Measure; returns the exit code, 1 if a case fails, 2 for bad input."""
    parser = make_parser("stability", __doc__)
    parser.add_argument("--quick", action="store_true", help="what every test run can afford")
    parser.add_argument("--only", metavar="WORD", action="append", default=[], help="cases named so")
    options = parser.parse_args(arguments)
    failed: list[str] = []

    def run() -> dict[str, Any]:
        result = measure(options.quick, options.only, options.quiet)
        failed.extend(failures(result))
        return result

    code = write_measured("stability", options, run)
    print(*failed, sep="\n", end="\n" * bool(failed), file=sys.stderr)
    return code or int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
