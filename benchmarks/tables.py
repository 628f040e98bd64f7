"""Tables and numbers of the pages, by data file and name: `values` of benchmarks/results/NAME.json."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.common.errors import CLEAR
from benchmarks.common.report import Row, number, percent, row_table, table, where
from benchmarks.fits import GROUPS, SOURCES
from mi_refgs.compare.table import Statistic
from mi_refgs.errors import InputError
from mi_refgs.evaluation.scores import PIXEL_CLASSES

Result = dict[str, Any]
Values = dict[str, Any]


def values(name: str, result: Result) -> Values:
    """Return the tables and numbers of a data file by name; raises InputError for rows of several builds."""
    if name in GROUPS:
        return fits(name, result)
    return PAGES[name](result)


# ---------- Fits ----------

FORMS = {
    "normal_mae_deg": "{:.1f}°",
    "normal_mae_deg_concave": "{:.0f}°",
    "env_correlation": "{:.2f}",
    "surface_distance": "{:.2f} %",
    "roughness_mae": "{:.2f}",
    "metallic_mae": "{:.2f}",
    "train_minutes": "{:.1f} minutes",
    "surfels": "{:,.0f}",
}
"""How a number of a row is written; others are dB."""
NUMBERS = ("psnr", "psnr_region", "albedo_psnr", "relit_least", "relit_most", *FORMS)
Column = tuple[str, str, dict[str, Any]]  # title; key; the rows of which it is, by their values


def _columns(*names: str, **only: Any) -> list[Column]:
    return [(title, key, only) for title, _, key in (name.partition("=") for name in names)]


def _about(row: Row) -> str:
    return f"`{row['source']}`: {SOURCES[row['source']].about}"


def _fit(row: Row) -> str:
    return f"{_about(row)}, `{row['method']}`, `{row['preset']}`, threads: {row['threads']}"


SHAPE = ("normals=normal_mae_deg", "light, correlation=env_correlation", "surface distance=surface_distance")
MATERIALS = ("albedo=albedo_psnr", "metallic error=metallic_mae", "roughness error=roughness_mae")
TIME = ("surfels=surfels", "training=train_minutes")
TRIALS = ("SH alone=colour_alone", "twice the surfels=surfels_2x", "four times=surfels_4x")


def _rooms(rows: list[Row]) -> list[Column]:
    psnr = "psnr" if rows[0].get("psnr_aligned") is None else "psnr_aligned"  # measured since, of photographs
    return _columns(f"PSNR={psnr}", f"region={psnr}_region", *SHAPE[:2], *MATERIALS, TIME[1])


TABLES: dict[str, tuple[Callable[[Row], str], Callable[[list[Row]], list[Column]]]] = {
    "images": (
        _about,
        lambda rows: [
            *_columns("PSNR=psnr", *SHAPE, method="auto"),
            *_columns("2DGS, PSNR=psnr", "2DGS, normals=normal_mae_deg", method="base_2dgs"),
            *_columns(*TRIALS, *TIME, method="auto"),
        ],
    ),
    "relighting": (
        _about,
        lambda rows: _columns(
            *("PSNR=psnr", *SHAPE, "normals, concave=normal_mae_deg_concave", *MATERIALS),
            *(f"relit: {name}=relit_{name}" for name in rows[0]["relit"]),
        ),
    ),
    "methods": (
        lambda row: f"`{row['method']}`",
        lambda rows: [
            column
            for name in dict.fromkeys(row["source"] for row in rows)
            for column in _columns(f"`{name}`=psnr", SHAPE[0], source=name)
        ],
    ),
    "photographs": (_fit, _rooms),
    "photographs_relighting": (_fit, _rooms),
}
"""Group → title of a row (those of one title share a line), and columns."""


def fits(group: str, result: Result) -> Values:
    """Return the table of a group, and its numbers as SOURCE_METHOD_KEY, of the first row of both.

    budget_CLASS_KEY are the shares of the error budget of the first row."""
    if {row["build"] for row in result["rows"]} != {result["build"]["commit"]}:
        raise InputError(f"{group}.json: build: rows are of several builds; measure the group again")
    rows = [_flat(row) for row in result["rows"]]
    title, columns = TABLES[group]
    lines: dict[str, list[Row]] = {}
    for row in rows:
        lines.setdefault(title(row), []).append(row)
    chosen = columns(rows)
    body = [[name, *(_cell(where(of, **only), key) for _, key, only in chosen)] for name, of in lines.items()]
    found = {"table": table(["", *(head for head, _, _ in chosen)], body)}
    for row in reversed(rows):
        found |= {f"{row['source']}_{row['method']}_{key}": _cell([row], key) for key in NUMBERS}
    if budget := rows[0].get("error_budget"):
        found["budget"] = _error_budget(budget)
        for name, of in budget.items():
            found |= {f"budget_{name}_{key}": _share(of[key]) for key in ("pixels", "squared_error")}
    return found


def _flat(row: Row) -> Row:
    """Return the row with its minutes, relit scores and trials as entries."""
    found = row | {"train_minutes": row["train_seconds"] / 60}
    if relit := row.get("relit"):
        found |= {f"relit_{name}": score for name, score in relit.items()}
        scores = [score for score in relit.values() if score is not None]
        found |= {"relit_least": min(scores, default=None), "relit_most": max(scores, default=None)}
    for trial in (trial for trial in row["decisions"] if trial["psnr_with"] is not None):
        gain = trial["psnr_with"] - trial["psnr_without"]
        found[trial["component"]] = f"{gain:+.1f} dB: {'chosen' if trial['stays'] else 'left out'}"
    return found


def _cell(rows: list[Row], key: str) -> str:
    """Return a number with its unit, over seeds as mean ± standard deviation; empty where there is none."""
    found = [row[key] for row in rows if row.get(key) is not None]
    if not found or isinstance(found[0], str):
        return found[0] if found else ""
    statistic, form = Statistic.of(found), FORMS.get(key, "{:.1f} dB")
    spread = "" if statistic.sd is None else f" ± {form.format(statistic.sd)}"
    return form.format(statistic.mean) + spread


def _share(x: float) -> str:
    return f"{100 * x:.1f} %"


def _error_budget(budget: dict[str, Any]) -> str:
    lines = []
    for name, found in budget.items():
        shares = _share(found["pixels"]), _share(found["squared_error"])
        lines.append([PIXEL_CLASSES[name], *shares, _cell([found], "normal_mae_deg")])
    return table(["class", "pixels", "squared error", "normal error"], lines)


# ---------- Splatter ----------


def splatting(result: Result) -> Values:
    """Times beside volprim and the machine's limit, errors, and the training step."""
    rows, wrong = result["rows"], result["errors"]
    compared = [row for row in rows if row["volprim_both_ms"]]
    ratios = [row["volprim_both_ms"] / row["both_ms"] for row in compared]
    (typical,) = where(rows, surfels=50_000, size=512, spread=1.5) or rows[-1:]
    case = {"surfels, image": "{surfels:,}, {size}², k = {spread:g}"}
    cost, gradients = result["cost"], [key for key in wrong[0] if key.startswith("gradient_")]
    terms = {"contributing": "contributing pair", "pairs": "listed pair", "surfels": "surfel"}
    formula = "" if cost is None else f"{number(cost['constant'])} ms" + "".join(
        f" + {number(1e6 * cost[key])} ns per {text}" for key, text in terms.items()
    )  # fmt: skip
    return {
        "times": row_table(
            where(rows, size=(256, 512), spread=1.5) or rows,
            {
                **case,
                "forward, ms": "{forward_ms:n}",
                "f. + backward, ms": "{both_ms:n}",
                "colour, f. + b., ms": "{colour_both_ms:n}",
                "volprim, f. + b., ms": "{volprim_both_ms:n}",
                "contributing pairs": "{contributing:,}",
                "share of evaluated": lambda row: percent(row["share"]),
                "time / lower bound": lambda row: number(row["both_ms"] / row["bound_both_ms"]),
            },
        ),
        "errors": row_table(
            wrong,
            {
                **case,
                "order": "{order:.0e}",
                "image": "{image:.1e}",
                "depth, normals": "{maps:.1e}",
                **{f"∂ {key.removeprefix('gradient_')}": f"{{{key}:.1e}}" for key in gradients},
            },
        ),
        "steps": _steps(result["step"]),
        "typical_ms": number(typical["both_ms"]),
        "typical_volprim_s": number((typical["volprim_both_ms"] or 0) / 1e3),
        "cost": formula,
        "cost_worst": "" if cost is None else f"{100 * cost['worst']:.0f} %",
        "least_ratio": number(min(ratios), 2),
        "median_ratio": number(float(np.median(ratios)), 2),
        "most_ratio": number(max(ratios), 2),
        "image_error": f"{max(row['image'] for row in wrong):.0e}",
        "gradient_error": f"{max(row[key] for row in wrong for key in gradients):.0e}",
        "gflops": number(result["gflops"]),
        "large_seconds": number(result["large_step"]["ms"] / 1e3),
        "large_gib": f"{result['large_step']['whole_process'] / 2**30:.2f}",
    }


