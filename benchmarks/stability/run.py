"""Measure every case, the camera response, extreme fits and the method's own error; fill the page."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np
from tqdm import tqdm

from benchmarks.common import report
from benchmarks.common.fits import make_trainer, sphere_data
from benchmarks.common.report import table
from benchmarks.stability import bias, response
from benchmarks.stability.cases import catalogue
from benchmarks.stability.measure import (
    GRADIENT_LIMIT,
    GRADIENTS,
    ILL,
    IMAGE_LIMIT,
    KEPT,
    NEGLIGIBLE,
    ORDER_LIMIT,
    Row,
)
from benchmarks.stability.measure import measure as measure_case
from mi_refgs.data.images import Pixels
from mi_refgs.fitting.state import FitSetup
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

    Images change after the start, which needs masks.
    """
    trainer, method = make_trainer(SURFELS, sphere_data(SIZE, VIEWS, np.random.default_rng(0)))
    case = FITS[name]
    if "view" in case:
        views = tuple(replace(view, **case["view"](view)) for view in trainer.data.views)
        data = replace(trainer.data, views=views, is_linear_radiance=views[0].is_linear_radiance)
        trainer.adopt(FitSetup(method, data), trainer.state())
    if "light" in case:
        raw = trainer.fit.params[LIGHT].numpy()
        trainer.fit.params[LIGHT] = upload_tensor(case["light"](raw.ravel()).reshape(raw.shape))
        trainer.fit.optimiser.reset(LIGHT)
    losses = []
    for _, stage in method.stages():
        if stage.shading.at == "pixel":
            trainer.extract_mesh()
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
    begin = time.perf_counter()
    chosen = [case for case in catalogue() if case.quick or not quick]
    if only:
        chosen = [case for case in chosen if any(word in case.name for word in only)]
    rows = []
    for case in tqdm(chosen, desc="cases", disable=quiet):
        rows.append(record(measure_case(case, floors=case.quick)))
        dr.flush_malloc_cache()  # an image of 4096² leaves gigabytes
    result: dict[str, Any] = {"machine": report.machine(), "rows": rows}
    if not only:
        result |= {name: [_finite(row) for row in found] for name, found in response.measure().items()}
    else:
        result |= {"curve": [], "losses": []}
    more = not (only or quick)
    result["fits"] = [fit(name) for name in FITS] if more else []
    result |= bias.measure() if more else {"rules": [], "gradient": []}
    return result | {"seconds": time.perf_counter() - begin}


def record(row: Row) -> dict[str, Any]:
    """For CSV and JSON: one level, None for what is not finite."""
    flat: dict[str, Any] = {
        "case": row.name,
        "image": row.image,
        "maps": row.maps,
        "ulp_image": row.image_floor,
        "ulp_gradient": max(row.gradient_floor.values(), default=0.0),
        "non_finite": row.non_finite,
        "kept": row.kept,
        "order": row.order,
        "negligible": " ".join(row.negligible),
        "verdict": row.verdict,
    }
    flat |= {f"gradient_{name}": row.gradients.get(name) for name in GRADIENTS}
    return _finite(flat)


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


SHORT = {"radiance_sh": "SH", "roughness": "rough.", "indirect_sh": "indirect"}


def page(result: dict[str, Any]) -> dict[str, Any]:
    """By name in page.md."""
    rows, limits = result["rows"], (IMAGE_LIMIT, GRADIENT_LIMIT, ORDER_LIMIT, NEGLIGIBLE)
    names = ("image_limit", "gradient_limit", "order_limit", "negligible")
    return dict(zip(names, map(_e, limits), strict=True)) | {
        "count": len(rows),
        "hold": sum(row["verdict"] == "within limits" for row in rows),
        "ill": sum(row["verdict"].startswith("ill") for row in rows),
        "failed": len(failures(result)),
        "non_finite": sum(row["non_finite"] for row in [*rows, *result["losses"], *result["fits"]]),
        "kept": f"{KEPT:.0%}",
        "ill_factor": f"{ILL:g}",
        "cases": table(["case", *COLUMNS], [[row["case"], *_case(row)] for row in rows]),
        "gradients": table(
            ["case", *(SHORT.get(n, n) for n in GRADIENTS)],
            [[row["case"], *(_class(row, name) for name in GRADIENTS)] for row in rows],
        ),
        "curve": table(
            ["sRGB at", "value", "slope"],
            [[row["at"], _e(row["value"]), _e(row["slope"])] for row in result["curve"]],
        ),
        "losses": table(
            ["image", "loss", "gradient", "not finite"],
            [[r["name"], _e(r["value"]), _e(r["slope"]), r["non_finite"]] for r in result["losses"]],
        ),
        "fits": table(
            ["fit", "steps", "first loss", "last loss", "not finite"],
            [[r["name"], r["steps"], _e(r["first"]), _e(r["last"]), r["non_finite"]] for r in result["fits"]],
        ),
        "rules": table(
            ["scene", "rule", "bias", "mean", "largest", "alpha"],
            [
                [r["scene"], r["rule"], _p(r["bias"]), _p(r["mean"], ""), _p(r["max"], ""), _p(r["alpha"])]
                for r in result["rules"]
            ],
        ),
        "cut": table(
            ["opacity", "log scale", "logit of opacity"],
            [[f"{r['opacity']:g}", _p(r["scale_bias"]), _p(r["opacity_bias"])] for r in result["gradient"]],
        ),
    }


COLUMNS = ("image", "maps", "gradient, largest", "not finite", "image, 1 ulp", "gradient, 1 ulp", "verdict")


def _case(row: dict[str, Any]) -> list[Any]:
    worst = max((row[f"gradient_{n}"] or 0.0 for n in GRADIENTS), default=0.0)
    ulps = [_e(x) if (x := row[key]) else "" for key in ("ulp_image", "ulp_gradient")]  # cheap cases
    return [*map(_e, (row["image"], row["maps"], worst)), row["non_finite"], *ulps, row["verdict"]]


def _class(row: dict[str, Any], name: str) -> str:
    error = row[f"gradient_{name}"]
    return "" if error is None else _e(error) + " †" * (name in row["negligible"].split())


def _e(value: float | None) -> str:
    if value is None or value == float("inf"):
        return "not finite"
    return "0" if value == 0 else f"{value:.1e}"


def _p(value: float, sign: str = "+") -> str:
    return "0" if abs(value) < 1e-9 else f"{100 * value:{sign}.2g} %"
