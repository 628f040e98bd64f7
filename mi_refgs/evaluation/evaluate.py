"""The quality of a run on the test views of its data set: metrics.json and pictures."""

from __future__ import annotations

import dataclasses
import hashlib
import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.data.dataset import Dataset
from mi_refgs.data.region import region_pixels
from mi_refgs.data.view import View
from mi_refgs.errors import InputError
from mi_refgs.evaluation import decomposition, images, metrics
from mi_refgs.evaluation.speed import milliseconds
from mi_refgs.evaluation.surface import TrueSurface, surface_scores
from mi_refgs.fitting.exposure import EXPOSURE_FILE, with_gain
from mi_refgs.fitting.runner import of_run
from mi_refgs.fitting.targets import read_views
from mi_refgs.io.files import read_json
from mi_refgs.io.images import write_png
from mi_refgs.kernels.device import machine
from mi_refgs.methods.method import Method
from mi_refgs.progress import with_bar
from mi_refgs.render.samples import samples_per_axis
from mi_refgs.runs.export import up_to_date
from mi_refgs.runs.run import DATASET, Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.light_file import read_radiance

FOLDER = "eval"
SHEET = "contact_sheet.png"
DECOMPOSITION = "decomposition.png"
METRICS = "metrics.json"
LONGEST_STEM, HASH_DIGITS = 60, 12
"""Characters of the view's name in an image's file name, of which file systems allow 255 bytes, and digits of
the hash that separates equal ones."""
SHEET_VIEWS = 4
"""Rows of either sheet, spread evenly over the test views."""
REGION_KEYS = ("psnr_region", "ssim_region", "region_share")
NORMAL_KEYS = ("normal_mae_deg", "normal_mae_deg_full")
LIGHT_KEYS = ("env_scale", "env_mae", "env_psnr", "env_correlation")


def load_split(
    run: Run, method: Method, split: str, path: Path | None = None, decode: bool = True
) -> Dataset:
    """A split of the data set that a run was fitted to, or of the one at `path`, read as the method says.

    Its region of interest is the run's. Raises InputError as `read_dataset` and `Run.region` do, and if the
    run does not say where its data is or it is gone.
    """
    if path is None:
        if not (run.path / DATASET).is_file():
            raise InputError(f"{run.path}: data set: the run records none; name one with --data")
        try:
            path = run.dataset()
            found = path.is_dir()
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"{run.path / 'dataset.json'}: path: cannot be read ({error}); name the data with --data"
            ) from error
        if not found:
            raise InputError(
                f"{run.path / 'dataset.json'}: path: {path} is gone; name the data set's folder with --data"
            )
    return of_run(run, read_views(method, path, split, decode=decode))


