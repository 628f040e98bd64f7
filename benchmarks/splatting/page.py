"""The page in words: what the numbers of a run say, written by the program."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from benchmarks.common.report import number, prose, table
from benchmarks.splatting import page_tables as tables
from benchmarks.splatting.limits import FLOPS, LISTED_BYTES
from benchmarks.splatting.targets import WHAT, verdicts
from benchmarks.splatting.workload import CHANNELS, COLOUR, FEATURES


def page(result: dict[str, Any], pictures: list[Path], folder: Path) -> str:
    """Markdown; pictures are linked relative to `folder`."""
    links = [os.path.relpath(picture, folder).replace(os.sep, "/") for picture in pictures]
    parts = [
        _opening(result, links[0]),
        _how(result),
        "## Times\n\n" + _times_text() + "\n\n" + tables.times(result),
        "## Stages\n\n" + _stages_text() + f"\n\n![Stages]({links[1]})\n\n" + tables.stages(result),
        "## Work\n\n" + _work_text(result) + "\n\n" + tables.work(result),
        _fits(result),
        "## Errors\n\n" + _errors_text() + "\n\n" + tables.errors(result),
        _memory(result),
        _step(result),
        _again(result),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _opening(result: dict[str, Any], link: str) -> str:
    said = verdicts(result)
    met = sum(1 for *_, good in said if good)
    rows = [[what, asked, found, "yes" if good else "no"] for what, asked, found, good in said]
    return "\n\n".join(
        [
            "# How fast the splatter is",
            prose(
                """*Written by `python -m benchmarks.splatting`; every number on this page is from one run,
                but for those of the C++ rasteriser and of the starting point, which are older.*"""
            ),
            prose(
                f"""Forward and backward of the full G-buffer, against Mitsuba's own renderer of volumetric
                primitives, a plain NumPy rasteriser, the limits of the machine and a float64 oracle. Of the
                {len(said)} things that are asked of it, {met} hold in this run:"""
            ),
            table(["what", "asked", "found", "holds"], rows),
            f"![Time over contributing pairs]({link})",
            prose(
                """Each mark is one case. Nothing can be below the solid line: contributing pairs times their
                arithmetic, at the machine's peak. The dotted line is the straight fit below."""
            ),
        ]
    )


def _how(result: dict[str, Any]) -> str:
    settings, machine, peaks = result["settings"], result["machine"], result["peaks"]
    channels = ", ".join(f"{name} {width}" for name, width in CHANNELS.items())
    scenes = ", ".join(f"`{Path(name).name}`" for name in settings["scenes"])
    fitted = f"TrainedScene scenes: {scenes}, their own surfels in their first test view." if scenes else ""
    items = [
        f"""**Surfels** N random ones on the unit sphere, touching it, standard deviation k · √(4π/N), opacity
        0.8, random features; camera at distance 4, field of view 40°, one sample a pixel. {fitted}""",
        f"""**Channels** the full G-buffer has 16: {FEATURES} features ({channels}), depth and alpha. `colour`
        carries {COLOUR} features, depth and alpha: what the other renderers blend.""",
        """**Ours** `mi_refgs.splat.splat`: forward writes every map; forward + backward takes adjoints of
        all maps and returns the gradients of position, rotation, scale, opacity and features. Nothing is kept
        between calls.""",
        """**volprim** Mitsuba's `volprim_rf_basic` on the same primitives as flat `ellipsoids`, three
        channels, gradients of `data`, `opacities` and `sh_coeffs`. It ends a pixel at 1 % of transmittance
        or after 64 primitives, ours at 0.01 %. The rebuild of its acceleration structure is not in its
        times.""",
        """**NumPy** the same maths in float32, a tile at a time; forward only.""",
        """**C++** a hand-written AVX-512 rasteriser with tiles of 16² pixels, measured once on two threads of
        another CPU of this class; one colour a surfel.""",
        f"""**Times** medians of warm calls, all renderers of a case in turns; {machine["threads"]} threads of
        {machine["cpu"]}, Mitsuba {machine["mitsuba"]}, Dr.Jit {machine["drjit"]}, `{machine["variant"]}`.""",
        f"""**Limits** measured here: {number(peaks["gflops"])} GFLOP/s of multiply-adds and
        {number(peaks["gbytes"])} GB/s of triad bandwidth on all threads. The bound of a case is its
        contributing pairs times {FLOPS["forward"]} flops forward, {FLOPS["both"]} forward and backward, at
        that rate.""",
    ]
    return "\n".join(["## What is measured", "", *(f"- {prose(item)}" for item in items)])


def _times_text() -> str:
    return prose(
        """Milliseconds. `× bound`: forward + backward over its lower bound. `start`: the same call before the
        kernels were rewritten, where it was measured."""
    )


def _stages_text() -> str:
    return prose(
        """Milliseconds between barriers, which keep kernels from fusing: their sum is more than the times
        above. `scatter` is part of `adjoint`: what it costs to add up the adjoints of rows, found by leaving
        it out."""
    )


