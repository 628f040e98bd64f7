"""A repeated command does what its options say, or refuses and names the option that cannot change."""

import dataclasses
import json
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from mi_refgs import methods
from mi_refgs.cli import main
from mi_refgs.data.dataset import read_dataset
from mi_refgs.errors import InputError
from mi_refgs.fitting.runner import Progress
from mi_refgs.fitting.train import Trainer
from mi_refgs.io.files import BusyError
from mi_refgs.reconstruction import fit as reconstruct
from mi_refgs.runs.run import LOCK, Run
from tests.helpers import contents, read_exr, refused
from tests.scenes.sphere import SCENE
from tests.scenes.tiny import METHOD, SETTINGS, train_command


def test_a_fit_resumes_with_its_own_options(run: Path, data: Path, method: Path, tmp_path: Path) -> None:
    """Options that say what a run was started with are no others, in other words too."""
    argv = [*train_command(data, run, method, "--resume"), "data.downscale=1"]
    state, config = contents(run / "checkpoints"), Run(run).method()
    for more in ([], ["--method", str(config.file)], ["--preset", "quick"]):
        assert main([*argv, *more]) == 0
    assert main([*argv[:4], "--resume", "--set", "data.downscale=1"]) == 0  # other keys are the run's
    assert main([*argv[:4], "--resume"]) == 0 and contents(run / "checkpoints") == state
    other = tmp_path / "twin" / method.name  # of the same name
    other.parent.mkdir()
    other.write_text(f"{METHOD}[rates]\ndecay = 0.25\n")
    changes = {
        "--method": (other, "rates.decay"),
        "--preset": ("standard", "preset"),
        "--set": ("loss.ssim=0.4", "loss.ssim.weight"),
    }
    for option, (value, key) in changes.items():
        refused([*argv, option, value], f"config.toml: {key}: the run was started with")
    lit = [*argv[:4], "--resume", "--light", str(data / "environment.exr")]
    refused(lit, "config.toml: light.file: the run was started with None")
    longer = dataclasses.replace(config, iterations=500)
    again = lambda: reconstruct.fit(data, longer, output=run, resume=True, progress=Progress())  # noqa: E731
    refused(again, "iterations: the run was started with 6", " 500")
    black = read_dataset(data, "train", background="black")
    refused(lambda: reconstruct.fit(black, output=run, resume=True), "data.background: the run was started")
    assert contents(run / "checkpoints") == state
    moved = shutil.copytree(data, tmp_path / "moved")
    assert main(["train", str(moved), "-o", str(run), "--resume"]) == 0
    assert str(moved) in (run / "dataset.json").read_text()


def test_a_data_set_is_completed_or_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, out = tmp_path / "scene.xml", tmp_path / "out"
    scene.write_text(SCENE)
    argv = ["dataset", "--views", "2", "--test-views", "1", "--size", "4", "--samples", "1"]
    argv += ["-o", str(out), str(scene)]
    assert main([*argv, "--json"]) == 0 and json.loads(capsys.readouterr().out)["train_views"] == 2
    before = contents(out)
    for option in (["--views", "3"], ["--seed", "1"], ["--fov", "30"]):
        refused([*argv, *option], option[0])
    assert main(argv) == 0 and contents(out) == before
    assert main([*argv, "--overwrite", "--views", "3"]) == 0 and (out / "train/r_002.png").is_file()


def test_eval_and_render_do_not_depend_on_earlier_ones(finished: Path, tmp_path: Path) -> None:
    used, fresh = (Path(shutil.copytree(finished, tmp_path / name)) for name in ("used", "fresh"))
    results = []
    for run, samples in ((used, "1"), (used, "4"), (fresh, "4")):
        assert main(["eval", str(run), "--samples", samples]) == 0
        assert main(["render", str(run), "-o", str(run / "a.exr"), "--samples", samples]) == 0
        found = json.loads((run / "metrics.json").read_text())
        results.append((found["psnr"], found["samples"], (run / "a.exr").read_bytes()))
    assert results[0] != results[1] == results[2]


