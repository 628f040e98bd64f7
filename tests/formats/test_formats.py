"""The registry of formats, `refgs export --to`, and cameras around a scene."""

import json
import shutil
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.cli import main
from mi_refgs.formats import FORMATS, Format, Option
from mi_refgs.formats.orbits import shots_around, turntable_cameras
from mi_refgs.io.ownership import MARK
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.reconstruction.provenance import Provenance
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.surfels.table import Surfels
from tests.helpers import refused


@pytest.fixture
def plain() -> Iterator[list[Any]]:
    """A format `plain` with an option `level`, and what its `write` was called with."""
    calls: list[Any] = []

    def put(trained: TrainedScene, target: Path, shots: Any, level: int) -> list[Path]:
        calls.append((trained, target, shots, level))
        target.write_text(str(level))
        return [target]

    FORMATS.register(Format("plain", "a number", ".txt", put, (Option("level", 3, "the number"),)))
    yield calls
    FORMATS.unregister("plain")


def test_registered_format_is_a_choice_of_the_command(
    plain: list[Any], finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "number.txt"
    assert main(["export", str(finished), "--to", "plain", "-o", str(target), "--level", "7", "--json"]) == 0
    assert target.read_text() == "7"
    assert json.loads(capsys.readouterr().out)["files"] == [str(target)]
    trained, _, shots, _ = plain[0]
    assert trained.surfels.count > 0 and [shot.split for shot in shots] == ["test"] * 2 + ["train"] * 3
    assert main(["export", "--help"]) == 0
    assert "plain         a number" in capsys.readouterr().out
    assert main(["export", str(finished), "--to", "plain", "-o", str(target), "--level", "0"]) == 0
    assert target.read_text() == "0"  # given, and no default


def test_several_formats_are_written_into_a_folder(plain: list[Any], finished: Path, tmp_path: Path) -> None:
    """Their names are separated by commas and blanks."""
    names = "plain,cameras, exr, 3dgs-ply, gltf-splats,"
    assert main(["export", str(finished), "--to", names, "-o", str(tmp_path / "out")]) == 0
    files = {path.name for path in (tmp_path / "out").iterdir()}
    assert files == {MARK, "plain.txt", "cameras", "exr.exr", "3dgs-ply.ply", "gltf-splats.glb"}
    assert (tmp_path / "out" / "plain.txt").read_text() == "3"
    assert (tmp_path / "out" / "cameras" / "transforms.json").is_file()
    for _ in range(2):  # a folder again
        assert main(["export", str(finished), "--to", "cameras", "-o", str(tmp_path / "one")]) == 0
    assert (tmp_path / "one" / "transforms.json").is_file() and not (tmp_path / "one" / "cameras").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--to", "gif", "-o", "OUT"], "--to: 'gif' is unknown; use 3dgs-ply or "),
        (["--to", "plain"], "--to: names no file; say with -o"),
        (["--level", "3"], "--level: belongs to a format; name it with --to"),
        (
            ["--to", "cameras", "--level", "3", "-o", "OUT"],
            "--level: no option of cameras; leave it out, or choose a format that has it (plain)",
        ),
        (["--to", "plain", "-o", "OUT.ply"], "suffix: plain writes .txt"),
        (["--to", "exr", "-o", "OUT.exr", "--view", "9"], "exr: --view: 9 is out of range; give 0 to 4"),
        (["--to", "gltf-mesh", "-o", "OUT.glb", "--faces=3"], "--faces: 3 is out of range"),
    ],
)
def test_bad_export_arguments_are_refused(
    plain: list[Any], finished: Path, tmp_path: Path, arguments: list[str], message: str
) -> None:
    words = [word.replace("OUT", str(tmp_path / "out")) for word in arguments]
    refused(["export", finished, *words], message)


def test_splats_need_no_test_images(
    run: Path, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = shutil.copytree(data, tmp_path / "data")
    for path in other.glob("test/r_*"):
        path.unlink()
    refused(lambda: Provenance.of(Run(run)).with_data(other).shots(TrainedScene.read(run), "test"), "missing")
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        target = tmp_path / "splats.ply"
        assert main(["export", str(run), "--data", str(other), "--to", "3dgs-ply", "-o", str(target)]) == 0
    said = capsys.readouterr().err.splitlines()
    assert target.is_file() and any(x.startswith("refgs: warning: test views are left out: ") for x in said)


@pytest.mark.parametrize("record", [None, '{"path": "gone"}'])
def test_run_without_data_has_cameras_around_its_surfels(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], record: str | None
) -> None:
    (run / "dataset.json").unlink()
    if record is not None:
        (run / "dataset.json").write_text(record)
    trained = TrainedScene.read(run)
    shots = Provenance.of(Run(run)).shots(trained, "test", "train")
    assert len(shots) == 64 and shots[0].split == "test"
    position = trained.surfels.to_numpy()["position"]
    for shot in shots[::7]:
        pose = shot.camera.pose()
        local = (position - pose[:3, 3]) @ pose[:3, :3]
        pixel = np.abs(local[:, :2] / local[:, 2:]) * abs(shot.camera.fx[0])
        assert np.mean((pixel < shot.camera.width / 2).all(axis=1) & (local[:, 2] > 0)) > 0.9
    assert main(["export", str(run)]) == 0
    assert ("gone" in (record or "")) == ("is gone; cameras are around" in capsys.readouterr().err)
    refused(["export", run, "--data", tmp_path / "none"], "--data")
    shutil.rmtree(run / "checkpoints")
    (run / "model.json").unlink()
    refused(["export", run], "checkpoints: none yet")


@pytest.mark.parametrize("mesh", [False, True])
def test_turntable_ignores_outliers(finished: Path, mesh: bool) -> None:
    """One distant surfel or vertex does not change the point that the cameras look at."""
    trained = TrainedScene.read(finished)
    cameras = [shot.camera for shot in shots_around(trained.surfels)]
    position = trained.surfels.to_numpy()["position"]
    places = []
    for x in (position[0, 0], 300):
        position[0, 0] = x
        moved = replace(trained, surfels=Surfels(trained.surfels.raw | {"position": mi.TensorXf(position)}))
        if mesh:
            moved = replace(trained, mesh=Mesh(position.copy(), np.zeros((0, 3), np.uint32), 0.1))
        places.append([camera.pose()[:3, 3] for camera in turntable_cameras(moved, cameras, 3)])
    np.testing.assert_allclose(places[1], places[0], atol=0.1)
