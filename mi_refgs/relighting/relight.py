"""Relighting: the pictures of a trained scene under another light, its scene.xml, its score, a sheet.

A folder of it holds

    test/r_000.png, .exr    the test views as a data set has them: straight sRGB, premultiplied linear RGBA
    turntable/t_000.png     or these, of cameras around the object
    scene.xml, surfels.ply, envmap.exr, mesh.ply, model.json    what `mi.load_file` renders alike
    relight.json            the settings, and the score where the data set has the truth under this light
    sheet.png               ours beside the truth, or the frames; and the light
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.data.dataset import BACKGROUNDS, Dataset, read_dataset
from mi_refgs.errors import InputError
from mi_refgs.evaluation import images
from mi_refgs.formats.orbits import turntable_cameras
from mi_refgs.io.exr import write_exr
from mi_refgs.io.files import write_json
from mi_refgs.io.images import straight_srgb, write_png
from mi_refgs.io.ownership import OutputFolder
from mi_refgs.methods.method import Method
from mi_refgs.progress import with_bar
from mi_refgs.reconstruction.new_light import NewLight, truth_under
from mi_refgs.reconstruction.provenance import Provenance
from mi_refgs.relighting.score import score, shown
from mi_refgs.render.pipeline import Frame
from mi_refgs.render.samples import samples_per_axis
from mi_refgs.runs.export import export, up_to_date
from mi_refgs.runs.relightable import relightable
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import ARTEFACTS, TrainedScene
from mi_refgs.splat import Camera

SHEET, RESULT = "sheet.png", "relight.json"
SHEET_VIEWS = 4
"""Rows of the sheet, spread evenly over the test views."""
SHEET_COLUMNS = 6
"""Frames of a turntable in a row of its sheet."""
NO_TRUTH = "the data set has no test views under this light; make them with `refgs dataset --relight`"
NO_DATA = "no data set is there, so cameras are around the object; name its folder with --data"


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

    `out` is RUN/relight/NAME by default, with the rotation and the exposure in its name if they are set, and
    with a number if another map of this name is there.

    The scene becomes materials alone (`runs.relightable`): diffuse light is the new light's irradiance, with
    the mesh's shadows and bounces; mirrors are traced. The views are the test views of the run's data set,
    or of `data`; with `turntable`, so many cameras on a circle around the object instead. Without a data set
    both are of cameras around the object (`Provenance.shots`). If the data set has the truth under this light
    (`truth_under`), the test views are compared with it.

    Raises InputError for a run without light or materials, a light or a data set that cannot be read, and a
    folder that cannot be written or holds a run, the pictures of another light, or foreign files of these
    names.
    """
    if turntable < 0:
        raise InputError(f"--turntable: {turntable} is out of range; give a number of views from 1")
    source = Provenance.of(run).with_data(data)
    views = source.views("test") if source.has_data else None
    asked = light
    known = None if turntable or views is None else truth_under(light, views.path)
    light = light if known is None else known[1]

    def cameras_of(trained: TrainedScene) -> list[Camera]:
        if views is None:
            return [shot.camera for shot in source.shots(trained, "test")]
        return [view.camera() for view in views.views]

    fitted = up_to_date(run, source.method, lambda trained: cameras_of(trained)[0])
    try:
        scene = replace(relightable(fitted), light=light.read())
    except InputError as error:
        raise InputError(f"{run.path}: {error}") from error
    name = light.path.parent.name if known is not None else light.path.stem
    output = _own_folder(run, f"{name}{light.suffix}", asked) if out is None else _output(run, out, asked)
    out = output.path
    cameras = cameras_of(fitted)
    if turntable:
        region = source.region if views is None else views.region
        region = None if fitted.surroundings is None else region
        cameras = turntable_cameras(scene, cameras, turntable, region)
    kind = "turntable" if turntable else "test"
    _prepare(output, kind, len(cameras))
    export(scene, out, cameras[0], output=output)
    ours = _render(scene, cameras, out / kind, samples, progress)
    colour = BACKGROUNDS[source.method.data.background]
    background = np.full(3, colour, np.float32) if views is None else views.background
    reason = "a turntable has no truth" if turntable else NO_TRUTH

    result: dict[str, Any] = {
        "run": str(run.path),
        "output": str(out),
        "light": str(light.path),
        "rotate": light.rotate,
        "exposure": light.exposure,
        "pictures": [f"{kind}/{i}" for i in _names(kind, len(cameras))],
        "samples": samples_per_axis(samples) ** 2,
        "psnr": None,
        "psnr_scaled": None,
        "score_reason": NO_DATA if views is None else reason,
    }
    truth: list[np.ndarray] = []
    if known is not None and views is not None:
        truth = _truth(source.method, known[0], light.exposure, views)
        result |= score([view.name for view in views.views], ours, truth, background)
        result["score_reason"] = None
    _write_sheet(out / SHEET, ours, truth, result.get("scale"), background, scene)
    write_json(out / RESULT, result)
    warning = ""
    if fitted.shading.diffuse == "sh":
        warning = (
            f"{run.path}: its diffuse part was fitted as a colour; the albedo is that colour over the "
            "irradiance of the fitted light, and what that explains badly stays in it; "
            "`refgs train --for relighting` fits materials"
        )
    return Relit(result, warning)