def _steps(stages: dict[str, Any]) -> str:
    """Return a training step by phase, a column per stage of the schedule."""
    whole = {"**step**": "step_ms", "splat alone": "splat_ms", "launches": "launches"}
    columns = [s["phases_ms"] | {text: s[key] for text, key in whole.items()} for s in stages.values()]
    names = list(dict.fromkeys(name for column in columns for name in column))
    return table(["", *stages], [[name, *(number(column.get(name)) for column in columns)] for name in names])


# ---------- Split sum ----------


def splitsum(result: Result) -> Values:
    """Errors by light and roughness, speed-ups at equal error, and budgets of the sphere."""
    rows, roughness = result["rows"], result["settings"]["roughness"]
    lights = sorted(result["frequencies"], key=result["frequencies"].get)
    finest = max(result["settings"]["heights"])
    split = where(rows, method="split_sum", setting=finest)
    varying = [light for light in lights if result["frequencies"][light] > 0]
    ratios = [row["speed_up"] for row in where(result["speed_ups"], light=varying)]
    scores = np.array([row["score"] for row in result["scores"]])
    slopes = [row["path_exponent"] for row in result["speed_ups"] if row["path_exponent"] is not None]
    head = [*(f"r = {r:g}" for r in roughness)]
    views = sorted({row["n_dot_v"] for row in split} - {"all"}, key=lambda name: float(name.split("-")[0]))
    smooth = "studio" if "studio" in lights else varying[0]

    def worst(**case: Any) -> list[str]:
        found = [where(split, roughness=r, **case) for r in roughness]
        return [_relative(max(of, key=lambda row: float(row["relmse"]))) for of in found]

    def least(light: str) -> list[str]:
        found = [where(result["speed_ups"], light=light, roughness=r) for r in roughness]
        return [_ratio(min(of, key=lambda row: float(row["speed_up"]))) for of in found]

    return {
        "trust": table(["light", *head], [[f"`{x}`", *worst(light=x, n_dot_v="all")] for x in lights]),
        "grazing": table(["n·v", *head], [[v, *worst(light=smooth, n_dot_v=v)] for v in views]),
        "speed": table(["light", *head], [[f"`{x}`", *least(x)] for x in lights]),
        "dominant": _dominant(rows, finest, roughness),
        "budget": _budget(result, lights),
        "median_speed": number(float(np.median(ratios)), 2),
        "low_speed": number(float(np.quantile(ratios, 0.1)), 2),
        "score_spread": f"{scores.std():.2f}",
        "score_cases": len(scores),
        "path_power": f"{np.median(slopes):.2f}",
    }


