"""Everything that a machine with a GPU is asked, in order of worth: python -m benchmarks.gpu OUT [STEP ...]

Each step is a process of its own with a time limit, and yields rows; OUT/gpu.json is rewritten with each row,
and has the error of a step that fails. `gpu.sh` sets up a bare machine. `--small`: a minute on a CPU."""

from __future__ import annotations

import faulthandler
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import mi_refgs  # noqa: F401  (chooses the LLVM before Dr.Jit loads)

import drjit as dr  # isort: skip
import mitsuba as mi
import numpy as np

from benchmarks import frames
from benchmarks.common.build import recorded, write_result
from benchmarks.common.report import Row, plain_parser
from benchmarks.common.timing import milliseconds
from benchmarks.common.view import ROOT
from benchmarks.fits import refgs
from benchmarks.splatting.__main__ import case, compare, step_times
from benchmarks.splatting.cases import COLOUR, PAGE, Grid, Workload, sphere
from benchmarks.splatting.renderers import FLATNESS, Ours, Volprim
from benchmarks.stability.cases import catalogue
from benchmarks.stability.measure import measure as measure_case
from mi_refgs.cli.doctor import examine

SPREAD = 0.75
CELLS: Grid = tuple((n, size) for size in (512, 1024, 256) for n in (1_000, 10_000, 50_000, 200_000))
STEPS_OF_FIT: Grid = ((20_000, 200), (100_000, 400), (500_000, 800), (20_000, 800), (500_000, 400))
SECONDS = 0.4  # of each time
CHANNELS = 16  # of the G-buffer, depth and alpha included
WORK = Path(tempfile.gettempdir(), "refgs_gpu")  # data set and runs


def values(small: bool) -> Iterator[Row]:
    """The installation; images and gradients of the splatter and of whole images against float64."""
    yield {"doctor": examine()}
    for count, size in ((2_000, 64),) if small else ((10_000, 256), (50_000, 512)):
        yield {"surfels": count, "size": size} | compare(sphere(count, size, SPREAD), 16 if small else 32)
    names = (
        ("plain", "two plates") if small else ("plain", "two plates", "roughness 0", "normals that cancel")
    )
    for chosen in (x for x in catalogue() if x.name in names):
        yield measure_case(chosen, floors=False).record()


def splat(small: bool) -> Iterator[Row]:
    """Wall times of ours, and what of them is kernels."""
    settings = replace(PAGE, seconds=4 * SECONDS, volprim=())
    for count, size in ((500, 32),) if small else CELLS:
        workload = sphere(count, size, SPREAD)
        row = case(workload, settings, 1.0)
        full = Ours.of(workload, CHANNELS - 2)
        row |= {f"kernels_{kind}": kernels(getattr(full, kind)) for kind in ("forward", "both")}
        row["mean_alpha"] = float(np.mean(full.forward()[-1].numpy()))
        yield {key: value for key, value in row.items() if "bound" not in key and value is not None}


def kernels(call: Callable[[], Any]) -> Row:
    """Milliseconds in kernels of a call, and the slowest."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        dr.eval(call())
        dr.sync_thread()
        found = sorted((x["execution_time"], x["type"].name, x["size"]) for x in dr.kernel_history())
    return {"ms": sum(x[0] for x in found), "count": len(found), "slowest": found[:-6:-1]}


def volprim(small: bool) -> Iterator[Row]:
    """Mitsuba's volumetric primitives, three colours, on the same surfels."""
    for count, size in ((200, 32),) if small else ((1_000, 256), (50_000, 512), (200_000, 1024)):
        found = Volprim(sphere(count, size, SPREAD))
        calls = {"forward_ms": found.forward, "both_ms": found.both}
        yield {"surfels": count, "size": size} | milliseconds(calls, SECONDS, 1 if small else 9)


def gsplat(small: bool) -> Iterator[Row]:
    """gsplat's 2D and 3D Gaussians on the same surfels, three colours and as many channels as ours."""
    ready = Path(os.environ.get("GSPLAT_READY", ""))
    while not small and not ready.is_file():
        time.sleep(0.5)
    for count, size in () if small else CELLS:
        yield {"surfels": count, "size": size} | _gsplat(sphere(count, size, SPREAD))


def _gsplat(workload: Workload) -> Row:
    import torch
    from gsplat import rasterization, rasterization_2dgs

    def tensor(array: np.ndarray) -> Any:
        return torch.tensor(np.asarray(array, np.float32), device="cuda", requires_grad=True)

    p, raw = workload.pinhole, workload.raw
    x, y, z, w = raw["rotation"].T
    scale = np.exp(raw["scale"])
    scale = np.column_stack([scale, FLATNESS * scale.min(axis=1)])
    opacity = 1 / (1 + np.exp(-raw["opacity"][:, 0]))
    leaves = [tensor(a) for a in (raw["position"], np.column_stack([w, x, y, z]), scale, opacity)]
    view = tensor(np.diag([-1, -1, 1, 1]) @ np.linalg.inv(p.to_world)).detach()[None]  # x right, y down
    lens = tensor(np.array([[abs(p.fx), 0, p.cx], [0, abs(p.fy), p.cy], [0, 0, 1]])).detach()[None]
    calls: dict[str, Callable[[], Any]] = {}
    row: Row = {}
    for channels in (COLOUR, CHANNELS):
        colours = tensor(np.random.default_rng(0).uniform(size=(workload.count, channels)))
        adjoint = tensor(np.random.default_rng(1).normal(size=(1, p.height, p.width, channels))).detach()
        for name, function in (("2d", rasterization_2dgs), ("3d", rasterization)):

            def draw(function: Any = function, colours: Any = colours) -> Any:
                return function(*leaves, colours[None], view, lens, p.width, p.height, packed=False)

            def forward(draw: Any = draw) -> None:
                with torch.no_grad():
                    draw()
                torch.cuda.synchronize()

            def both(draw: Any = draw, colours: Any = colours, adjoint: Any = adjoint) -> None:
                image, alpha = draw()[:2]
                torch.autograd.grad((image * adjoint).sum() + alpha.sum(), [*leaves, colours])
                torch.cuda.synchronize()

            calls |= {f"{name}_{channels}_forward_ms": forward, f"{name}_{channels}_both_ms": both}
            row[f"{name}_mean_alpha"] = float(draw()[1].detach().mean())
    return row | milliseconds(calls, SECONDS)


