"""Evaluate a run on the test views of its data set: metrics.json, renders, a contact sheet."""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.data.dataset import Dataset
from mi_refgs.data.region import region_pixels
from mi_refgs.data.view import View, evenly_spread
from mi_refgs.errors import InputError
from mi_refgs.evaluation import metrics
from mi_refgs.evaluation.decomposition import Decomposition, material_maps
from mi_refgs.evaluation.error_budget import ErrorBudget, classify
from mi_refgs.evaluation.images import Maps, RenderedView, contact_sheet, light_panels, over_colour, panels
from mi_refgs.evaluation.scores import caption
from mi_refgs.evaluation.surface import TrueSurface, surface_scores
from mi_refgs.fitting.image_error import aligned, with_gain
from mi_refgs.io.files import read_json
from mi_refgs.io.images import write_png
from mi_refgs.io.progress import with_bar
from mi_refgs.kernels.device import machine
from mi_refgs.render.pipeline import Frame
from mi_refgs.render.samples import samples_per_axis
from mi_refgs.runs.export import write_if_stale
from mi_refgs.runs.run import CAMERAS, EXPOSURE, Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.runs.views import views_of_run
from mi_refgs.shade.light.light_file import read_radiance
from mi_refgs.splat import Camera

FOLDER = "eval"
SHEET, METRICS = "contact_sheet.png", "metrics.json"
LONGEST_STEM = 60  # characters of a view in a file's name; file systems allow 255 bytes
SHEET_VIEWS = 4  # rows of the sheet, spread evenly over the test views
ORANGE = np.array([0.75, 0.3, 0.0])  # of concave pixels
MEANS = """psnr_aligned psnr_aligned_region psnr_aligned_object psnr psnr_region psnr_object ssim ssim_region
    region_share lpips normal_mae_deg normal_mae_deg_full""".split()  # scores whose means are reported


def evaluate(
    run: Run, data: Path | Dataset | None = None, progress: bool = False, samples: int = 1
) -> dict[str, Any]:
    """Render the test views, measure them, and write metrics.json, renders and a contact sheet.

    Evaluates the scene files in the run folder, which are written first if a checkpoint is newer. Every key
    of the upper level is present; a score that does not apply is null, and `NAME_reason` says why.

    `psnr_aligned`        with the gain per channel (`data.exposure`) and the pose (`data.registration`) that
                          fit half of the pixels best, on the other half: of images without alpha, and if
                          the fit corrected its cameras
    `image_size`          of the test views as `runs.views.measured_views` reads them
    `…_region`            pixels whose ray meets the data's region of interest; `region_share` of all
    `…_object`            pixels that are mostly covered by the object, by alpha or true surface
    `normal_…`            pixels with true alpha above ½ (where there is alpha) and a true normal
    `…_concave`           pixels where the true surface is concave (`evaluation.surface`)
    `error_budget`        shares of the squared error per class of pixels (`evaluation.error_budget`)
    `exposure`, `cameras` whether the fit had gains of its training views, and corrected cameras
    `downscale`           side of the blocks of pixels that the fit averaged
    `ms_per_frame`        median over single frames of the displayed image, the environment map prefiltered
    `caption`             scale, mask and frame of these numbers

    Renders have `samples` per pixel, box filtered (`render.samples`). Raises InputError for a folder that is
    no run or contains neither a scene nor a checkpoint, and for data that is gone."""
    # The scene, its test views, and the files to write.
    method = run.method()
    views = views_of_run(run, method, "test", data, measured=True)
    renders = render_names(views.views)
    fitted = write_if_stale(run, method, lambda _: views_of_run(run, method, "test", data).views[0].camera())
    per_pixel = samples_per_axis(samples) ** 2  # refuses other numbers before anything is written
    # Render and measure the views, and write their images.
    surface = TrueSurface.read(views.path, views.offset)
    errors, budget = Decomposition(), ErrorBudget()
    render, maps_of = fitted.renderer(samples=samples, turning=True), material_maps(fitted, samples)
    plain = fitted.renderer(aovs=False, samples=samples, turning=True)
    around, corrected = fitted.surroundings is not None, (run.path / CAMERAS).is_file()
    gains = (run.path / EXPOSURE).is_file()
    aligns = corrected or gains or not views.has_alpha
    object_only = replace(fitted, surroundings=None).renderer(samples=samples) if around else None
    in_sheet = evenly_spread(len(views.views), SHEET_VIEWS)
    for stale in (run.path / FOLDER).glob("[0-9][0-9][0-9]_*.png"):  # of another data set
        stale.unlink()
    scores: list[dict[str, Any]] = []
    shown: list[tuple[RenderedView, View, Maps]] = []  # in the sheet, with more images
    for index, view in enumerate(with_bar(views.views, "eval", unit="view", disable=not progress)):
        # Scores.
        view = view.load()
        frame = render(view.camera())
        rendered = RenderedView.of(frame, views, view)
        masks = _masks(view, views)
        scores.append(_scores(rendered, view, masks, scores[0] if scores else {}))
        if aligns:
            scores[-1] |= _aligned_scores(view, frame, plain, masks, views)
        # Errors of materials, of concave pixels and per class of pixels.
        concave = None if surface is None else surface.concave(view)
        rendered = replace(rendered, maps=maps_of(view.camera(), rendered))
        errors.add(rendered, view, concave)
        budget.add(rendered, view, classify(view, surface))
        write_png(run.path / renders[index], rendered.image)
        if index in in_sheet:
            more: Maps = {}
            if concave is not None:
                more["concave"] = over_colour(concave[..., None] * ORANGE, view.covered())
            if object_only is not None:
                more["object only"] = RenderedView.of(object_only(view.camera()), views, view).image
            shown.append((rendered, view, more))
    light_scores, footer = _light(fitted, views)
    cameras, size = [view.camera() for view in views.views], [views.views[0].width, views.views[0].height]
    result = _means(scores) | light_scores | errors.result() | budget.result()
    result |= surface_scores(fitted.mesh, surface, views.views)
    result |= {
        "caption": caption(size),
        "exposure": gains,
        "cameras": corrected,
        "train_seconds": fitted.seconds,
        "iterations": fitted.iteration,
        "surfels": fitted.surfels.count,
        "samples": per_pixel,
        "antialias": fitted.shading.antialias,
        "ms_per_frame": metrics.frame_milliseconds(plain, cameras, views),
        "method": method.name,
        "preset": method.preset,
        "dataset": str(views.path),
        "test_views": len(scores),
        "image_size": size,
        "downscale": method.data.downscale or 1,
        "machine": machine(),
        "views": [{k: v for k, v in view.items() if not k.endswith("_reason")} for view in scores],
    }
    rows = [panels(rendered, view, errors.scale()) | more for rendered, view, more in shown]
    write_png(run.path / SHEET, contact_sheet(rows, footer))
    run.write_json(METRICS, result)
    return result


