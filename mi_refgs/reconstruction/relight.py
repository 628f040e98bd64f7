"""Render the scene of a run under another light, scored where there is ground truth. Its folder contains

test/r_000.png, .exr    the test views as a data set has them: straight sRGB, premultiplied linear RGBA
turntable/t_000.png     or these, of cameras around the object
scene.xml, surfels.ply, envmap.exr, mesh.ply, model.json    from which `mi.load_file` renders the same
relight.json            the settings, and the score where the data set has ground truth under this light
sheet.png               relit images and the ground truth; and the environment map
turntable/relight.json, sheet.png    the same of a turntable, with the frames"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from mi_refgs.data.dataset import BACKGROUNDS, Dataset, read_dataset
from mi_refgs.data.view import evenly_spread
from mi_refgs.errors import InputError, within
from mi_refgs.evaluation import metrics
from mi_refgs.evaluation.images import Maps, contact_sheet, displayed_over, encoded_over_black, light_image
from mi_refgs.evaluation.scores import caption
from mi_refgs.io.exr import write_exr
from mi_refgs.io.files import write_json
from mi_refgs.io.images import straight_srgb, write_png
from mi_refgs.io.ownership import own_folder
from mi_refgs.io.progress import with_bar
from mi_refgs.methods.method import Method
from mi_refgs.reconstruction.new_light import NewLight, truth_under
from mi_refgs.reconstruction.reconstruction import load
from mi_refgs.render.samples import samples_per_axis
from mi_refgs.runs.export import export
from mi_refgs.runs.run import RELIT, Run

SHEET = "sheet.png"
SHEET_VIEWS, SHEET_COLUMNS = 4, 6  # test views of a sheet, spread evenly; most frames of a turntable per row
NO_TRUTH = "the data set has no test views under this light; make them with `refgs dataset --relight`"
NO_DATA = "there is no data set, so cameras are around the object; name its folder with --data"
FITTED_COLOUR = (
    "its diffuse part was fitted as a colour; albedo is that colour divided by the irradiance of the fitted "
    "light, with the errors of that light; `refgs train --for relighting` fits materials"
)
INSIDE = 0.99  # of the largest alpha: from there a pixel is inside, as coverage of edges depends on no light


def relight(
    run: Run,
    light: NewLight,
    out: Path | None = None,
    *,
    turntable: int = 0,
    data: Path | None = None,
    samples: int = 1,
    progress: bool = False,
) -> dict[str, Any]:
    """Render the scene of a run under another light into a folder; return the content of relight.json.

    `out` is RUN/relight/NAME by default. Only materials stay, as in `Reconstruction.relight`. The views are
    test views of the run's data set, or of `data`, compared with ground truth under this light, if any; with
    `turntable`, so many cameras on a circle; without data both are around the object. Raises InputError for a
    run without light or materials, an unreadable light or data set, and a folder with other files."""
    per_pixel = samples_per_axis(samples) ** 2  # refuses other numbers before anything is written
    # The views, and the ground truth under this light.
    fitted = load(run.path)
    fitted = replace(fitted, provenance=fitted.provenance.with_data(data))
    provenance, requested, true_views, no_truth = fitted.provenance, light, None, NO_TRUTH
    views = provenance.views("test", truth=False) if provenance.has_data and not turntable else None
    source = provenance.data if provenance.has_data else None
    known = None if source is None else truth_under(light, source)
    if views is not None and known is not None:
        try:
            true_views, light = _true_views(provenance.method, known[0], views), known[1]
        except InputError as error:
            if known[0] != views.path:
                raise
            no_truth = f"its own images are no linear radiance ({error})"
    cameras = fitted.turntable(turntable) if turntable else fitted.cameras()
    with within(run.path):
        relit = fitted.relight(light)
    name = light.path.stem if true_views is None else light.path.parent.name
    name += f"_r{light.rotate:g}" if light.rotate % 360 else ""
    name += f"_e{light.exposure:+g}" if light.exposure else ""
    folder = run.path / "relight" / name if out is None else out
    inside = folder.resolve().is_relative_to(run.path.resolve())  # both may then move together
    own_folder(folder, f"relight {requested.identity}" + ("" if inside else f" of {run.path.resolve()}"))
    kind, place = ("turntable/t", "turntable/") if turntable else ("test/r", "")
    images = [f"{kind}_{i:03d}.png" for i in range(len(cameras))]
    for stale in folder.glob(f"{kind}_*.*"):  # of more views, or another data set
        stale.unlink()
    export(relit.trained, folder, cameras[0])
    ours = []
    jobs = list(zip(images, cameras, strict=True))
    for image, camera in with_bar(jobs, "relight", unit="view", disable=not progress):
        ours.append(relit.render(camera, samples=samples))
        write_exr((folder / image).with_suffix(".exr"), ours[-1])
        write_png(folder / image, straight_srgb(ours[-1]))
    colour = BACKGROUNDS[provenance.method.data.background]
    background = np.full(3, colour, np.float32) if views is None else views.background
    reason = "a turntable has no ground truth" if turntable else no_truth
    reason = reason if provenance.has_data else NO_DATA
    result: dict[str, Any] = {
        "run": str(run.path),
        "output": str(folder),
        "sheet": place + SHEET,
        "light": str(requested.path),
        "rotate": light.rotate,
        "exposure": light.exposure,
        "images": images,
        "samples": per_pixel,
        "warning": FITTED_COLOUR if fitted.trained.shading.diffuse == "sh" else None,
    } | {"psnr": None, "psnr_scaled": None, "score_reason": reason}
    truth: list[np.ndarray] = []
    if true_views is not None and views is not None:
        for view in (view.load() for view in true_views.views):
            alpha = np.ones_like(view.image[..., 0]) if view.alpha is None else view.alpha
            truth.append(np.dstack([view.image * np.float32(2.0**light.exposure), alpha]))
        result |= score([view.name for view in views.views], ours, truth, background) | {"score_reason": None}
        result["caption"] = caption(truth[0].shape[1::-1], relit=True)
    assert relit.trained.light is not None
    environment = light_image(relit.trained.light.radiance().numpy())
    rows = _rows(ours, truth, np.array(result.get("scale", 1.0)), background)
    write_png(folder / place / SHEET, contact_sheet(rows, {"environment map": environment}))
    write_json(folder / place / RELIT, result)
    return result


def _true_views(method: Method, folder: Path, views: Dataset) -> Dataset:
    """Read the test views under a light of the data set; raises InputError unless they have its cameras."""
    options: dict[str, Any] = {"downscale": method.data.downscale or 1, "images": "exr", "truth": False}
    found = read_dataset(folder, "test", background="black", **options).relative_to(views.offset)
    theirs, ours = ([view.to_world for view in data.views] for data in (found, views))
    if len(theirs) != len(ours) or np.abs(np.subtract(theirs, ours)).max() > 1e-6:
        what = f"not the cameras of {views.path}"
        raise InputError(what, folder / "transforms_test.json", remedy="make it again")
    return found


def _rows(
    ours: Sequence[np.ndarray], truth: Sequence[np.ndarray], scale: np.ndarray, background: np.ndarray
) -> list[Maps]:
    """Return the rows of the sheet: relit, relit after the scale, and ground truth; or all frames."""
    if truth:
        titles = "relit", "relit, per-channel scale", "ground truth"
        shown = [(ours[i], ours[i] * [*scale, 1], truth[i]) for i in evenly_spread(len(ours), SHEET_VIEWS)]
        return [{t: displayed_over(x, background) for t, x in zip(titles, row, strict=True)} for row in shown]
    frames = [(str(i), displayed_over(image, background)) for i, image in enumerate(ours)]
    lines = -(-len(frames) // SHEET_COLUMNS)
    columns = -(-len(frames) // lines)  # rows of equal length: 8 frames are 4 and 4, not 6 and 2
    return [dict(frames[i : i + columns]) for i in range(0, len(frames), columns)]


def common_scale(ours: Sequence[np.ndarray], truth: Sequence[np.ndarray]) -> np.ndarray:
    """Fit the scale of radiance per channel (3,), which light and albedo of a fit share, by least squares of
    displayed colours inside the object over all images; 1 for a channel that is black in either."""
    a, b = (np.concatenate([p.reshape(-1, 4) for p in images]).astype(np.float64) for images in (ours, truth))
    inside = np.flatnonzero((alpha := np.minimum(a[:, 3], b[:, 3])) > INSIDE * min(1, alpha.max()))
    a, b = (x[inside[:: max(1, len(inside) // 200_000)]] for x in (a, b))
    scale = np.ones(3)
    for c in range(3):
        goal, mean = encoded_over_black(b[:, c], b[:, 3]), (a[:, c].sum(), b[:, c].sum())
        if min(mean) <= 0:
            continue

        def error(stops: float, c: int = c, goal: np.ndarray = goal) -> float:
            return float(np.mean((encoded_over_black(a[:, c] * 2**stops, a[:, 3]) - goal) ** 2))

        middle = float(np.log2(mean[1] / mean[0]))
        found = minimize_scalar(error, bounds=(middle - 2, middle + 2))  # stops
        scale[c] = 2.0 ** min((0.0, middle, float(found.x)), key=error)
    return scale


def score(
    names: Sequence[str], ours: Sequence[np.ndarray], truth: Sequence[np.ndarray], background: np.ndarray
) -> dict[str, Any]:
    """Return `psnr`, `ssim` and both after `scale` (`…_scaled`): means over images; and `views`. Images are
    premultiplied linear RGBA (H, W, 4), compared display-encoded over the background."""
    scale = common_scale(ours, truth)
    views = []
    for name, own, true in zip(names, ours, truth, strict=True):
        goal = displayed_over(true, background)
        found: dict[str, Any] = {"name": name}
        for suffix, factor in (("", 1.0), ("_scaled", scale)):
            shown = displayed_over(own, background, factor)
            found |= {f"psnr{suffix}": metrics.psnr(shown, goal), f"ssim{suffix}": metrics.ssim(shown, goal)}
        views.append(found)
    means = {k: float(np.mean([v[k] for v in views])) for k in views[0] if k != "name"}
    return means | {"scale": [float(x) for x in scale], "views": views}
