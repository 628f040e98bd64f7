"""Relighting: the pictures of a trained scene under another light, its scene.xml, its score, a sheet.

A folder of it holds

    test/r_000.png, .exr    the test views as a data set has them: straight sRGB, premultiplied linear RGBA
    turntable/t_000.png     or these, of cameras around the object
    scene.xml, surfels.ply, envmap.exr, mesh.ply, model.json    what `mi.load_file` renders alike
    relight.json            the settings, and the score where the data set has the truth under this light
    sheet.png               ours beside the truth, or the frames; and the light
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.contraction import Region
from mi_refgs.data.dataset import Dataset, read_dataset
from mi_refgs.data.pathtrace import poses_around
from mi_refgs.data.view import View
from mi_refgs.errors import InputError
from mi_refgs.evaluation import pictures
from mi_refgs.evaluation.evaluate import load_split
from mi_refgs.exr import write_exr
from mi_refgs.files import cannot_write, write_json
from mi_refgs.images import straight_srgb, write_png
from mi_refgs.methods.method import Method
from mi_refgs.progress_bar import with_bar
from mi_refgs.relighting.light import NewLight, truth_under
from mi_refgs.relighting.score import score, shown
from mi_refgs.render.pipeline import Frame
from mi_refgs.render.samples import samples_per_axis
from mi_refgs.runs.export import TrainedScene, export, up_to_date
from mi_refgs.runs.relightable import relightable
from mi_refgs.runs.run import Run
from mi_refgs.splat import Camera

SHEET, RESULT = "sheet.png", "relight.json"
SHEET_VIEWS = 4
"""Rows of the sheet, spread evenly over the test views."""
SHEET_COLUMNS = 6
"""Frames of a turntable in a row of its sheet."""
NO_TRUTH = "the data set has no test views under this light; make them with `refgs dataset --relight`"


@dataclass(frozen=True)
class Relit:
    """What `relight` made: the content of relight.json, and a warning for people, if there is one."""

    result: dict[str, Any]
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

    `out` is RUN/relight/NAME by default, with the rotation and the exposure in its name if they are set.

    The scene becomes materials alone (`runs.relightable`): diffuse light is the new light's irradiance, with
    the mesh's shadows and bounces; mirrors are traced. The views are the test views of the run's data set,
    or of `data`; with `turntable`, so many cameras on a circle around the object instead. If the data set has
    the truth under this light (`light.truth_under`), the test views are compared with it.

    Raises InputError for a run without light or materials, a light that cannot be read, data that is gone,
    and a folder that holds a run or cannot be written.
    """
    if turntable < 0:
        raise InputError(f"--turntable: {turntable} is out of range; give a number of views from 1")
    method = run.method()
    views = load_split(run, method, "test", data)
    known = None if turntable else truth_under(light, views.path)
    light = light if known is None else known[1]
    fitted = up_to_date(run, method, views.views[0].camera())
    try:
        scene = replace(relightable(fitted), light=light.read())
    except InputError as error:
        raise InputError(f"{run.path}: {error}") from error
    name = light.path.parent.name if known is not None else light.path.stem
    out = run.path / "relight" / f"{name}{light.suffix}" if out is None else out
    region = None if fitted.surroundings is None else views.region
    shot = turntable_views(scene, views.views, turntable, region) if turntable else views.views
    kind = "turntable" if turntable else "test"
    _prepare(out, kind)
    export(scene, out, shot[0].camera())
    ours = _render(scene, shot, out / kind, samples, progress)

    result: dict[str, Any] = {
        "run": str(run.path),
        "output": str(out),
        "light": str(light.path),
        "rotate": light.rotate,
        "exposure": light.exposure,
        "pictures": [f"{kind}/{i}" for i in _names(kind, len(shot))],
        "samples": samples_per_axis(samples) ** 2,
        "psnr": None,
        "psnr_scaled": None,
        "score_reason": "a turntable has no truth" if turntable else NO_TRUTH,
    }
    truth: list[np.ndarray] = []
    if known is not None:
        truth = _truth(method, known[0], light.exposure, views)
        result |= score([view.name for view in views.views], ours, truth, views.background)
        result["score_reason"] = None
    _write_sheet(out / SHEET, ours, truth, result.get("scale"), views.background, scene)
    write_json(out / RESULT, result)
    warning = ""
    if fitted.shading.diffuse == "sh":
        warning = (
            f"{run.path}: its diffuse part was fitted as a colour; the albedo is that colour over the "
            "irradiance of the fitted light, and what that explains badly stays in it; "
            "`refgs train --for relighting` fits materials"
        )
    return Relit(result, warning)


def turntable_views(
    scene: TrainedScene, views: Sequence[View], count: int, region: Region | None = None
) -> list[View]:
    """Cameras on a circle around the object, as of `turntable_poses`, and with the first view's lens."""
    poses = turntable_poses(scene, [view.to_world for view in views], count, region)
    return [views[0].changed(name=f"{i}", to_world=pose) for i, pose in enumerate(poses)]