def test_cameras_far_from_the_origin_see_the_run_that_is_relative_to_them(run: Path, tmp_path: Path) -> None:
    """A data set at offsets of survey coordinates is fitted near the origin."""
    offset, own = np.array([5e5, 5.4e6, 300.0]), json.loads((run / "dataset.json").read_text())
    near, far = tmp_path / "near/transforms.json", tmp_path / "far.json"
    assert main(["export", str(run), "--to", "cameras", "-o", str(near.parent)]) == 0
    cameras = json.loads(near.read_text())
    for frame in cameras["frames"]:
        for row, x in zip(frame["transform_matrix"], offset, strict=False):
            row[3] += x
    far.write_text(json.dumps(cameras))
    (run / "dataset.json").write_text(json.dumps(own | {"offset": offset.tolist()}))
    for file, scene in ((near, run), (far, run / "scene.xml")):
        assert main(["render", str(scene), "-o", str(file.with_suffix(".exr")), "--camera", str(file)]) == 0
    images = [read_exr(file.with_suffix(".exr"))["R"] for file in (near, far)]
    np.testing.assert_allclose(images[0], images[1], atol=1e-3)
    assert images[0].max() > 0.1


HOLD = """
import fcntl, sys
file = open(sys.argv[1], "a")
fcntl.flock(file, fcntl.LOCK_EX)
print("held", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def live(run: Path) -> Iterator[tuple[Path, subprocess.Popen[str]]]:
    """A run that another process changes, whose artefacts are older than its checkpoint."""
    model = json.loads((run / "model.json").read_text())
    (run / "model.json").write_text(json.dumps(model | {"iteration": 3}))
    argv = [sys.executable, "-c", HOLD, str(run / LOCK)]
    with subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        yield run, process
        process.kill()


def test_second_process_on_a_run_is_refused(
    live: tuple[Path, subprocess.Popen[str]], data: Path, method: Path, tmp_path: Path
) -> None:
    """Commands that change the run are refused, those that look at it read the newest checkpoint."""
    run, process = live
    argv = train_command(data, run, method, "--resume")
    before = contents(run)
    for command in (argv, ["export", str(run)], ["export", str(tmp_path / "run"), "-o", str(run)]):
        refused(command, "another process trains this run", run)
    assert contents(run) == before
    (run / "scene.xml").unlink()  # as in a first fit
    scene = reconstruct.load(run)
    assert scene.trained.iteration == 6
    for command in (
        ["eval", str(run)],
        ["render", str(run), "-o", str(tmp_path / "a.exr")],
        ["export", str(run), "-o", str(tmp_path / "copy")],
    ):
        assert main(command) == 0
    assert not (run / "scene.xml").exists() and (run / "metrics.json").is_file()
    expected = scene.render(0)
    found = read_exr(tmp_path / "a.exr")
    np.testing.assert_allclose(np.stack([found[x] for x in "RGBA"], axis=-1), expected, atol=1e-5)
    assert json.loads((run / "metrics.json").read_text())["iterations"] == 6
    assert json.loads((run / "model.json").read_text())["iteration"] == 3  # nothing is written
    kept = [run / "checkpoints", run / "model.json"]
    for path in kept:
        path.rename(tmp_path / path.name)
    refused(["render", run, "-o", tmp_path / "a.exr"], "none yet; train it with", "or wait for the first")
    for path in kept:
        (tmp_path / path.name).rename(path)
    process.send_signal(signal.SIGKILL)
    process.wait()
    with mock.patch("mi_refgs.runs.export.export", side_effect=InputError("read-only")):
        assert main(["render", str(run), "-o", str(tmp_path / "a.exr")]) == 0
    with mock.patch("mi_refgs.evaluation.evaluate.evaluate", side_effect=OSError(13, "no", "a.png")):
        refused(["eval", run], "no: 'a.png'; check the disk")
    assert main(argv) == 0 and not (run / LOCK).exists()


def test_save_refuses_locked_folder(live: tuple[Path, subprocess.Popen[str]], finished: Path) -> None:
    """Not even before it is a run."""
    run, _ = live
    (run / "config.toml").unlink()
    with pytest.raises(BusyError, match="another process trains this run"):
        reconstruct.load(finished).save(run)


def test_fit_locks_its_run(data: Path, method: Path, tmp_path: Path) -> None:
    """From its first step to its artefacts, against other threads too."""
    run, seen = Run(tmp_path / "run"), []

    def attempt() -> None:
        try:
            with run.alone():
                seen.append("free")
        except BusyError:
            seen.append("busy")

    class Watch(Progress):
        def step(self, trainer: Trainer) -> None:
            thread = threading.Thread(target=attempt)
            thread.start()
            thread.join()

    reconstruct.fit(data, methods.load(str(method), "quick", SETTINGS), output=run.path, progress=Watch())
    assert seen == ["busy"] * 6 and not (run.path / LOCK).exists()
    attempt()
    assert seen[-1] == "free"
    with run.alone(), run.alone():
        pass
