"""What a run fills into the page: its tables and a few numbers."""

from __future__ import annotations

from typing import Any

from benchmarks.common.report import table
from benchmarks.stability.measure import (
    GRADIENT_LIMIT,
    GRADIENTS,
    ILL,
    IMAGE_LIMIT,
    KEPT,
    NEGLIGIBLE,
    ORDER_LIMIT,
)
from benchmarks.stability.run import failures

SHORT = {"radiance_sh": "SH", "roughness": "rough.", "indirect_sh": "indirect"}
Row = dict[str, Any]


def page(result: dict[str, Any]) -> dict[str, Any]:
    """By name in page.md."""
    rows, limits = result["rows"], (IMAGE_LIMIT, GRADIENT_LIMIT, ORDER_LIMIT, NEGLIGIBLE)
    names = ("image_limit", "gradient_limit", "order_limit", "negligible")
    keys = ("value", "slope", "textbook_value", "textbook_slope")
    return dict(zip(names, map(_e, limits), strict=True)) | {
        "count": len(rows),
        "hold": sum(row["verdict"] == "holds" for row in rows),
        "ill": sum(row["verdict"].startswith("ill") for row in rows),
        "failed": len(failures(result)),
        "non_finite": sum(row["non_finite"] for row in [*rows, *result["losses"], *result["fits"]]),
        "textbook_misses": sum(row["textbook"] is None or row["textbook"] > IMAGE_LIMIT for row in rows),
        "kept": f"{KEPT:.0%}",
        "ill_factor": f"{ILL:g}",
        "cases": table(["case", *CASES], [[row["case"], *_case(row)] for row in rows]),
        "gradients": table(
            ["case", *(SHORT.get(n, n) for n in GRADIENTS)],
            [[row["case"], *(_class(row, name) for name in GRADIENTS)] for row in rows],
        ),
        "curve": table(
            ["sRGB at", "value", "slope", "textbook value", "textbook slope"],
            [[row["at"], *(_e(row[key]) for key in keys)] for row in result["curve"]],
        ),
        "losses": table(
            ["picture", "loss", "gradient", "not finite"],
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


CASES = (
    "image", "maps", "gradient, largest", "not finite", "textbook image", "image, 1 ulp", "gradient, 1 ulp",
    "verdict",
)  # fmt: skip


def _case(row: Row) -> list[Any]:
    worst = max((row[f"gradient_{n}"] or 0.0 for n in GRADIENTS), default=0.0)
    ulps = [_e(x) if (x := row[key]) else "" for key in ("ulp_image", "ulp_gradient")]  # cheap cases
    errors = [*map(_e, (row["image"], row["maps"], worst)), row["non_finite"], _e(row["textbook"])]
    return [*errors, *ulps, row["verdict"]]


def _class(row: Row, name: str) -> str:
    error = row[f"gradient_{name}"]
    return "" if error is None else _e(error) + " †" * (name in row["negligible"].split())


def _e(value: float | None) -> str:
    if value is None or value == float("inf"):
        return "not finite"
    return "0" if value == 0 else f"{value:.1e}"


def _p(value: float, sign: str = "+") -> str:
    return "0" if abs(value) < 1e-9 else f"{100 * value:{sign}.2g} %"
