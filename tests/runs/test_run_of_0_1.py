"""Runs that version 0.1 wrote (commit 8eaa52b) can be opened, rendered, resumed, measured and exported.

`object` was fitted to RGBA images, up to iteration 6; its checkpoint is of iteration 3. `open` was fitted to
images without alpha, with per-image exposure compensation. The .npz files contain what 0.1 rendered for the
first test view, and relit.npy `object` under a constant light.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mi_refgs
from mi_refgs.runs.run import Run
from tests.scenes.tiny import write_data, write_open_data

STORED = Path(__file__).parent / "run_of_0_1"
TOLERANCE = 2e-5
"""Difference of images: other SIMD widths sum in another order."""


@pytest.fixture(params=["object", "open"])
def run(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A copy of a stored run, and its data set beside it."""
    (write_data if request.param == "object" else write_open_data)(tmp_path / "data")
    folder = tmp_path / str(request.param)
    shutil.copytree(STORED / str(request.param), folder)
    record = json.loads((folder / "dataset.json").read_text())
    (folder / "dataset.json").write_text(json.dumps(record | {"path": str(tmp_path / "data")}))
    return folder


def test_old_run_renders_as_before(run: Path) -> None:
    opened, stored = mi_refgs.load(run), np.load(STORED / f"{run.name}.npz")
    np.testing.assert_allclose(opened.render(0), stored["image"], atol=TOLERANCE)
    for name, values in opened.aovs(0).items():
        np.testing.assert_allclose(values, stored[name], atol=1e-3, err_msg=name)
    if run.name == "object":
        relit = opened.relight(np.full((8, 16, 3), 0.7, np.float32)).render(0)
        np.testing.assert_allclose(relit, np.load(STORED / "relit.npy"), atol=1e-3)


def at_pixel_centres(opened: mi_refgs.Reconstruction) -> np.ndarray:
    """Image of the first test view without antialiasing, as version 0.1 rendered it."""
    plain = replace(opened.trained, shading=replace(opened.trained.shading, antialias=False))
    return opened.changed(plain).render(0)


def test_old_checkpoint_renders_when_artefacts_are_gone(run: Path) -> None:
    for name in ("model.json", "surfels.ply", "scene.xml"):
        (run / name).unlink()
    opened, stored = mi_refgs.load(run), np.load(STORED / f"{run.name}.npz")
    if run.name == "open":  # its checkpoint is that of the end
        np.testing.assert_allclose(at_pixel_centres(opened), stored["image"], atol=TOLERANCE)
    assert opened.trained.iteration == {"object": 3, "open": 6}[run.name]


@pytest.mark.filterwarnings("ignore:.*training views")
def test_old_run_resumes(run: Path, one_thread: None) -> None:
    if run.name == "object":
        (run / "model.json").unlink()
    data = run.parent / "data"
    resumed = mi_refgs.fit(data, output=run, resume=True, progress=False)
    assert resumed.trained.iteration == 6
    stored = np.load(STORED / f"{run.name}.npz")
    np.testing.assert_allclose(at_pixel_centres(resumed), stored["image"], atol=1e-3)
    with pytest.raises(mi_refgs.InputError, match="preset"):
        mi_refgs.fit(data, output=run, resume=True, preset="paper", progress=False)


def test_old_run_is_measured_and_exported(run: Path, tmp_path: Path) -> None:
    opened = mi_refgs.load(run)
    numbers = opened.evaluate()
    expected = {"object": (11.740999, 0.572974), "open": (13.001436, 0.487608)}[run.name]
    np.testing.assert_allclose((numbers["psnr"], numbers["ssim"]), expected, atol=1e-3)
    assert numbers["exposure"] == (None if run.name == "object" else opened_decision(run))
    (written,) = opened.export("3dgs-ply", tmp_path / "splats.ply")
    assert written.stat().st_size > 1000
    saved = opened.save(tmp_path / "saved")
    np.testing.assert_array_equal(saved.render(0), opened.render(0))
    assert Run(run).method().iterations == 6


def opened_decision(run: Path) -> dict[str, object]:
    """The decision of exposure.json."""
    record: dict[str, object] = json.loads((run / "exposure.json").read_text())
    return {name: value for name, value in record.items() if name != "gain"}