def _output(run: Run, out: Path, light: NewLight) -> OutputFolder:
    """The folder `out` for the pictures of a run under a light."""
    here = out.resolve().is_relative_to(run.path.resolve())  # the run and its folder may then move together
    of = "" if here else f" of {run.path.resolve()}"
    return OutputFolder(out, f"relight {light.identity}{of}", remedy="choose another -o")


def _own_folder(run: Run, name: str, light: NewLight) -> OutputFolder:
    """RUN/relight/NAME, or the first of NAME_2, NAME_3, … that holds nothing of another light."""
    numbered = itertools.chain([name], (f"{name}_{number}" for number in itertools.count(2)))
    outputs = (_output(run, run.path / "relight" / folder, light) for folder in numbered)
    return next(o for o in outputs if o.owner in o.owners().values() or not o.path.exists())


def _prepare(output: OutputFolder, kind: str, count: int) -> None:
    """Remove the pictures of the last call for the same light, and claim the names of those to come."""
    out = output.path
    if (out / "config.toml").exists() or any(out.glob("transforms*.json")):
        raise InputError(
            f"{out}: output: holds a run or a data set, whose files would be replaced; choose another -o"
        )
    images = [f"{kind}/{name}" for name in _names(kind, count)]
    names = [*images, *(f"{Path(name).with_suffix('.exr')}" for name in images), RESULT, SHEET]
    output.require_free([*names, *ARTEFACTS])
    stale = output.owned(f"{kind}/{_letter(kind)}_*.*")  # of more views, or another data set
    output.remove(path.relative_to(out).as_posix() for path in stale)
    output.claim(*names)


def _names(kind: str, count: int) -> list[str]:
    return [f"{_letter(kind)}_{i:03d}.png" for i in range(count)]


def _letter(kind: str) -> str:
    """With which the names of pictures begin; test views have the names of a data set."""
    return "r" if kind == "test" else kind[0]


def _render(
    scene: TrainedScene, cameras: Sequence[Camera], folder: Path, samples: int, progress: bool
) -> list[np.ndarray]:
    """Premultiplied linear RGBA (H, W, 4) of the cameras, written as a data set has them."""
    renderer: Callable[[Camera], Frame] = scene.renderer(aovs=False, samples=samples)
    names = _names(folder.name, len(cameras))
    jobs = list(zip(names, cameras, strict=True))
    found = []
    for name, camera in with_bar(jobs, "relight", unit="view", disable=not progress):
        frame = renderer(camera)
        rgba = images.image_array([*frame.radiance, frame.alpha], camera.height, camera.width)
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
        for view in (view.load() for view in found)
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
    panorama = images.light_panels(np.array(tensor, dtype=np.float32).reshape(tensor.shape))
    write_png(path, images.contact_sheet(rows, {"light": next(iter(panorama.values()))}))
