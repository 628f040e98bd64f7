"""Render a trained scene under another light into a folder, and score it where there is ground truth.

The folder contains

    test/r_000.png, .exr    the test views as a data set has them: straight sRGB, premultiplied linear RGBA
    turntable/t_000.png     or these, of cameras around the object
    scene.xml, surfels.ply, envmap.exr, mesh.ply, model.json    from which `mi.load_file` renders the same
    relight.json            the settings, and the score where the data set has ground truth under this light
    sheet.png               relit images and the ground truth; and the environment map
    turntable/relight.json, sheet.png    the same of a turntable, with the frames
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.data.dataset import BACKGROUNDS, Dataset, read_dataset
from mi_refgs.data.view import evenly_spread
from mi_refgs.errors import InputError
from mi_refgs.evaluation.images import contact_sheet, displayed_over, image_array, light_image
from mi_refgs.evaluation.scores import caption
from mi_refgs.formats.orbits import turntable_cameras
from mi_refgs.io.exr import write_exr
from mi_refgs.io.files import write_json
from mi_refgs.io.images import straight_srgb, write_png
from mi_refgs.io.ownership import OutputFolder
from mi_refgs.methods.method import Method
from mi_refgs.progress import with_bar
from mi_refgs.reconstruction.new_light import NewLight, truth_under
from mi_refgs.reconstruction.provenance import Provenance
from mi_refgs.relighting.score import score
from mi_refgs.render.samples import samples_per_axis
from mi_refgs.runs.export import export, write_if_stale
from mi_refgs.runs.relightable import relightable
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import ARTEFACTS

SHEET, RESULT = "sheet.png", "relight.json"
SHEET_VIEWS = 4  # rows of the sheet, spread evenly over the test views
SHEET_COLUMNS = 6  # most frames of a turntable per row of its sheet
PREFIX = {"test": "r", "turntable": "t"}
"""First letter of image names by folder; test views have the names of a data set."""
NO_TRUTH = "the data set has no test views under this light; make them with `refgs dataset --relight`"
NO_DATA = "there is no data set, so cameras are around the object; name its folder with --data"


@dataclass(frozen=True)
class Relit:
    """The content of relight.json, and a warning for the user, if there is one."""

    result: dict[str, Any]
    sheet: str  # path in the folder
    warning: str = ""


def relight(
    run: Run,
    light: NewLight,
    out: Path | None = None,
    *,
    turntable: int = 0,
    data: Path | None = None,
    samples: int = 1,
    progress: bool = False,
) -> Relit:
    """Render the scene of a run under another light into a folder.

    `out` is RUN/relight/NAME by default, with the rotation and the exposure in its name if they are set, and
    with a number if there is another map of this name.

    Only materials of the scene stay (`runs.relightable`): diffuse light is the new light's irradiance, with
    the mesh's shadows and bounces; reflections are traced. The views are the test views of the run's data
    set, or of `data`; with `turntable`, so many cameras on a circle around the object instead. Without a data
    set both are around the object (`Provenance.shots`). If the data set has ground truth under this light
    (`truth_under`), the test views are compared with it.

    Raises InputError for a run without light or materials, a light or a data set that cannot be read, and a
    folder that cannot be written or contains a run, images of another light, or foreign files of these names.
    """
    if turntable < 0:
        raise InputError(f"--turntable: {turntable} is out of range; give a number of views from 1")

    # The views, and the ground truth under this light.
    provenance = Provenance.of(run).with_data(data)
    views = provenance.views("test") if provenance.has_data else None
    requested, true_views = light, None
    if views is not None and not turntable and (known := truth_under(light, views.path)) is not None:
        true_views, light = _true_views(provenance.method, known[0], views), known[1]

    # The scene under the new light.
    fitted = write_if_stale(run, provenance.method, provenance.first_camera)
    try:
        new_light = light.read()
        scene = replace(relightable(fitted), light=new_light)
    except InputError as error:
        raise InputError(f"{run.path}: {error}") from error
    cameras, kind = [shot.camera for shot in provenance.shots(fitted, "test")], "test"
    if turntable:
        region = provenance.region if views is None else views.region
        region = None if fitted.surroundings is None or provenance.is_moved else region
        # The mesh of an open scene contains its background, too.
        bare = scene if fitted.surroundings is None else replace(scene, mesh=None)
        cameras, kind = turntable_cameras(bare, cameras, turntable, region), "turntable"

    # The folder.
    name = light.path.stem if true_views is None else light.path.parent.name
    own = f"{name}{light.suffix}"
    output = _own_folder(run, own, requested) if out is None else _output(run, out, requested)
    images = [f"{kind}/{PREFIX[kind]}_{i:03d}.png" for i in range(len(cameras))]
    _prepare(output, kind, images)

    # Files of the scene and its images.
    export(scene, output.path, cameras[0], output=output)
    render, ours = scene.renderer(aovs=False, samples=samples), []
    jobs = list(zip(images, cameras, strict=True))
    for image, camera in with_bar(jobs, "relight", unit="view", disable=not progress):
        frame = render(camera)
        ours.append(image_array([*frame.radiance, frame.alpha], camera.height, camera.width))
        write_exr((output.path / image).with_suffix(".exr"), ours[-1])
        write_png(output.path / image, straight_srgb(ours[-1]))

    # The score, and the sheet.
    colour = BACKGROUNDS[provenance.method.data.background]
    background = np.full(3, colour, np.float32) if views is None else views.background
    reason = NO_DATA if views is None else "a turntable has no ground truth" if turntable else NO_TRUTH
    result: dict[str, Any] = {
        "run": str(run.path),
        "output": str(output.path),
        "light": str(requested.path),
        "rotate": light.rotate,
        "exposure": light.exposure,
        "pictures": images,  # name of this key in version 0.1
        "samples": samples_per_axis(samples) ** 2,
    } | {"psnr": None, "psnr_scaled": None, "score_reason": reason}
    truth: list[np.ndarray] = []
    if true_views is not None and views is not None:
        truth = _truth(true_views, light.exposure)
        result |= score([view.name for view in views.views], ours, truth, background) | {"score_reason": None}
        result["caption"] = caption(truth[0].shape[1::-1], relit=True)
    rows = _rows(ours, truth, np.array(result.get("scale", 1.0)), background)
    radiance = new_light.radiance().numpy()
    sheet = _beside(kind, SHEET)
    write_png(output.path / sheet, contact_sheet(rows, {"environment map": light_image(radiance)}))
    write_json(output.path / _beside(kind, RESULT), result)
    warning = ""
    if fitted.shading.diffuse == "sh":
        warning = (
            f"{run.path}: its diffuse part was fitted as a colour; albedo is that colour divided by the "
            "irradiance of the fitted light, with the errors of that light; `refgs train --for relighting` "
            "fits materials"
        )
    return Relit(result, sheet, warning)


def _output(run: Run, out: Path, light: NewLight) -> OutputFolder:
    """Return the folder `out` for the images of a run under a light."""
    inside = out.resolve().is_relative_to(run.path.resolve())  # the run and its folder may then move together
    of = "" if inside else f" of {run.path.resolve()}"
    return OutputFolder(out, f"relight {light.identity}{of}", remedy="choose another -o")


def _own_folder(run: Run, name: str, light: NewLight) -> OutputFolder:
    """Return RUN/relight/NAME, or the first of NAME_2, NAME_3, … without files of another light."""
    numbered = itertools.chain([name], (f"{name}_{number}" for number in itertools.count(2)))
    outputs = (_output(run, run.path / "relight" / folder, light) for folder in numbered)
    return next(o for o in outputs if o.owner in o.owners().values() or not o.path.exists())


def _beside(kind: str, file: str) -> str:
    """Return the path of RESULT or SHEET: a turntable's are with its frames, and replace no scores."""
    return f"{kind}/{file}" if kind == "turntable" else file


