"""Makes a gallery: data, fit, scores and pictures of each exhibit; what is there is not made again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs import methods
from mi_refgs.editing import EditOptions
from mi_refgs.errors import InputError
from mi_refgs.evaluation import evaluate as evaluation
from mi_refgs.evaluation.images import contact_sheet
from mi_refgs.gallery.exhibits import EXHIBITS, Exhibit
from mi_refgs.gallery.frames import write_still, write_turntable
from mi_refgs.gallery.page import DECOMPOSITION, EDITS, RELIT, TURNTABLE, page
from mi_refgs.io.files import is_file, read_json, write_bytes, write_json
from mi_refgs.io.images import read_png
from mi_refgs.io.ownership import OutputFolder
from mi_refgs.io.resources import resource_dir
from mi_refgs.reconstruction.fit import fit
from mi_refgs.reconstruction.new_light import NewLight
from mi_refgs.reconstruction.reconstruction import Reconstruction
from mi_refgs.relighting import relight as relighting
from mi_refgs.relighting.score import shown
from mi_refgs.runs.run import Run
from mi_refgs.synthesis.make_dataset import make_dataset

RECORD, PAGE = "gallery.json", "README.md"
PURPOSE = "relighting"
"""What the method is for, by which the scenes are fitted: its materials hold under another light."""
LIGHT = "sky.exr"
"""The light of scenes/lights that no scene of the gallery is fitted under."""
TEST_VIEWS = 20
SAMPLES = 4
"""Samples a pixel of what is shown, 2 × 2."""
TURN, TURN_SECONDS = 30, 3.0
"""Frames of a turntable, and how long a turn takes."""
EDIT_VIEWS = (0, TEST_VIEWS // 2)
"""Test views that show the edits."""


def make_gallery(
    out: Path,
    work: Path,
    scenes: Sequence[str] = (),
    *,
    views: int = 100,
    size: int = 200,
    preset: str = "standard",
    assignments: Sequence[str] = (),
    progress: bool = False,
    tell: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Make the gallery of some exhibits, or of all, in the folder `out`; returns the content of gallery.json.

    Data sets of `views` training views of `size` pixels a side, and the runs, are made in `work`;
    `assignments` change the method, as in "loss.ssim=0.1". An interrupted gallery is continued by the same
    call, and others of the same settings are added. Raises InputError for an unknown exhibit, a gallery of
    other settings, and a folder that cannot be written.
    """
    names = [*scenes] or [*EXHIBITS]
    for name in names:
        if name not in EXHIBITS:
            raise InputError(f"--scenes: {name}: not in the gallery; use some of {', '.join(EXHIBITS)}")
    settings = {"views": views, "size": size, "preset": preset, "set": [*assignments]}
    found: dict[str, Any] = {}
    if is_file(out / RECORD):
        before = read_json(out / RECORD)
        made = before.get("settings")
        for option, value in settings.items():
            if (was := made.get(option) if isinstance(made, dict) else None) != value:
                raise InputError(
                    f"{out / RECORD}: --{option}: the gallery was made with {was}, not {value}; repeat "
                    "that, or choose another -o"
                )
        found = dict(before["scenes"])
    pictures = (DECOMPOSITION, RELIT, TURNTABLE, EDITS)
    output = OutputFolder(out, "gallery", (RECORD, PAGE, *(f"*/{file}" for file in pictures)), marker=RECORD)
    output.claim(RECORD, PAGE, *(f"{name}/{file}" for name in names for file in pictures))
    for number, name in enumerate(names):
        tell(f"{number + 1} of {len(names)}: {name}")
        run, scores = _fitted(name, work / name, settings, progress)
        found[name] = scores
        _pictures(name, EXHIBITS[name], run, out / name, size)
        record = {"settings": settings, "scenes": {name: found[name] for name in EXHIBITS if name in found}}
        write_json(out / RECORD, record)
        exhibits = {name: EXHIBITS[name] for name in record["scenes"]}
        text = page({"scenes": [*exhibits], **settings}, exhibits, found)
        write_bytes(out / PAGE, text.encode())
    return read_json(out / RECORD)


def _fitted(
    name: str, work: Path, settings: dict[str, Any], progress: bool
) -> tuple[Reconstruction, dict[str, Any]]:
    """The run of an exhibit, evaluated and relit, and its scores; each step only where it is missing."""
    scenes = resource_dir("scenes")
    light = scenes / "lights" / LIGHT
    data = make_dataset(
        scenes / f"{name}.xml",
        work / "data",
        views=settings["views"],
        test_views=TEST_VIEWS,
        size=settings["size"],
        spp=EXHIBITS[name].samples,
        relight=[light],
        progress=progress,
    )
    method = methods.for_purpose(PURPOSE)
    folder = Run(work / "run")
    run = fit(
        data,
        method,
        preset=settings["preset"],
        settings=settings["set"],
        output=folder.path,
        resume=True,
        progress=progress,
    )
    metrics = evaluation.read_metrics(folder)
    if metrics is None or metrics.get("iterations") != run.trained.iteration:
        metrics = evaluation.evaluate(folder, progress=progress)
    record = folder.path / "relight" / Path(LIGHT).stem / relighting.RESULT
    if not is_file(record):
        relighting.relight(folder, NewLight(light), samples=SAMPLES, progress=progress)
    keys = (
        "psnr",
        "normal_mae_deg",
        "albedo_psnr",
        "roughness_mae",
        "metallic_mae",
        "surfels",
        "train_seconds",
    )
    return run, {key: metrics[key] for key in keys} | {"relit_psnr": read_json(record)["psnr_scaled"]}


def _pictures(name: str, exhibit: Exhibit, run: Reconstruction, out: Path, size: int) -> None:
    """Write the pictures of an exhibit that are missing."""
    assert run.folder is not None
    sheets = {
        DECOMPOSITION: run.folder / evaluation.DECOMPOSITION,
        RELIT: run.folder / "relight" / Path(LIGHT).stem / relighting.SHEET,
    }
    for target, source in sheets.items():
        if not is_file(out / target):
            write_still(out / target, read_png(source))
    if not is_file(out / TURNTABLE):
        other = run.relight(resource_dir("scenes") / "lights" / LIGHT)
        frames = [
            np.concatenate([_shown(scene, camera, size) for scene in (run, other)], axis=1)
            for camera in run.turntable(TURN)
        ]
        write_turntable(out / TURNTABLE, frames, TURN_SECONDS)
    if not is_file(out / EDITS):
        made = {"as fitted": run}
        for title, how in exhibit.edits.items():
            options: EditOptions = {**how, "materials": True}
            made[title] = run.edit(**options)
        rows = [{title: _shown(scene, view, size) for title, scene in made.items()} for view in EDIT_VIEWS]
        write_still(out / EDITS, contact_sheet(rows))


def _shown(run: Reconstruction, camera: Any, size: int) -> np.ndarray:
    """A camera's picture (size, size, 3) before white, display-encoded."""
    return shown(run.render(camera, size=size, samples=SAMPLES), np.ones(3))