def _relative(row: Row) -> str:
    """Return √relMSE as a percentage, or "< floor" where noise may be all of it."""
    if row["relmse"] < CLEAR * row["relmse_floor"]:
        return f"< {percent((CLEAR * row['relmse_floor']) ** 0.5)}"
    return percent(row["relmse"] ** 0.5)


def _ratio(row: Row) -> str:
    """Return a speed-up; ">" where the split sum's error is below the reference's noise."""
    return (">" if row["lower_bound"] else "") + number(row["speed_up"], 2)


def _dominant(rows: list[Row], finest: int, roughness: list[float]) -> str:
    """Return the factor by which the dominant direction changes relMSE, by roughness."""
    keys, lines = ("shape", "light", "roughness", "metallic"), []
    plain, turned = (
        {tuple(row[k] for k in keys): row for row in where(rows, method=m, setting=finest, n_dot_v="all")}
        for m in ("split_sum", "split_sum_dominant")
    )
    for r in roughness:
        found = [
            row["relmse"] / plain[key]["relmse"]
            for key, row in turned.items()
            if row["roughness"] == r and not row["below_floor"] and not plain[key]["below_floor"]
        ]
        if found:
            lower = f"{sum(x < 1 for x in found)} of {len(found)}"
            lines.append([f"{r:g}", f"{np.median(found):.2f}", lower])
    return table(["roughness", "relMSE times, median", "lower in"], lines)


