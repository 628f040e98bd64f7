"""The page: what a user needs in five lines, then the tables."""

from __future__ import annotations

from typing import Any

from benchmarks.common.report import prose, table
from benchmarks.stability.measure import (
    GRADIENT_LIMIT,
    GRADIENTS,
    ILL,
    IMAGE_LIMIT,
    KEPT,
    NEGLIGIBLE,
    ORDER_LIMIT,
)  # fmt: skip
from benchmarks.stability.run import failures

SHORT = {
    "position": "position", "rotation": "rotation", "scale": "scale", "opacity": "opacity",
    "radiance_sh": "SH", "albedo": "albedo", "metallic": "metallic", "roughness": "rough.",
    "indirect_sh": "indirect", "light": "light",
}  # fmt: skip


def page(result: dict[str, Any]) -> str:
    """Markdown."""
    parts = [_opening(result), _how(), _cases(result), _gradients(result), _response(result), _fits(result)]
    parts += [_method(result), _again(result)]
    return "\n\n".join(part for part in parts if part) + "\n"


def _opening(result: dict[str, Any]) -> str:
    rows = result["rows"]
    ill = [row for row in rows if row["verdict"].startswith("ill")]
    non_finite = sum(row["non_finite"] for row in [*rows, *result["losses"], *result["fits"]])
    better = [row for row in rows if row["textbook"] is None or row["textbook"] > IMAGE_LIMIT]
    failed = failures(result)
    lines = [
        f"{len(rows)} hard cases, pictures and gradients of every parameter class: "
        f"{sum(row['verdict'] == 'holds' for row in rows)} hold, {len(ill)} are ill-conditioned, "
        f"{len(failed)} fail. {non_finite} values are not finite.",
        f"What holds: images within {_e(IMAGE_LIMIT)} of float64, gradients within {_e(GRADIENT_LIMIT)}, at "
        "any size of the scene, anywhere near the camera, for any value of a parameter.",
        "What not to trust: surfels seen nearly edge-on (below 0.1°), where normals of a pixel cancel, and a "
        "film so large that a unit in the last place of a position is a part of a pixel. There the inputs do "
        "not say more; the columns *1 ulp* say how much.",
        f"The textbook formulas in float32 miss {_e(IMAGE_LIMIT)} in {len(better)} of the {len(rows)} cases: "
        "near or inside the object, in small units, far from the origin, under bright lights. In the others "
        "they are as exact; with a camera far away that looks at the world's origin, more so.",
        "All of this is the error of the implementation. The order within a tile, the cuts and the low-pass "
        "are errors of the method: the last tables measure them, and they are larger.",
    ]
    return "# What float32 does to hard cases\n\n" + "\n".join(f"- {line}" for line in lines)


def _how() -> str:
    return "## How it is measured\n\n" + prose(
        f"""Each case is a scene of a few dozen surfels with every channel, a light, a camera, and where it
        says so a mesh. It differs in one thing from the plain scene: 40 overlapping discs on a unit sphere,
        24 × 20 pixels, deferred shading with SH colours. The product renders it in float32; the oracle
        (`mi_refgs.reference.picture`) renders the same float32 numbers in float64, with gradients by complex
        steps, in the order of the product's tile lists; these must agree with float64 depths to
        {_e(ORDER_LIMIT)}. The loss is a sum of radiance, alpha, depth and normals with random weights.
        Image error: the largest difference of radiance or alpha over the largest value; *maps*: the same of
        depth, normals and materials. Gradient error: ‖g − g₆₄‖ / ‖g₆₄‖ of a class; a class below
        {_e(NEGLIGIBLE)} of the largest one is compared with that. Pixels in a declared discontinuity (a cut
        within 1e-4 of its threshold) are left out, and {KEPT:.0%} of the others must remain. *ulp*: the
        change of the float64 answer when each input moves by one unit in its last place, up or down at
        random. An error within {ILL:g} times that is the input's own: the row is ill-conditioned, not wrong.
        Textbook: the homogeneous splat matrix with the cross product of two planes [2DGS, eq. 8-10] in pixel
        coordinates, near plane at 0.2, floors of 1e-7, softplus as written, NumPy float32, against float64
        in its own order of centres."""
    )


def _cases(result: dict[str, Any]) -> str:
    head = ["case", "image", "maps", "gradient, largest", "not finite", "textbook image", "image, 1 ulp"]
    head += ["gradient, 1 ulp", "verdict"]
    rows = []
    for row in result["rows"]:
        worst = max((row[f"gradient_{n}"] or 0.0 for n in GRADIENTS), default=0.0)
        textbook = "not finite" if row["textbook"] is None else _e(row["textbook"])
        cells = [row["case"], _e(row["image"]), _e(row["maps"]), _e(worst), row["non_finite"], textbook]
        ulps = [_e(x) if (x := row[key]) else "" for key in ("ulp_image", "ulp_gradient")]  # cheap cases
        rows.append([*cells, *ulps, row["verdict"]])
    return "## Cases\n\n" + table(head, rows)