def turntable_poses(
    scene: TrainedScene, poses: Sequence[np.ndarray], count: int, region: Region | None = None
) -> np.ndarray:
    """Poses (count, 4, 4) on a circle around the object, z up, like `poses` in distance and (median) height.

    The object is what lies in the `region`; without one, all of the scene.
    """
    if region is not None:
        centre = np.array(region.centre)
    else:
        position = scene.surfels.position().numpy().T if scene.mesh is None else scene.mesh.vertices
        centre = (position.min(axis=0) + position.max(axis=0)).astype(np.float64) / 2
    offset = np.array([pose[:3, 3] for pose in poses]) - centre
    distance = float(np.median(np.linalg.norm(offset, axis=1)))
    height = float(np.median(offset[:, 2] / np.linalg.norm(offset, axis=1)))
    height = min(max(height, -0.95), 0.95)  # not from a pole, where no side is up
    angle = 2 * np.pi * np.arange(count) / count
    ring = math.sqrt(1 - height**2)
    outward = np.stack([ring * np.cos(angle), ring * np.sin(angle), np.full(count, height)], axis=1)
    return poses_around(outward, centre, distance)


def _prepare(out: Path, kind: str) -> None:
    if (out / "config.toml").exists() or any(out.glob("transforms*.json")):
        raise InputError(
            f"{out}: output: holds a run or a data set, whose files would be replaced; choose another -o"
        )
    try:
        (out / kind).mkdir(parents=True, exist_ok=True)
        for stale in (out / kind).glob(f"{_letter(kind)}_*.*"):  # of more views, or another data set
            stale.unlink()
    except OSError as error:
        raise cannot_write(out, error) from error


def _names(kind: str, count: int) -> list[str]:
    return [f"{_letter(kind)}_{i:03d}.png" for i in range(count)]


def _letter(kind: str) -> str:
    """With which the names of pictures begin; test views have the names of a data set."""
    return "r" if kind == "test" else kind[0]


def _render(
    scene: TrainedScene, views: Sequence[View], folder: Path, samples: int, progress: bool
) -> list[np.ndarray]:
    """Premultiplied linear RGBA (H, W, 4) of the views, written as a data set has them."""
    renderer: Callable[[Camera], Frame] = scene.renderer(aovs=False, samples=samples)
    names = _names(folder.name, len(views))
    jobs = list(zip(names, views, strict=True))
    found = []
    for name, view in with_bar(jobs, "relight", unit="view", disable=not progress):
        frame = renderer(view.camera())
        size = view.height, view.width
        rgba = pictures.planes([*frame.radiance, frame.alpha], *size)
        write_exr((folder / name).with_suffix(".exr"), rgba)
        write_png(folder / name, straight_srgb(rgba))
        found.append(rgba)
    return found


def _truth(method: Method, folder: Path, exposure: float, views: Dataset) -> list[np.ndarray]:
    """Premultiplied linear RGBA of the test views under a light that the data set has."""
    options = method.data
    found = read_dataset(
        folder, "test", downscale=options.downscale, background="black", images="exr", truth=False
    ).views
    if len(found) != len(views.views) or any(
        np.abs(a.to_world - b.to_world).max() > 1e-6 for a, b in zip(found, views.views, strict=True)
    ):
        raise InputError(f"{folder}: transforms_test.json: not the cameras of {views.path}; make it again")
    light = np.float32(2.0**exposure)
    return [
        np.concatenate(
            [
                view.image * light,
                (np.ones_like(view.image[..., 0]) if view.alpha is None else view.alpha)[..., None],
            ],
            axis=-1,
        )
        for view in found
    ]


def _write_sheet(
    path: Path,
    ours: Sequence[np.ndarray],
    truth: Sequence[np.ndarray],
    scale: Sequence[float] | None,
    background: np.ndarray,
    scene: TrainedScene,
) -> None:
    """Ours after the scale beside the truth, or all frames; the light across the foot."""
    assert scene.light is not None
    if truth:
        chosen = np.unique(np.linspace(0, len(ours) - 1, SHEET_VIEWS).round().astype(int))
        rows = [
            {
                "relit": shown(ours[i], background),
                "relit, scaled a channel": shown(ours[i], background, np.array(scale)),
                "path traced": shown(truth[i], background),
            }
            for i in chosen
        ]
    else:
        frames = [shown(picture, background) for picture in ours]
        parts = [frames[i : i + SHEET_COLUMNS] for i in range(0, len(frames), SHEET_COLUMNS)]
        rows = [
            {f"{i * SHEET_COLUMNS + j}": frame for j, frame in enumerate(part)}
            for i, part in enumerate(parts)
        ]
    tensor = scene.light.radiance()
    panorama = pictures.lights(np.array(tensor, dtype=np.float32).reshape(tensor.shape))
    write_png(path, pictures.sheet(rows, {"light": next(iter(panorama.values()))}))
