"""Every command through `main`: what it writes and prints, and how it refuses bad input."""

import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mi_refgs.cli import demo, main
from mi_refgs.fitting.runner import load_method
from mi_refgs.fitting.train import Trainer
from mi_refgs.io.images import read_png, srgb_from_linear
from mi_refgs.io.ownership import MARK
from mi_refgs.methods.read import PRESETS, load_resolved
from mi_refgs.runs.views import sized
from tests.errors import LIST, listed
from tests.helpers import ROOT, command_names, command_options, read_exr, refused
from tests.scenes.tiny import SIZE, train_command

ARTEFACTS = ("surfels.ply", "envmap.exr", "mesh.ply", "scene.xml", "config.toml", "metrics.jsonl")


@pytest.mark.parametrize("command", command_names())
def test_every_command_has_help_with_an_example(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, "--help"]) == 0
    text = capsys.readouterr().out
    assert f"example:\n  refgs {command}" in text
    assert all(option in text for option in command_options(command) if option.startswith("-"))


def test_overview_lists_commands_and_exit_codes(capsys: pytest.CaptureFixture[str]) -> None:
    for argv in ([], ["--help"], ["-h"]):
        assert main(argv) == 0
        text = capsys.readouterr().out
        assert all(f"\n  {name} " in text for name in command_names())
        assert "exit codes:" in text and "bad input" in text