def _budget(result: Result, lights: list[str]) -> str:
    """Return the parts of the error on a metallic sphere, at a low, a middling and a high roughness."""
    budgets = where(result["budgets"], shape=result["settings"]["budget_shapes"][0])
    metallic = max(row["metallic"] for row in budgets)
    measured = np.array(result["settings"]["roughness"])
    shown = [float(measured[np.abs(measured - x).argmin()]) for x in (0.1, 0.3, 0.8)]
    lines, names = [], [part["name"] for part in budgets[0]["parts"]]
    for light in lights:
        for row in where(budgets, light=light, metallic=metallic, roughness=shown):
            if row["total"] >= row["floor"]:
                parts = [str(round(100 * part["share"])) for part in row["parts"]]
                lines.append([f"`{light}`, r = {row['roughness']:g}", *parts, number(row["total"], 2)])
    return table(["case, parts in percent", *names, "relMSE"], lines)


# ---------- Visibility ----------


def visibility(result: Result) -> Values:
    """What the options gain in each case, within three times the time of the mirror ray."""
    found = result["tradeoffs"]
    gains = [row["gain"] for row in found]
    low, high = (pick(found, key=lambda row: float(row["gain"])) for pick in (min, max))
    least, most = (
        f"{number(row['gain'], 2)}× ({row['scene']}, roughness {row['roughness']:g})" for row in (low, high)
    )
    mirror, none = (where(result["rows"], method=m) for m in ("mirror ray", "no occlusion"))
    return {
        "gains": row_table(
            found,
            {
                "case": "{scene}, roughness {roughness:g}",
                "setting": "{method}",
                "mirror ray alone": "{mirror_relmse:n}",
                "with SH": "{paper_relmse:n}",
                "with the setting": "{relmse:n}",
                "gain": "{gain:n}×",
                "in hindsight": "{best_gain:n}×",
                "price": "{price:n2}×",
            },
        ),
        "smaller": f"{sum(gain > 1 for gain in gains)} of {len(gains)}",
        "median": f"{number(float(np.median(gains)), 2)}×",
        "least": least,
        "most": most,
        "worse_than_none": sum(a["relmse"] > b["relmse"] for a, b in zip(mirror, none, strict=True)),
        "cases": len(mirror),
    }


# ---------- Stability ----------


def stability(result: Result) -> Values:
    """How many hard cases hold, and the error of the method's rules."""
    rows, rules = result["rows"], result["rules"]
    ill = [row for row in rows if row["verdict"].startswith("ill")]
    scenes = list(dict.fromkeys(row["scene"] for row in rules))
    named = {name: where(rules, rule=name) for name in dict.fromkeys(row["rule"] for row in rules)}
    failed = [row for row in rows if "FAILS" in row["verdict"]]
    return {
        "count": len(rows),
        "hold": sum(row["verdict"] == "within limits" for row in rows),
        "ill": len(ill),
        "failed": len(failed),
        "non_finite": sum(row["non_finite"] for row in [*rows, *result["losses"]]),
        "ill_cases": row_table(
            ill,
            {
                "case": "{case}",
                "image": "{image:.1e}",
                "image, 1 ulp": "{ulp_image:.1e}",
                "gradient": lambda row: f"{worst_gradient(row):.1e}",
                "gradient, 1 ulp": "{ulp_gradient:.1e}",
            },
        ),
        "rules": table(
            ["rule", *scenes],
            [
                [rule, *(f"{_percent(row['mean'])} ({_percent(row['bias'], '+')})" for row in of)]
                for rule, of in named.items()
            ],
        ),
        "cut": table(
            ["opacity", "log scale", "logit of opacity"],
            [
                [f"{row['opacity']:g}", *(_percent(row[f"{k}_bias"], "+") for k in ("scale", "opacity"))]
                for row in result["gradient"]
            ],
        ),
        "curve_worst": f"{max(row[k] for row in result['curve'] for k in ('value', 'slope')):.0e}",
        "losses_worst": f"{max(row[k] for row in result['losses'] for k in ('value', 'slope')):.0e}",
    }