def _work_text(result: dict[str, Any]) -> str:
    return prose(
        f"""A *listed* pair is a surfel and a tile, whose size follows the focal length
        (4² pixels up to 256², 8 × 4 at 512², 8² at 1024²); it is *evaluated* at
        all of them, unless all pixels of the tile have ended before; it *contributes* to a pixel where its
        opacity is at least 1/255 and the pixel has not ended. Bytes are a model of what must be loaded and
        stored, most of it from and to caches: {LISTED_BYTES} for a listed pair, an index and a row for each
        visited one (three more rows in the adjoint), the maps. Compiled in a warm call:
        {sum(row["misses_forward"] + row["misses_both"] for row in result["rows"])} kernels in all cases."""
    )


def _fits(result: dict[str, Any]) -> str:
    lines = [(WHAT[name], fit) for name, fit in result["fits"].items()]
    lines += [(f"{name} surfels", fit) for name, fit in result["fits_by_surfels"].items()]
    rows = [
        [
            label,
            f"{number(fit['a'])} ms",
            f"{number(1e6 * fit['b'])} ns",
            f"{fit['r2']:.3f}",
            f"{fit['decades']:.1f}",
            fit["points"],
        ]
        for label, fit in lines
    ]
    text = """time = a + b · contributing pairs, least squares over all spheres of every k; below, forward +
        backward of each number of surfels by itself, over the sizes of the image."""
    head = ["", "a", "b", "R²", "decades", "cases"]
    parts = ["## Linear in contributing pairs", prose(text), table(head, rows)]
    cost = result["cost"]
    if cost:
        parts.append(
            prose(
                f"""With the other two things that cost time: forward + backward = {number(cost["constant"])}
                ms + {number(1e6 * cost["contributing"])} ns a contributing pair +
                {number(1e6 * cost["pairs"])} ns a listed pair + {number(1e6 * cost["surfels"])} ns a surfel
                (least squares of relative residuals, R² = {cost["r2"]:.3f}, worst residual
                {100 * cost["worst"]:.0f} %)."""
            )
        )
    return "\n\n".join(parts)


def _errors_text() -> str:
    return prose(
        """Against the float64 oracle on a part of the view. The oracle sorts, cuts and filters by the same
        rules: this is the precision of the implementation. What the rules themselves change is in
        [stability.md](stability.md). *Order*: the largest relative difference of two
        depths that stand in the wrong order; the oracle then blends in our order, as float32 cannot tell such
        surfels apart. Image errors are absolute, of features and alpha between 0 and 1; gradient errors are
        relative, ‖g − g₆₄‖ / ‖g₆₄‖, for random adjoints of all maps. Pixels in the oracle's declared band, at
        a cut, are left out."""
    )


def _memory(result: dict[str, Any]) -> str:
    lines = ["## Memory and compilation"]
    fit = result["memory_fit"]
    if fit:
        lines.append(
            prose(
                f"""Forward and backward, in a process of their own: what the process grew by at most, and
                what Dr.Jit's allocator held at most. Peak memory = {number(fit["constant"] / 2**20)} MiB +
                {number(fit["surfels"])} B a surfel + {number(fit["pairs"])} B a listed pair +
                {number(fit["pixels"])} B a pixel (least squares of relative residuals, R² = {fit["r2"]:.3f},
                worst residual {100 * fit["worst"]:.0f} %: Dr.Jit rounds each array up to a power of two)."""
            )
        )
        lines.append(tables.memory(result))
    step = result["large_step"]
    if step:
        lines.append(
            prose(
                f"""A whole training step of the full method, deferred stage, with {step["surfels"]:,} surfels
                at {step["size"]}²: {number(step["ms"] / 1e3)} s, and the whole process took
                {step["whole_process"] / 2**30:.2f} GiB at most."""
            )
        )
    for row in result["compile"]:
        cold, cached, warm = row["cold"], row["cached"], row["warm"]
        lines.append(
            prose(
                f"""The first calls at {row["surfels"]:,} surfels and {row["size"]}² (forward / forward +
                backward): {cold["forward"]:.0f} / {cold["both"]:.0f} ms with an empty kernel cache,
                {cached["forward"]:.0f} / {cached["both"]:.0f} ms with a filled one,
                {warm["forward"]:.0f} / {warm["both"]:.0f} ms the second time."""
            )
        )
    return "\n\n".join(lines) if len(lines) > 1 else ""


def _step(result: dict[str, Any]) -> str:
    step = result["step"]
    text = f"""The full method at {step["surfels"]:,} surfels and {step["size"]}²
        (`python benchmarks/step.py`), milliseconds; stages between
        barriers. `start` is the starting point: 20,000 surfels, 200², the same machine.
        `other backward` is the sum of the other rows of the backward pass. `splat alone` is a call of `splat`
        with what the step gives it, lists and gradients included, and nothing around it."""
    return "\n\n".join(["## The training step around it", prose(text), tables.step(result)])


def _again(result: dict[str, Any]) -> str:
    text = f"""`python -m benchmarks.splatting` writes this page and its plots, and `splatting.csv` and
        `splatting.json` with all rows behind them to `runs/`; this run took {result["seconds"] / 60:.1f}
        minutes. `--scene RUN` (repeatable) adds the surfels of a run folder of yours, `--small` is a coarse
        instance for a quick look, `--full` measures the slow renderers in more cases and everything more
        often. `refgs profile RUN` says where the time of your own training step goes."""
    return "## Again\n\n" + prose(text)