def evaluate(
    run: Run,
    data: Path | None = None,
    progress: bool = False,
    samples: int = 1,
    antialias: bool = False,
) -> dict[str, Any]:
    """Render the test views, measure them, and write metrics.json, renders and two sheets into the run.

    Evaluates the artefacts as they lie in the folder, after writing what a newer checkpoint makes stale.
    Every key is always there: null, with a `…_reason`, where it does not apply. `psnr_region` and
    `ssim_region` are of pixels whose ray meets the data's region of interest (`data.region.region_pixels`),
    `region_share` is their part of all. Normals count where the true alpha is above ½ and there is a true
    normal (without alpha, where there is one), materials (`evaluation.decomposition`) where the data defines
    them; keys that end in `_concave` count pixels where the true surface is (`evaluation.surface`).
    `psnr_gain` is that after `data.exposure.fitted_gain`, a gain a channel of every view: what pictures of
    different exposure are judged by, for every method alike. `exposure` is what the fit decided about its own
    gains. `image_size` is that of the test views as they are read, each pixel the mean of `downscale`² pixels
    of the file; scores of different sizes do not compare. `ms_per_frame` is the median over single
    synchronised frames of the displayed image alone, light filtered beforehand. `pruned` is null for a whole
    scene. All that is rendered has `samples` a pixel, box filtered (`render.samples`); `antialias` asks for
    widened roughness (`render.antialias`) where the run was fitted without.

    Raises InputError for a folder that is no run or holds neither artefacts nor a checkpoint, for data
    that is gone, and for a foreign file in the run that has the name of a result.
    """
    method = run.method()
    views = load_split(run, method, "test", data)
    renders = render_names(views.views)
    run.output.require_free([*renders, SHEET, DECOMPOSITION, METRICS])
    fitted = up_to_date(run, method, views.views[0].camera())
    if antialias:
        shading = dataclasses.replace(fitted.shading, antialias=True)
        fitted = dataclasses.replace(fitted, shading=shading)
    view = fitted.renderer(samples=samples)
    alone = None if fitted.surroundings is None else dataclasses.replace(fitted, surroundings=None)
    object_view = None if alone is None else alone.renderer(samples=samples)
    run.output.claim(*renders, SHEET, DECOMPOSITION, METRICS)

    shown = set(np.linspace(0, len(views.views) - 1, SHEET_VIEWS).round().astype(int).tolist())
    rows: list[dict[str, np.ndarray]] = []
    kept: list[Any] = []
    per_view: list[dict[str, Any]] = []
    surface, errors = TrueSurface.read(views.path, views.offset), decomposition.Decomposition()
    materials = decomposition.material_maps(fitted, samples)
    for index, truth in enumerate(with_bar(views.views, "eval", unit="view", disable=not progress)):
        truth = truth.load()
        frame = view(truth.camera())
        shot = images.RenderedView.of(frame, views, truth)
        gain, gained = with_gain(frame, truth, views)
        goal = truth.displayed
        scores: dict[str, Any] = {
            "name": truth.name,
            "psnr": metrics.psnr(shot.image, goal),
            "psnr_gain": metrics.psnr(gained, goal),
            "gain": gain.round(4).tolist(),
            "ssim": metrics.ssim(shot.image, goal),
        }
        for name, measure in (("flip", metrics.flip), ("lpips", metrics.lpips)):
            previous = per_view[0] if per_view else {}
            if previous.get(f"{name}_reason"):  # what is not installed for one picture is not for the next
                scores[name], scores[f"{name}_reason"] = None, previous[f"{name}_reason"]
            else:
                scores[name], scores[f"{name}_reason"] = measure(shot.image, goal)
        if views.region is not None and (where := region_pixels(truth, views.region)).any():
            scores["psnr_region"] = metrics.psnr(shot.image, goal, where)
            scores["ssim_region"] = metrics.ssim(shot.image, goal, where)
            scores["region_share"] = float(where.mean())
        if truth.normal is not None:
            scores |= metrics.normal_mae_deg(shot.normal, truth.normal, truth.covered())
        per_view.append(scores)
        maps = materials(truth.camera(), shot)
        concave = None if surface is None else surface.concave(truth)
        errors.add(shot, maps, truth, concave)
        write_png(run.path / renders[index], shot.image)
        if index in shown:
            found = images.panels(shot, truth)
            if object_view is not None:
                found["object alone"] = images.RenderedView.of(
                    object_view(truth.camera()), views, truth
                ).image
            rows.append(found)
            kept.append((shot, maps, truth, concave))

    result: dict[str, Any] = {
        name: _mean(per_view, name)
        for name in ("psnr", "psnr_gain", "ssim", "flip", "lpips", *REGION_KEYS, *NORMAL_KEYS)
    }
    for name in ("flip", "lpips"):
        result[f"{name}_reason"] = per_view[0][f"{name}_reason"] or None
    result["region_reason"] = (
        None if result["psnr_region"] is not None else "the data set has no region of interest"
    )
    result["normal_reason"] = (
        None if result["normal_mae_deg"] is not None else "the data set has no true normals"
    )
    light, light_panels = _light(fitted, views)
    result |= light | errors.result()
    result |= surface_scores(fitted.mesh, surface, views.views)
    result |= {
        "exposure": _exposure(run),
        "train_seconds": fitted.seconds,
        "iterations": fitted.iteration,
        "surfels": fitted.surfels.count,
        "pruned": None if fitted.pruned is None else dataclasses.asdict(fitted.pruned),
        "samples": samples_per_axis(samples) ** 2,
        "antialias": fitted.shading.antialias,
        "ms_per_frame": milliseconds(
            [fitted.renderer(aovs=False, samples=samples)], [v.camera() for v in views.views], views
        )[0],
        "variant": method.variant,
        "preset": method.preset,
        "dataset": str(views.path),
        "test_views": len(per_view),
        "image_size": [views.views[0].width, views.views[0].height],
        "downscale": method.data.downscale or 1,
        "machine": machine(),
        "views": [
            {key: value for key, value in scores.items() if not key.endswith("_reason")}
            for scores in per_view
        ],
    }
    write_png(run.path / SHEET, images.contact_sheet(rows, light_panels))
    rows = [decomposition.panels(s, m, v, errors.scale(), c) for s, m, v, c in kept]
    write_png(run.path / DECOMPOSITION, images.contact_sheet(rows, light_panels))
    run.write_json(METRICS, result)
    return result


def _exposure(run: Run) -> dict[str, Any] | None:
    """What the fit decided about gains; None if it decided nothing."""
    if not (run.path / EXPOSURE_FILE).is_file():
        return None
    return {name: value for name, value in read_json(run.path / EXPOSURE_FILE).items() if name != "gain"}


def render_names(views: Sequence[View]) -> list[str]:
    """Path, below the run folder, of the image that `evaluate` writes of each test view; no two are the same.

    Views whose names differ only in what file names lose, such as case or punctuation, get a hash of the
    name.
    """
    stems = [
        re.sub(r"[^\w]+", "_", unicodedata.normalize("NFC", view.name)).strip("_")[:LONGEST_STEM]
        for view in views
    ]
    alike = Counter(stem.casefold() for stem in stems)
    found: list[str] = []
    for index, (view, stem) in enumerate(zip(views, stems, strict=True)):
        if not stem or alike[stem.casefold()] > 1:
            same = sum(other.name == view.name for other in views[:index])
            digest = hashlib.sha256(f"{same}/{view.name}".encode()).hexdigest()[:HASH_DIGITS]
            stem = f"{stem}_{digest}".lstrip("_")
        found.append(f"{FOLDER}/{stem}.png")
    return found


def _light(fitted: TrainedScene, data: Dataset) -> tuple[dict[str, Any], dict[str, np.ndarray] | None]:
    """The env_ keys, and the pictures of the light."""
    nothing: dict[str, Any] = dict.fromkeys(LIGHT_KEYS)
    if fitted.light is None:
        return nothing | {"env_reason": "the method has no light"}, None
    tensor = fitted.light.radiance()
    light = np.array(tensor, dtype=np.float32).reshape(tensor.shape)
    if data.environment is None:
        return nothing | {"env_reason": "the data set has no environment.exr"}, images.light_panels(light)
    truth = read_radiance(data.environment, len(light))
    return metrics.environment(light, truth) | {"env_reason": None}, images.light_panels(light, truth)


def _mean(per_view: list[dict[str, Any]], name: str) -> float | None:
    values = [scores[name] for scores in per_view if scores.get(name) is not None]
    return float(np.mean(values)) if values else None


def read_metrics(run: Run) -> dict[str, Any] | None:
    """The metrics.json of a run, or None if it has none that can be read."""
    try:
        return read_json(run.path / METRICS)
    except InputError:
        return None