def step(small: bool) -> Iterator[Row]:
    """A step of a fit, per stage: wall time, launches, milliseconds of phases between barriers."""
    for count, size in ((300, 32),) if small else STEPS_OF_FIT:
        begin = time.perf_counter()
        found = step_times(count, size, 3 if small else 15)
        yield {"surfels": count, "size": size, "seconds": time.perf_counter() - begin} | found


def fit(small: bool) -> Iterator[Row]:
    """Time to a PSNR: mirror_ring, traced here."""
    variant = ("--mitsuba-variant", str(mi.variant()))
    shutil.rmtree(WORK, ignore_errors=True)
    data, begin = WORK / "data", time.perf_counter()
    views, test_views, size, samples = (4, 1, 24, 2) if small else (100, 20, 200, 128)
    numbers = ["--views", views, "--test-views", test_views, "--size", size, "--samples", samples]
    scene = ROOT / "scenes/mirror_ring.xml"
    refgs("dataset", scene, "-o", data, *numbers, *variant)
    yield {"dataset_seconds": time.perf_counter() - begin}
    for preset in ("8:200",) if small else ("quick", "standard"):
        run = WORK / preset.replace(":", "_")
        trained = refgs("train", data, "-o", run, "--preset", preset, *variant)
        scores = refgs("eval", run, *variant)
        keys = ("psnr", "normal_mae_deg", "surfels", "train_seconds")
        yield {"preset": preset, "total_seconds": trained["total_seconds"]} | {k: scores[k] for k in keys}


def frame(small: bool) -> Iterator[Row]:
    """Times of images of the last finished run, without derivatives."""
    runs = [WORK / name for name in ("8_200", "quick", "standard")]
    run = [run for run in runs if (run / "metrics.json").is_file()][-1]
    yield from frames.measure(run, (32,) if small else (200, 400, 800, (1920, 1080)))


def tests(small: bool) -> Iterator[Row]:
    """Laws and hard cases with this variant."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--tb=line"]
    command += ["tests/hard_cases", "tests/laws/test_image_laws.py"]
    command += ["-k", "roughness"] if small else ["-n", "8", "-p", "no:benchmark"]
    environment = os.environ | {"MI_REFGS_TEST_VARIANT": str(mi.variant())}
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment)
    yield {"code": done.returncode, "tail": done.stdout.splitlines()[-30:]}


LIMITS = {values: 60, splat: 80, step: 120, gsplat: 60, fit: 210, frame: 30, volprim: 30, tests: 60}
"""Seconds of each step, in order of worth."""


def run(name: str, seconds: float, arguments: list[str], log: Any) -> Iterator[Row]:
    """The rows of a step in a process of its own, and at last what went wrong."""
    command = [sys.executable, "-m", "benchmarks.gpu", *arguments, "--only", name]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, cwd=ROOT) as process:
        assert process.stdout is not None
        timer = threading.Timer(seconds, process.kill)
        timer.start()
        yield from (json.loads(line) for line in process.stdout if line.startswith('{"'))
        timer.cancel()
    if code := process.returncode:
        log.seek(0)
        yield {"error": f"exit code {code} (-9: the limit of {seconds} s)", "log": log.read()[-600:]}


def main(arguments: list[str] | None = None) -> int:
    """Measure; returns the exit code, 1 if a step fails."""
    parser = plain_parser("gpu", __doc__)
    names = {function.__name__: function for function in LIMITS}
    parser.add_argument("output", type=Path, metavar="OUT")
    parser.add_argument("steps", nargs="*", metavar="STEP", help=", ".join(names))
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("--small", action="store_true")
    parser.add_argument("--only", help="print the rows of a step")
    options = parser.parse_intermixed_args(arguments)
    mi.set_variant(options.variant)
    mi.set_log_level(mi.LogLevel.Error)
    if options.only:
        faulthandler.dump_traceback_later(0.9 * LIMITS[names[options.only]])  # where it was, if it is slow
        for row in names[options.only](options.small):
            print(json.dumps(row), flush=True)
        return 0
    query = "nvidia-smi --query-gpu=name,driver_version --format=csv,noheader"
    card = subprocess.run(query, shell=True, capture_output=True, text=True)
    result = recorded(dict) | {"card": card.stdout.strip(), "steps": {}}
    passed = [str(options.output), "--variant", options.variant, *["--small"] * options.small]
    options.output.mkdir(parents=True, exist_ok=True)
    begin = time.perf_counter()
    for name in options.steps or names:
        result["steps"][name] = rows = []
        with open(options.output / "log.txt", "a+") as log:
            for row in run(name, LIMITS[names[name]] * (10 if options.small else 1), passed, log):
                rows.append(row)
                result["seconds"] = time.perf_counter() - begin
                write_result(options.output / "gpu.json", result)
        print(f"{name}: {len(rows)} rows, {time.perf_counter() - begin:.0f} s", flush=True)
    return int(any("error" in row for rows in result["steps"].values() for row in rows))


if __name__ == "__main__":
    sys.exit(main())