def _means(per_view: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the mean scores of the views, and why some are missing."""
    result: dict[str, Any] = {}
    for name in MEANS:
        values = [scores[name] for scores in per_view if scores.get(name) is not None]
        result[name] = float(np.mean(values)) if values else None
    result["lpips_reason"] = per_view[0]["lpips_reason"] or None
    for name, key, reason in (
        ("region", "psnr_region", "the data set has no region of interest"),
        ("object", "psnr_object", "the data set has neither masks nor a true surface"),
        ("normal", "normal_mae_deg", "the data set has no ground-truth normals"),
        ("aligned", "psnr_aligned", "images have alpha, and the fit corrected neither cameras nor exposure"),
    ):
        result[f"{name}_reason"] = reason if result[key] is None else None
    return result


def _masks(view: View, data: Dataset) -> dict[str, np.ndarray]:
    """Return the pixels (H, W) of the whole view, of the region and of the object, by a score's ending."""
    masks = {"": np.ones((view.height, view.width), bool)}
    if data.region is not None:
        masks["_region"] = region_pixels(view, data.region)
    if view.has_alpha or view.normal is not None or view.depth is not None:
        masks["_object"] = view.covered() > metrics.FOREGROUND_ALPHA
    return {name: mask for name, mask in masks.items() if mask.any()}


def _aligned_scores(
    view: View, frame: Frame, render: Callable[[Camera], Frame], masks: dict[str, np.ndarray], data: Dataset
) -> dict[str, Any]:
    """Return the scores of a loaded view on half of a checkerboard, with the pose and the gain that fit the
    other half best; `frame` is rendered with the pose that the view has."""
    edge = math.ceil(max(view.width, view.height) / 16)  # as `scores.caption` says
    fitted = (np.indices((view.height, view.width)) // edge).sum(axis=0) % 2 == 0
    moved = aligned(view, frame, render, data, fitted)
    gain, image = with_gain(render(moved.camera()), moved, data, fitted)
    scores: dict[str, Any] = {"gain": gain.round(4).tolist()}
    for name, mask in masks.items():
        if (scored := mask & ~fitted).any():
            scores[f"psnr_aligned{name}"] = metrics.psnr(image, view.displayed, scored)
    return scores


def _scores(
    rendered: RenderedView, view: View, masks: dict[str, np.ndarray], first: dict[str, Any]
) -> dict[str, Any]:
    """Return the scores of one view, which has ground truth loaded; `first` are those of the first view."""
    image, truth = rendered.image, view.displayed
    scores: dict[str, Any] = {"name": view.name, "ssim": metrics.ssim(image, truth)}
    scores |= {f"psnr{name}": metrics.psnr(image, truth, where) for name, where in masks.items()}
    reason = first.get("lpips_reason")  # a metric that is not installed stays so
    scores["lpips"], scores["lpips_reason"] = (None, reason) if reason else metrics.lpips(image, truth)
    if (where := masks.get("_region")) is not None:
        scores |= {"ssim_region": metrics.ssim(image, truth, where), "region_share": float(where.mean())}
    if view.normal is not None:
        scores |= metrics.normal_mae_deg(rendered.normal, view.normal, view.covered())
    return scores


def render_names(views: Sequence[View]) -> list[str]:
    """Return paths, below the run folder, of the image that `evaluate` writes of each test view."""
    stems = [re.sub(r"[^\w]+", "_", view.name).strip("_")[:LONGEST_STEM] for view in views]
    return [f"{FOLDER}/{index:03d}_{stem}.png" for index, stem in enumerate(stems)]


def _light(fitted: TrainedScene, data: Dataset) -> tuple[dict[str, Any], Maps | None]:
    """Return the env_ keys, and the panels of the environment map."""
    nothing: dict[str, Any] = dict.fromkeys(("env_scale", "env_mae", "env_psnr", "env_correlation"))
    if fitted.light is None:
        return nothing | {"env_reason": "the method has no light"}, None
    light = fitted.light.radiance().numpy()
    if data.environment is None:
        return nothing | {"env_reason": "the data set has no environment.exr"}, light_panels(light)
    truth = read_radiance(data.environment, len(light))
    return metrics.environment(light, truth) | {"env_reason": None}, light_panels(light, truth)


def read_metrics(run: Run) -> dict[str, Any] | None:
    """Read the metrics.json of a run; None if it has none that can be read."""
    try:
        return read_json(run.path / METRICS)
    except InputError:
        return None