def _gradients(result: dict[str, Any]) -> str:
    rows = [[row["case"], *(_class(row, name) for name in GRADIENTS)] for row in result["rows"]]
    text = f"†: the exact gradient is below {_e(NEGLIGIBLE)} of the largest class, with which it is compared."
    return f"## Gradients by class\n\n{text}\n\n" + table(["case", *(SHORT[n] for n in GRADIENTS)], rows)


def _class(row: dict[str, Any], name: str) -> str:
    error = row[f"gradient_{name}"]
    return "" if error is None else _e(error) + " †" * (name in row["negligible"].split())


def _response(result: dict[str, Any]) -> str:
    if not result["curve"]:
        return ""
    head = ["sRGB at", "value", "slope", "textbook value", "textbook slope"]
    keys = ("value", "slope", "textbook_value", "textbook_slope")
    curve = [[row["at"], *(_e(row[key]) for key in keys)] for row in result["curve"]]
    losses = [[r["name"], _e(r["value"]), _e(r["slope"]), r["non_finite"]] for r in result["losses"]]
    text = """The sRGB curve and its slope, relative errors; textbook: both branches evaluated and selected.
        The standard's own curve has a kink at the joint: 1.7 % of its slope. Below, loss and gradient
        (0.8 L1 + 0.2 D-SSIM + 0.2 alpha) of extreme pictures; a picture of 8 bits says no more than "at least
        this bright" at 255."""
    second = table(["picture", "loss", "gradient", "not finite"], losses)
    return "\n\n".join(["## Camera response and losses", prose(text), table(head, curve), second])


def _fits(result: dict[str, Any]) -> str:
    if not result["fits"]:
        return ""
    rows = [[r["name"], r["steps"], _e(r["first"]), _e(r["last"]), r["non_finite"]] for r in result["fits"]]
    text = """Training steps of the full method, half of them in each stage, on pictures of 32²."""
    head = ["fit", "steps", "first loss", "last loss", "not finite"]
    return "\n\n".join(["## Fits", prose(text), table(head, rows)])


def _method(result: dict[str, Any]) -> str:
    if not result["rules"]:
        return ""
    text = """All in float64: what one rule does to a picture, beside what it stands for. Bias: mean signed
        difference of radiance over its mean; mean: mean absolute one; largest: over the largest radiance;
        alpha: mean signed difference. The constants are in `mi_refgs/constants.py`. Orders by tile, by
        centre and by pixel are compared with all other rules as they are; the mean of a pixel is taken over
        16 rays, each sorted by itself."""
    rows = [
        [r["scene"], r["rule"], _p(r["bias"]), _p(r["mean"], ""), _p(r["max"], ""), _p(r["alpha"])]
        for r in result["rules"]
    ]
    cut = """The derivative of the cut at α < 1/255 is missing: the rim of a surfel appears at α = 1/255, not
        at 0, and where it lies has no gradient. What is missing of d Σα / d log scale and d Σα / d logit, for
        one surfel:"""
    gradient = [[f"{r['opacity']:g}", _p(r["scale_bias"]), _p(r["opacity_bias"])] for r in result["gradient"]]
    return "\n\n".join(
        [
            "## Error of the method, not of the implementation",
            prose(text),
            table(["scene", "rule", "bias", "mean", "largest", "alpha"], rows),
            prose(cut),
            table(["opacity", "log scale", "logit of opacity"], gradient),
        ]
    )


def _again(result: dict[str, Any]) -> str:
    machine = result["machine"]
    return "## Again\n\n" + prose(
        f"""`python -m benchmarks.stability` writes this page, and `stability.csv` and `stability.json` to
        `runs/`; this run took {result["seconds"] / 60:.1f} minutes on {machine["threads"]} threads of
        {machine["cpu"]} (Mitsuba {machine["mitsuba"]}, Dr.Jit {machine["drjit"]}, `{machine["variant"]}`).
        `--quick` leaves out the large cases, the fits and the method's own error; `--only WORD` runs the
        cases whose name holds the word. `tests/hard_cases` runs the cheap cases with the same limits."""
    )


def _e(value: float | None) -> str:
    if value is None or value == float("inf"):
        return "not finite"
    return "0" if value == 0 else f"{value:.1e}"


def _p(value: float, sign: str = "+") -> str:
    return "0" if abs(value) < 1e-9 else f"{100 * value:{sign}.2g} %"
