"""A run folder made of another one by an edit: its artefacts, and no checkpoints.

    config.toml, dataset.json    those of the run
    surfels.ply, scene.xml, …    what `runs.export` writes
    edit.json                    this edit and those before it
    preview.png                  views before and after, if asked for

It appears whole or not at all; the run is only read.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np

from mi_refgs.data.dataset import Dataset
from mi_refgs.editing.edit import Edited
from mi_refgs.errors import InputError
from mi_refgs.evaluation import pictures
from mi_refgs.evaluation.evaluate import load_split
from mi_refgs.files import cannot_write, read_json
from mi_refgs.images import write_png
from mi_refgs.occlusion.mesh import read_mesh
from mi_refgs.render.display import displayed
from mi_refgs.runs.export import MESH, MODEL, SCENE, TrainedScene, export, load_if_newer
from mi_refgs.runs.run import DATASET, Run
from mi_refgs.splat import Camera

RECORD, PREVIEW = "edit.json", "preview.png"
PREVIEW_VIEWS = 4
"""Rows of the preview, spread evenly over the test views."""
WHITE = np.ones(3, np.float32)


def read_scene(run: Run) -> TrainedScene:
    """What a run holds, of its newest checkpoint where the artefacts are older; writes nothing.

    A mesh that only other programs use comes along, too. Raises InputError as `TrainedScene.read` does.
    """
    fresh = load_if_newer(run, run.method())
    if fresh is not None:
        return fresh
    if not (run.path / MODEL).is_file():
        raise InputError(f"{run.path}: {MODEL}: missing; write it with `refgs export {run.path}`")
    scene, mesh = TrainedScene.read(run.path), run.path / MESH
    return replace(scene, mesh=read_mesh(mesh)) if scene.mesh is None and mesh.is_file() else scene


def scene_camera(run: Run, data: Path | None = None) -> Camera:
    """The camera of a run's scene.xml; of its first test view where there is none.

    Raises InputError if there is neither.
    """
    path = run.path / SCENE
    if not path.is_file():
        return load_split(run, run.method(), "test", data).views[0].camera()
    try:
        sensor = ElementTree.parse(path).getroot().find("sensor")
        assert sensor is not None
        text = ElementTree.tostring(sensor, encoding="unicode").replace("$spp", "1")
        scene: Any = mi.load_string(f'<scene version="3.0.0">{text}</scene>')
    except (ElementTree.ParseError, AssertionError, RuntimeError) as error:
        raise InputError(
            f"{path}: sensor: cannot be read; write it again with `refgs export {run.path}`"
        ) from error
    return Camera.from_sensor(scene.sensors()[0])


def write_edited(
    run: Run, edited: Edited, out: Path, record: dict[str, Any], preview: Any = None, data: Path | None = None
) -> dict[str, Any]:
    """Write the edited scene as a run folder; returns the content of edit.json's last edit.

    `record` says what was asked for; `preview` is a picture (H, W, 3), if there is one. Raises InputError for
    a folder that holds something already or cannot be written.
    """
    require_free(out)
    camera = scene_camera(run, data)
    entry = record | {
        "run": str(run.path.resolve()),
        "selected": edited.selected,
        "of": edited.of,
        "surfels": edited.scene.surfels.count,
        "notes": list(edited.notes),
    }
    before = run.path / RECORD
    edits = read_json(before).get("edits", []) if before.is_file() else []
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".tmp", dir=out.parent))
    except OSError as error:
        raise cannot_write(out, error) from error
    try:
        temporary.chmod(0o755)
        made = Run(temporary)
        made.write_method(run.method())
        if (run.path / DATASET).is_file():
            shutil.copyfile(run.path / DATASET, temporary / DATASET)
        if preview is not None:
            write_png(temporary / PREVIEW, preview)
        made.write_json(RECORD, {"edits": [*edits, entry]})
        export(edited.scene, temporary, camera)
        os.replace(temporary, out)
    except OSError as error:
        raise cannot_write(out, error) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return entry


def require_free(out: Path) -> None:
    """Raise InputError unless a folder can be made there: nothing stands there, or an empty one."""
    try:
        taken = os.path.lexists(out) and not (out.is_dir() and not any(out.iterdir()))
    except (OSError, ValueError) as error:
        raise cannot_write(out, error) from error
    if taken:
        raise InputError(f"{out}: output: stands there already; choose another -o")


def test_views(run: Run, data: Path | None) -> Dataset | None:
    """The test views, where the data is still there or named; raises InputError for a `data` without any."""
    try:
        return load_split(run, run.method(), "test", data)
    except InputError:
        if data is not None:
            raise
        return None


def before_and_after(
    before: TrainedScene, after: TrainedScene, views: Dataset | None, camera: Camera
) -> np.ndarray:
    """Test views before and after beside each other, (H, W, 3) display-encoded; without views, `camera`."""
    if views is None:
        cameras, background, linear = [camera], WHITE, False
    else:
        some = np.unique(np.linspace(0, len(views.views) - 1, PREVIEW_VIEWS).round().astype(int))
        cameras = [views.views[i].camera() for i in some]
        background, linear = views.background, views.linear
    renderers = {"before": before.renderer(aovs=False), "after": after.renderer(aovs=False)}
    rows: list[dict[str, np.ndarray]] = []
    for camera in cameras:
        shots = {title: displayed(view(camera), background, linear) for title, view in renderers.items()}
        size = camera.height, camera.width
        rows.append({title: np.clip(pictures.planes(x, *size), 0, 1) for title, x in shots.items()})
    return pictures.sheet(rows)