def endtoend(result: Result) -> Values:
    """Time and errors of frames and gradients, by scene and renderer, with the fewest and most surfels."""
    least, *_, most = result["settings"]["surfels"] * 2

    def name(row: Row) -> str:
        tracer = "`path`, `prb`" if row["renderer"] == "path" else f"`refgs`, {row['surfels']:,} surfels"
        return f"{tracer}, {row['spp']} spp"

    columns: dict[str, str | Callable[[Row], Any]] = {
        "scene": "{scene}",
        "renderer": name,
        "frame, ms": "{ms:n2}",
        "error": lambda row: percent(row["error"]),
        "of shading": lambda row: percent(row["shading"]) if "shading" in row else "",
        "of geometry and sampling": lambda row: percent(row["geometry"]) if "geometry" in row else "",
        "gradient, ms": "{gradient_ms:n2}",
        "error by light": lambda row: percent(row["gradient_error"]),
        "by material": lambda row: percent(row["material_gradient_error"]),
    }
    return {"frames": row_table(where(result["rows"], surfels=(0, least, most)), columns)}


def worst_gradient(row: Row) -> float:
    """Return the largest gradient error of the parameter classes of a case."""
    return max((x for key, x in row.items() if key.startswith("gradient_") and x is not None), default=0.0)


def _percent(value: float, sign: str = "") -> str:
    return "0" if abs(value) < 1e-9 else f"{100 * value:{sign}.2g} %"


def corpus(result: Result) -> Values:
    """Return the table of what became of files, those of one outcome in a row."""
    outcomes: dict[tuple[str, str], list[str]] = {}
    for row in result["rows"]:
        outcomes.setdefault((row["result"], row["said"].split(";")[0]), []).append(row["file"])
    cells = [[", ".join(files), *outcome] for outcome, files in outcomes.items()]
    return {"table": table(["files", "result", "what is said first"], cells)}


def frames(result: Result) -> Values:
    """Return the time of an image of each size."""
    return {f"frames_{i}_frame_ms": number(row["frame_ms"]) for i, row in enumerate(result["frames"])}


def oracle(result: Result) -> Values:
    """PSNR with parts of fits that are true, and root mean square errors of normals after blurring."""
    most, rows = max(row["samples"] for row in result["rows"]), result["rows"]
    cases = dict.fromkeys(row["case"] for row in rows)
    scenes = dict.fromkeys(row["scene"] for row in rows)

    def line(case: str) -> list[str]:
        found = (where(rows, case=case, scene=scene, samples=most) for scene in scenes)
        return [case, *(f"{row['psnr']:.1f} dB" for of in found for row in of)]

    def angles(spectrum: dict[str, float]) -> str:
        return ", ".join(f"{angle:.1f}°" for angle in spectrum.values())

    spectra = {f"{scene}_spectrum": angles(spectrum) for scene, spectrum in result["spectra"].items()}
    return spectra | {"table": table(["", *(f"`{scene}`" for scene in scenes)], map(line, cases))}


PAGES: dict[str, Callable[[Result], Values]] = {
    "splatting": splatting,
    "splitsum": splitsum,
    "visibility": visibility,
    "stability": stability,
    "endtoend": endtoend,
    "corpus": corpus,
    "oracle": oracle,
    "frames": frames,
}
"""By benchmark."""