def _prepare(output: OutputFolder, kind: str, images: Sequence[str]) -> None:
    """Remove the images of the last call for the same light, and claim the names of the new ones."""
    out = output.path
    if (out / "config.toml").exists() or any(out.glob("transforms*.json")):
        what = "contains a run or a data set, whose files would be replaced"
        raise InputError(f"{out}: output: {what}; choose another -o")
    names = [*images, *(str(Path(name).with_suffix(".exr")) for name in images)]
    names += [_beside(kind, RESULT), _beside(kind, SHEET)]
    output.require_free([*names, *ARTEFACTS])
    stale = output.owned(f"{kind}/{PREFIX[kind]}_*.*")  # of more views, or another data set
    output.remove(path.relative_to(out).as_posix() for path in stale)
    output.claim(*names)


def _true_views(method: Method, folder: Path, views: Dataset) -> Dataset:
    """Read the test views under a light of the data set; raises InputError unless they have its cameras."""
    found = read_dataset(
        folder, "test", downscale=method.data.downscale, background="black", images="exr", truth=False
    )
    if len(found.views) != len(views.views) or any(
        np.abs(a.to_world - b.to_world).max() > 1e-6 for a, b in zip(found.views, views.views, strict=True)
    ):
        raise InputError(f"{folder}: transforms_test.json: not the cameras of {views.path}; make it again")
    return found


def _truth(views: Dataset, exposure: float) -> list[np.ndarray]:
    """Return premultiplied linear RGBA (H, W, 4) of views."""
    images = []
    for view in (view.load() for view in views.views):
        alpha = np.ones_like(view.image[..., 0]) if view.alpha is None else view.alpha
        images.append(np.dstack([view.image * np.float32(2.0**exposure), alpha]))
    return images


def _rows(
    ours: Sequence[np.ndarray], truth: Sequence[np.ndarray], scale: np.ndarray, background: np.ndarray
) -> list[dict[str, np.ndarray]]:
    """Return the rows of the sheet: relit, relit after the scale, and ground truth; or all frames."""
    if truth:
        return [
            {
                "relit": displayed_over(ours[i], background),
                "relit, per-channel scale": displayed_over(ours[i], background, scale),
                "ground truth": displayed_over(truth[i], background),
            }
            for i in evenly_spread(len(ours), SHEET_VIEWS)
        ]
    frames = [(str(i), displayed_over(image, background)) for i, image in enumerate(ours)]
    lines = -(-len(frames) // SHEET_COLUMNS)
    columns = -(-len(frames) // lines)  # rows of equal length: 8 frames are 4 and 4, not 6 and 2
    return [dict(frames[i : i + columns]) for i in range(0, len(frames), columns)]
