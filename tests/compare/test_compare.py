"""Comparisons: jobs that resume, rows that say why they failed, tables whose arithmetic is written here."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from mi_refgs.cli import main
from mi_refgs.compare import execute, jobs
from mi_refgs.compare.jobs import Job
from mi_refgs.compare.table import write
from mi_refgs.data.dataset import read_dataset
from mi_refgs.fitting import decide
from mi_refgs.io.ownership import RUN, own_folder
from mi_refgs.runs.run import DECISIONS, Run
from mi_refgs.runs.views import digests
from tests.helpers import refused
from tests.scenes.tiny import SETTINGS, write_open_data

Paths = tuple[Path, Path]
SIX = [setting for setting in SETTINGS if "preview" not in setting]


def command(data: Path, folder: Path, *variants: Path, more: tuple[str, ...] = ()) -> list[str]:
    """Arguments of `refgs compare` for tiny methods."""
    options = ["--preset", "quick", "--threads", "1", "--methods", *map(str, variants)]
    return ["compare", str(data), "-o", str(folder), *options, *more, "--set", *SIX]


@pytest.fixture(scope="module")
def variants(method: Path) -> Paths:
    """The tiny method, and one that deviates from it and stands for a row of the paper."""
    second = method.with_name("other.toml")
    about = '[about]\nname = "Other"\npaper_row = "2DGS"\ndeviations = ["a <and> no scene", "six steps"]\n'
    second.write_text(f'extends = "tiny.toml"\n{about}[rates]\ndecay = 0.5\n')
    return method, second


@pytest.fixture(scope="module")
def compared(data: Path, variants: Paths, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A comparison in which one of four jobs failed; do not change it."""
    folder = tmp_path_factory.mktemp("compared")
    broken = folder / "runs" / "ball" / "tiny" / "seed1"
    own_folder(folder, "compare")
    own_folder(broken, RUN)
    (broken / "checkpoints").write_text("in the way")
    assert main(command(data, folder, *variants, more=("--seeds", "0,1", "--workers", "2"))) == 3
    return folder


def test_comparison_has_a_run_per_job(compared: Path) -> None:
    for variant, seed in (("tiny", 0), ("other", 0), ("other", 1)):
        run = Run(compared / "runs" / "ball" / variant / f"seed{seed}")
        assert run.method().seed == seed and run.method().iterations == 6


def test_failed_job_is_a_row_with_its_reason(compared: Path) -> None:
    [scene] = json.loads((compared / "table.json").read_text())["scenes"]
    tiny, other = scene["rows"]
    assert tiny["variant"] == "tiny" and tiny["seeds"] == [0] and list(tiny["failed"]) == ["1"]
    assert "seed1/checkpoints: output: cannot be created" in tiny["failed"]["1"]
    assert other["seeds"] == [0, 1] and not other["failed"]
    failed = f"tiny, seed 1: failed: {tiny['failed']['1']}"
    about = json.loads((compared / "compare.json").read_text())
    for said in (failed, "a <and> no scene", "llvm_ad_rgb", "jobs at once", about["command"]):
        assert said in (compared / "table.md").read_text(), said


def test_numbers_are_means_over_the_runs(compared: Path) -> None:
    [scene] = json.loads((compared / "table.json").read_text())["scenes"]
    other, runs = scene["rows"][1], compared / "runs/ball/other"
    metrics = [json.loads((runs / seed / "metrics.json").read_text()) for seed in ("seed0", "seed1")]
    values = [found["psnr"] for found in metrics]
    number = other["numbers"]["psnr"]
    assert number["values"] == values and values[0] != values[1]
    assert number["mean"] == pytest.approx((values[0] + values[1]) / 2)
    assert number["sd"] == pytest.approx(abs(values[0] - values[1]) / 2**0.5)
    assert (other["numbers"]["lpips"] is None) == any(found.get("lpips") is None for found in metrics)