def test_json_is_alone(run: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither Python's nor C++'s chatter on standard output gets between a pipe and the object."""
    original = Trainer.__init__

    def noisy(self: Trainer, *args: object, **more: object) -> None:
        print("from Python")
        os.write(1, b"from C++\n")
        original(self, *args, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(Trainer, "__init__", noisy)
    dataset = json.loads((run / "dataset.json").read_text())["path"]
    capfd.readouterr()
    assert main(["train", dataset, "-o", str(run), "--resume", "--json"]) == 0
    out, err = capfd.readouterr()
    assert json.loads(out)["iterations"] == 6
    assert "from Python" in err and "from C++" in err


@pytest.mark.parametrize("arguments", ["--help", "train --help", "doctor"])
def test_closed_pipe_ends_without_a_traceback(arguments: str) -> None:
    """As of `refgs train --help | head`."""
    command = f"{sys.executable} -m mi_refgs {arguments} | true; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 141 and "Error" not in done.stderr


def test_train_writes_a_run_folder(finished: Path) -> None:
    for name in ARTEFACTS:
        assert (finished / name).stat().st_size > 0, name
    assert sorted(path.name for path in (finished / "previews").iterdir()) == ["0000004.png", "0000006.png"]
    assert (finished / "checkpoints" / "0000006.npz").is_file()
    assert load_resolved(finished / "config.toml").name == "tiny"
    lines = [json.loads(line) for line in (finished / "metrics.jsonl").read_text().splitlines()]
    assert [line["iteration"] for line in lines] == [2, 4, 6]
    assert [path.name for path in finished.rglob("*") if path.name.startswith(".")] == [MARK]


def test_few_views(data: Path, method: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*train_command(data, tmp_path / "run", method), "iterations=1", "--threads", "1"]) == 0
    said = capsys.readouterr().err
    assert "only 3 training views" in said and "stage deferred: does not begin in 1 iterations; add" in said
    assert (tmp_path / "run" / "checkpoints" / "0000001.npz").is_file()  # though none was due


def test_large_images(data: Path, method: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The size is chosen once: config.toml records it, and evaluation reads the same."""
    run = tmp_path / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PRESETS, "quick", replace(PRESETS["quick"], pixels=150))
        assert main([*train_command(data, run, method), "iterations=2"]) == 0
        for setting in ("data.downscale=1", "data.crop=4096"):  # parts of images may be of larger ones
            assert sized(load_method(str(method), "quick", [setting]), data)[0].data.downscale == 1
    assert capsys.readouterr().err.count("20 × 20 pixels are read as 10 × 10") == 1
    assert load_resolved(run / "config.toml").data.downscale == 2 and main(["eval", str(run)]) == 0
    assert json.loads((run / "metrics.json").read_text())["image_size"] == [SIZE // 2, SIZE // 2]
    assert sized(load_method(str(method), "quick", []), data)[0].data.downscale == 1


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_interrupted_fit_resumes_bit_for_bit(
    number: int,
    code: int,
    heard_interrupts: None,
    data: Path,
    method: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    step = Trainer.step

    def interrupted(self: Trainer) -> None:
        step(self)
        if self.iteration == 4:
            os.kill(os.getpid(), number)

    straight, run, one = tmp_path / "straight", tmp_path / "run", ("--threads", "1")
    assert main(train_command(data, straight, method, *one)) == 0
    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "step", interrupted)
        assert main(train_command(data, run, method, *one)) == code
    said = capsys.readouterr().err
    assert f"interrupted at iteration 4; resume with: refgs train {data} -o {run} --resume" in said
    with (run / "metrics.jsonl").open("a") as log:  # as after a kill between a log line and its checkpoint
        log.write(json.dumps({"iteration": 6}) + "\n")
    assert main(["train", str(data), "-o", str(run), "--resume", *one]) == 0
    assert "resumed at iteration 4 of 6" in capsys.readouterr().err
    for name in ("surfels.ply", "envmap.exr", "mesh.ply"):
        assert (run / name).read_bytes() == (straight / name).read_bytes(), name
    lines = (run / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["iteration"] for line in lines] == [2, 4, 6]


def test_render_writes_an_image(finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    exr, png = tmp_path / "view.exr", tmp_path / "view.png"
    assert main(["render", str(finished), "-o", str(exr), "--aov", "albedo", "nn:normal", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["width"] == SIZE
    channels = read_exr(exr)
    assert {"R", "G", "B", "A", "albedo.R", "nn.X"} <= channels.keys()
    assert main(["render", str(finished / "scene.xml"), "-o", str(png)]) == 0
    pixels = read_png(png)
    assert pixels.shape == (SIZE, SIZE, 4)
    assert np.abs(pixels[..., 3] - np.clip(channels["A"], 0, 1)).max() < 0.51 / 255
    shown = np.clip(srgb_from_linear(channels["G"] / np.maximum(channels["A"], 1e-8)), 0, 1)
    seen = channels["A"] > 0.1
    assert seen.any() and np.abs(pixels[..., 1] - shown)[seen].max() < 0.51 / 255
    shutil.copytree(finished, tmp_path / "grey")
    scene = tmp_path / "grey" / "scene.xml"
    scene.write_text(scene.read_text().replace('value="rgba"', 'value="luminance"'))
    refused(["render", scene, "-o", png], "output: the film has Y, no red, green and blue; write an EXR file")


def test_aovs_are_appended(finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What the scene has already is not repeated; a name of two types is refused."""
    scene, out = finished / "with_aovs.xml", str(tmp_path / "view.exr")
    text = (finished / "scene.xml").read_text()
    own = '<string name="aovs" value=" nn : normal,depth:depth"/></integrator>'
    scene.write_text(text.replace("</integrator>", own))

    def layers(*aovs: str) -> list[str]:
        assert main(["render", str(scene), "-o", out, "--json", *(["--aov", *aovs] if aovs else [])]) == 0
        names = json.loads(capsys.readouterr().out)["channels"]
        return list(dict.fromkeys(name.partition(".")[0] for name in names if "." in name))

    assert layers() == ["nn", "depth"]
    assert layers("albedo", "depth", "nn:normal", "albedo") == ["nn", "depth", "albedo"]
    refused(["render", str(scene), "-o", out, "--aov", "nn:depth"], "aovs", "'nn' occurs twice")
    scene.unlink()


def test_render_uses_newest_checkpoint(finished: Path, run: Path, tmp_path: Path) -> None:
    """As `load` and `refgs view` do: of artefacts that are older, nothing is shown."""
    note = json.loads((run / "model.json").read_text())
    (run / "model.json").write_text(json.dumps(note | {"iteration": 0}))
    shutil.copyfile(ROOT / "scenes" / "lights" / "sky.exr", run / "envmap.exr")
    images = []
    for folder in (finished, run):
        assert main(["render", str(folder), "-o", str(tmp_path / "out.exr")]) == 0
        images.append(read_exr(tmp_path / "out.exr")["R"])
    np.testing.assert_allclose(images[0], images[1], atol=1e-5)
    assert json.loads((run / "model.json").read_text()) == note


def test_demo(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("VIEWS", 3), ("TEST_VIEWS", 1), ("SIZE", 16), ("SAMPLES", 1)):
        monkeypatch.setattr(demo, name, value)
    settings = ["iterations=2", "surfels.count=60", "surfels.max_count=60", "light.height=8"]
    command = ["demo", "-o", str(tmp_path / "demo"), "--json", "--set", *settings]
    assert main(command) == 0
    first = json.loads(capsys.readouterr().out)
    assert Path(first["contact_sheet"]).is_file() and first["metrics"]["iterations"] == 2
    written = {path: path.stat().st_mtime_ns for path in (tmp_path / "demo").rglob("*.[ep]*")}
    assert main(command) == 0 and json.loads(capsys.readouterr().out) == first
    assert {path: path.stat().st_mtime_ns for path in written} == written


@pytest.mark.parametrize(
    "command", ["train", "render a.xml -o x.png --samples x", "render a.xml -o x.png --smaples 4"]
)
def test_tyro_says_what_is_wrong_with_options(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(command.split()) == 2
    out, err = capsys.readouterr()
    assert (not out and command.split()[-1] in err) or "DATA" in err


def test_errors_are_those_of_the_list() -> None:
    """`python -m tests.errors` writes it anew."""
    assert listed().splitlines() == LIST.read_text(encoding="utf-8").splitlines()