def test_jobs_run_once(compared: Path, data: Path, variants: Paths, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(execute, "_process", lambda *_: pytest.fail("a finished job was begun again"))
    assert main(command(data, compared, variants[1], more=("--seeds", "0,1"))) == 3


def test_an_interrupted_job_resumes(compared: Path, data: Path, variants: Paths, tmp_path: Path) -> None:
    """With one thread the resumed run is the straight one; what came after the checkpoint is done again."""
    done = compared / "runs" / "ball" / "other" / "seed0"
    run = tmp_path / "runs" / "ball" / "other" / "seed0"
    own_folder(tmp_path, "compare")
    shutil.copytree(done, run)
    (run / "checkpoints" / "0000006.npz").unlink()
    for name in ("metrics.json", "surfels.ply", "model.json"):
        (run / name).unlink()
    assert main(command(data, tmp_path, variants[1])) == 0
    for name in ("surfels.ply", "envmap.exr"):
        assert (run / name).read_bytes() == (done / name).read_bytes(), name


def test_job_is_finished_with_metrics_of_last_checkpoint(compared: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(compared / "runs" / "ball" / "other" / "seed0", tmp_path / "run")
    job = Job(**(json.loads((folder / "job.json").read_text()) | {"folder": str(folder)}))
    assert jobs.finished(job)
    metrics = json.loads((folder / "metrics.json").read_text())
    (tmp_path / "link").symlink_to(job.data)
    (folder / "metrics.json").write_text(json.dumps(metrics | {"dataset": str(tmp_path / "link")}))
    assert jobs.finished(job)
    changes: tuple[dict[str, object], ...] = ({"iterations": 3}, {"dataset": "elsewhere"}, {"samples": 9})
    older = {name: value for name, value in metrics.items() if name != "ssim"}  # of another version
    for text in (*(json.dumps(metrics | change) for change in changes), json.dumps(older), "{"):
        (folder / "metrics.json").write_text(text)
        assert not jobs.finished(job)
    (folder / "metrics.json").write_text(json.dumps(metrics))
    assert jobs.finished(job)
    (folder / "checkpoints" / "0000006.npz").unlink()
    assert not jobs.finished(job)


def test_crash_is_retried_and_becomes_a_row(
    data: Path, variants: Paths, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each worker process dies of a segmentation fault before it does anything."""
    crash = tmp_path / "crash"
    crash.mkdir()
    (crash / "sitecustomize.py").write_text(
        "import os, sys\nif 'mi_refgs.compare.worker' in sys.orig_argv:\n"
        f"    open({str(tmp_path / 'began')!r}, 'a').write('x')\n    os.kill(os.getpid(), 11)\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(crash))
    assert main(command(data, tmp_path / "out", variants[0])) == 3
    [scene] = json.loads((tmp_path / "out" / "table.json").read_text())["scenes"]
    assert "SIGSEGV 3 times" in scene["rows"][0]["failed"]["0"]
    assert (tmp_path / "began").read_text() == "x" * (1 + execute.RETRIES)


def test_worker_ends_with_its_parent() -> None:
    """It ends when its standard input closes."""
    code = (
        "import os, time\nfrom mi_refgs.compare import worker\nimport threading\n"
        "threading.Thread(target=worker._end_with_parent, daemon=True).start()\ntime.sleep(60)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE)
    assert process.stdin is not None
    process.stdin.close()
    assert process.wait(30) == -15


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["{data}/none", "--methods", "{tiny}", "-o", "{out}"], ["no such folder"]),
        (["{data}", "{twin}", "--methods", "{tiny}", "-o", "{out}"], ["'ball' is given twice"]),
        (["{data}", "--methods", "{tiny}", "--seeds", "0,x", "-o", "{out}"], ["--seeds", "0,x"]),
        (["{data}", "--methods", "{tiny}", "--seeds=-1", "-o", "{out}"], ["--seeds", "-1"]),
        (["{data}", "--methods", "{tiny}", "--set", "seed=2", "-o", "{out}"], ["--seeds"]),
        (["{data}", "--methods", "{tiny}", "--workers", "0", "-o", "{out}"], ["--workers"]),
    ],
)
def test_bad_input_is_refused(
    arguments: list[str], words: list[str], data: Path, variants: Paths, tmp_path: Path
) -> None:
    (tmp_path / "twin").mkdir()
    os.symlink(data, tmp_path / "twin" / "ball")
    names = {"data": data, "twin": tmp_path / "twin" / "ball", "tiny": variants[0], "out": tmp_path / "out"}
    refused(["compare", *(argument.format(**names) for argument in arguments)], *words)
    assert not (tmp_path / "out").exists()


def test_different_sizes_are_refused(compared: Path, data: Path, variants: Paths, tmp_path: Path) -> None:
    """Before anything is fitted: two methods, or one and existing runs; and existing runs."""
    smaller = tmp_path / "smaller.toml"
    smaller.write_text(f'extends = "{variants[0]}"\n[data]\ndownscale = 2\n')
    copy = shutil.copytree(compared, tmp_path / "copy")
    for folder, chosen in ((tmp_path / "new", (variants[0], smaller)), (copy, (smaller,))):
        refused(command(data, folder, *chosen), "20 × 20", "10 × 10", "smaller")
        assert not (folder / "runs/ball/smaller").exists()
    photographs = write_open_data(tmp_path / "open")  # are scored at one size
    assert jobs.plan(tmp_path / "new", [photographs], [str(variants[0]), str(smaller)], [0], preset="quick")
    metrics = copy / "runs/ball/other/seed1/metrics.json"
    metrics.write_text(json.dumps(json.loads(metrics.read_text()) | {"image_size": [10, 10]}))
    refused(["compare", "-o", copy], "20 × 20", "10 × 10", "runs/ball/other/seed1")


def test_a_run_refuses_other_settings(compared: Path, data: Path, variants: Paths, tmp_path: Path) -> None:
    """With compare.json and without it."""
    folder = shutil.copytree(compared, tmp_path / "copy")
    refused([*command(data, folder, variants[1]), "loss.ssim=0.1"], "compare.json", "--set", "loss.ssim=0.1")
    (folder / "compare.json").unlink()
    refused([*command(data, folder, variants[1]), "loss.ssim=0.1"], "loss.ssim", "config.toml")


def test_unreadable_run_is_a_failed_row(compared: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(compared, tmp_path / "copy")
    (folder / "runs" / "ball" / "other" / "seed0" / "config.toml").write_text("future = 1")
    row = write(folder).scenes[0].rows[1]
    assert row.seeds == [1] and "future" in row.failed[0]


def test_a_decided_run_is_accepted(data: Path, tmp_path: Path) -> None:
    """A finished fit that went on with another method is not taken for one of other settings."""
    job = jobs.plan(tmp_path / "out", [data], ["auto"], [0], preset="quick", threads=1)[0]
    rows = [{"component": name, "stays": True} for name in ("colour_alone", "surfels_2x")]
    chosen = decide.as_decided(job.method(), rows)
    job.run.create(chosen, str(data), images=digests(read_dataset(data, "train")))
    assert chosen.light is None and chosen.surfels.capacity == 2
    job.run.write_json(DECISIONS, rows)
    jobs.require_same(job)
    job.run.write_dataset(str(data), None, {**job.run.images(), "another": ""})
    refused(lambda: jobs.require_same(job), "another: 1 images or cameras are not as when")
    job.run.write_method(replace(chosen, seed=3))
    refused(lambda: jobs.require_same(job), "seed: the run was made with 3")
