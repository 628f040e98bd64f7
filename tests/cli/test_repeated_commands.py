"""A repeated or resumed command with any option changed does what the option says, or refuses and names it.

The options are those of the parser: a new one without a row fails. A row says what happens when a command
that has run is given again with this option changed.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_refgs import methods
from mi_refgs.cli import main
from mi_refgs.compare import execute
from mi_refgs.compare.jobs import Job
from mi_refgs.fitting.runner import Progress
from mi_refgs.fitting.train import Trainer
from mi_refgs.io.files import BusyError
from mi_refgs.io.resources import resource_dir
from mi_refgs.reconstruction import fit as reconstruct
from mi_refgs.reconstruction.relightable_import import import_relightable
from mi_refgs.runs.run import LOCK, Run
from mi_refgs.synthesis import make_dataset
from tests.helpers import command_names, command_options, refused
from tests.scenes.sphere import SCENE
from tests.scenes.splat_file import PRESET, render_few_views, write_ball, write_long_method
from tests.scenes.tiny import METHOD, SETTINGS, train_command


@dataclass(frozen=True)
class Refused:
    """Exit code 2, and a sentence with these words; nothing is changed."""

    argv: tuple[str, ...]
    words: tuple[str, ...]


@dataclass(frozen=True)
class Shows:
    """The result is that of the option."""

    argv: tuple[str, ...]
    makes: str = ""  # pattern of a file that it leaves below the output
    text: str = ""  # of that file


class Free(str):
    """Why the option is no part of what is kept."""


Row = Refused | Shows | Free

HOW = Free("how it is computed, from here on")
WHERE = Free("which output this is about")
FORM = Free("how the result is printed")
HASHED = Free("names the results of the steps that depend on it: see test_capture")
WHOLE = Free("a file is written whole: see test_render_replaces_image")
COMMON: dict[str, Row] = {"--json": FORM, "--mitsuba-variant": HOW, "--threads": HOW}


def refuses(option: str, *values: str, word: str = "") -> Refused:
    return Refused((option, *values), (word or option,))


KEPT: dict[str, dict[str, Row]] = {
    "train": {
        "data": Shows(("{moved}",), "dataset.json", "{moved}"),
        "--output": WHERE,
        "--method": refuses("--method", "{other}"),
        "--for": Refused(("--for", "relighting"), ("--for",)),
        "--preset": refuses("--preset", "standard"),
        "--set": refuses("--set", "loss.ssim=0.4"),
        "--resume": Free("absent, the run is refused: see test_a_run_is_not_begun_twice"),
        "--watch": Free("shows the fit"),
        "--port": Free("shows the fit"),
    },
    "demo": {
        "--output": WHERE,
        "--preset": Shows(("--preset", "standard"), "standard/config.toml"),
        "--set": refuses("--set", "loss.ssim=0.4"),
    },
    "dataset": {
        "scene": refuses("{scene2}", word="the scene file"),
        "--output": WHERE,
        "--views": refuses("--views", "3"),
        "--test-views": refuses("--test-views", "2"),
        "--size": refuses("--size", "6"),
        "--shapes": refuses("--shapes", "a"),
        "--distance": refuses("--distance", "3", "4"),
        "--samples": refuses("--samples", "2"),
        "--seed": refuses("--seed", "1"),
        "--max-depth": refuses("--max-depth", "3"),
        "--elevation": refuses("--elevation", "-10", "20"),
        "--azimuth": refuses("--azimuth", "0", "90"),
        "--fov": refuses("--fov", "30"),
        "--light": refuses("--light", "{light}"),
        "--relight": Shows(("--relight", "{light}"), "relight/sky/transforms_test.json"),
        "--overwrite": Shows(("--overwrite", "--views", "3"), "train/r_002.png"),
    },
    "import": {
        "file": refuses("{splats2}", word="--resume"),
        "--output": WHERE,
        "--camera": Refused(("--camera", "{cameras}"), ("--resume", "--camera")),
        "--linear": Refused(("--linear",), ("--resume", "--linear")),
        "--box": Refused(("--box", *"-1 -1 -1 1 1 1".split()), ("--resume", "--box")),
        "--relightable": Free("absent, --resume is refused: see test_options_of_the_fit_require_relightable"),
        "--for": Refused(("--for", "relighting"), ("--for",)),
        "--preset": refuses("--preset", "standard"),
        "--resume": Free("absent, the run is refused: see test_interrupted_import_resumes"),
    },
    "compare": {
        "data": refuses("{elsewhere}", word="DATA"),
        "--output": WHERE,
        "--methods": refuses("--methods", "{other}"),
        "--seeds": Shows(("--seeds", "0,1"), "runs/*/*/seed1/config.toml"),
        "--preset": refuses("--preset", "standard"),
        "--set": refuses("--set", "loss.ssim=0.4"),
        "--workers": HOW,
        "--cluster": HOW,
        "--mitsuba-variant": Free("is that of new jobs"),
    },
    "capture": {
        **dict.fromkeys(("photographs", "--masks", "--camera-model"), HASHED),
        "--output": WHERE,
        "--region": Free("is written each time"),
    },
}
"""Commands that go on from what they find."""
ANEW: dict[str, dict[str, Row]] = {
    "eval": {
        "run_folder": WHERE,
        "--data": Shows(("--data", "{moved}")),
        "--samples": Shows(("--samples", "4")),
    },
    "render": dict.fromkeys(
        ("scene", "--output", "--sensor", "--camera", "--object", "--samples", "--aov"), WHOLE
    ),
}
"""Commands that do everything again."""
OTHERS = {
    "doctor": "writes nothing",
    "profile": "writes nothing",
    "completion": "writes nothing",
    "view": "names saved views by number",
    "edit": "refuses an output that is there",
    "relight": "does everything again",
    "export": "does everything again",
}


def test_every_option_of_every_command_has_a_row() -> None:
    assert {*command_names()} == {*KEPT, *ANEW, *OTHERS}
    for name, rows in (KEPT | ANEW).items():
        found = {*command_options(name)}
        assert found == {*rows} | {*COMMON} & found, name


@pytest.fixture(scope="module")
def places(data: Path, method: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Files that rows name."""
    folder = tmp_path_factory.mktemp("repeated")
    other = folder / "twin" / method.name  # of the same name
    other.parent.mkdir()
    other.write_text(f"{METHOD}[rates]\ndecay = 0.25\n")
    for name, text in (("scene", SCENE), ("scene2", SCENE.replace("0.7", "0.6"))):
        (folder / f"{name}.xml").write_text(
            text.replace('<shape type="sphere">', '<shape type="sphere" id="a">')
        )
    found = {
        "data": data,
        "method": method,
        "other": other,
        "moved": shutil.copytree(data, folder / "moved"),
        "elsewhere": shutil.copytree(data, folder / "elsewhere" / data.name),
        "scene": folder / "scene.xml",
        "scene2": folder / "scene2.xml",
        "light": resource_dir("scenes") / "lights" / "sky.exr",
        "splats": write_ball(folder / "splats.ply"),
        "splats2": write_ball(folder / "splats2.ply", x=0.1),
        "cameras": folder / "cameras.json",
    }
    frames = [{"transform_matrix": np.eye(4).tolist()}] * 2
    found["cameras"].write_text(json.dumps({"w": 8, "h": 8, "fl_x": 8, "frames": frames}))
    return {name: str(path) for name, path in found.items()}


Began = Callable[[str], tuple[list[str], Path]]
"""Runs a command; returns its arguments and its output."""


@pytest.fixture
def began(
    places: dict[str, str],
    finished: Path,
    traced: Path,
    fitted_splats: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Began:
    """Outputs of commands, and what takes long left out of their repetition."""
    out = tmp_path / "out"

    def train() -> list[str]:
        shutil.copytree(finished, out)
        return [
            *train_command(Path(places["data"]), out, Path(places["method"]), "--resume"),
            "data.downscale=1",
        ]

    def demonstration() -> list[str]:
        shutil.copytree(finished, out / "quick")
        monkeypatch.setattr(
            make_dataset, "make_dataset", lambda *_, **__: shutil.copytree(places["data"], out / "data")
        )
        return ["demo", "-o", str(out)]

    def dataset() -> list[str]:
        shutil.copytree(traced, out)
        return [*TRACE, "-o", str(out), places["scene"]]

    def compare() -> list[str]:
        def begin(wanted: list[Job], *_: object) -> None:
            for job in wanted:
                if not job.run.exists():
                    job.run.create(job.method(), job.data)

        monkeypatch.setattr(execute, "execute_all", begin)
        options = ["--preset", "quick", "--methods", places["method"], "--set", *SETTINGS]
        argv = ["compare", places["data"], "-o", str(out), *options]
        assert main(argv) == 3  # nothing is fitted
        return argv

    def relightable() -> list[str]:
        render_few_views(monkeypatch)
        shutil.copytree(fitted_splats, out)
        return ["import", places["splats"], "-o", str(out), "--relightable", "--resume", "--preset", PRESET]

    made = {
        "import": relightable,
        "train": train,
        "demo": demonstration,
        "dataset": dataset,
        "compare": compare,
    }
    return lambda command: (made[command](), out)


@pytest.fixture(scope="module")
def fitted_splats(places: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out, method = tmp_path_factory.mktemp("splats") / "out", write_long_method(tmp_path_factory.mktemp("m"))
    mi.set_variant("llvm_ad_rgb")
    with pytest.MonkeyPatch.context() as patch:
        render_few_views(patch)
        import_relightable(places["splats"], out, method=method, preset=PRESET, progress=Progress())
    return out


TRACE = ["dataset", "--views", "2", "--test-views", "1", "--size", "4", "--samples", "1"]


@pytest.fixture(scope="module")
def traced(places: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("traced") / "out"
    assert main([*TRACE, "-o", str(out), places["scene"]]) == 0
    return out


def changed(argv: list[str], row: Refused | Shows, places: dict[str, str], out: Path) -> list[str]:
    """The command with the row's option, or with another argument in place of its own."""
    values = [value.format(**places, out=out) for value in row.argv]
    if values[0].startswith("--"):
        return [*argv, *values]
    own = {places["data"], places["scene"], places["splats"]}
    return [values[0] if value in own else value for value in argv]


def tree(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


ROWS = [(command, option) for command, rows in KEPT.items() for option in rows]


@pytest.mark.parametrize(
    ("command", "option"), [row for row in ROWS if isinstance(KEPT[row[0]][row[1]], Refused)]
)
def test_option_that_cannot_change_is_refused(
    command: str, option: str, began: Began, places: dict[str, str]
) -> None:
    row = KEPT[command][option]
    assert isinstance(row, Refused)
    argv, out = began(command)
    before = tree(out)
    refused(changed(argv, row, places, out), *row.words)
    after = {path: content for path, content in tree(out).items() if path in before}
    assert after == before or command == "demo"  # which makes its data set first


@pytest.mark.parametrize(
    ("command", "option"), [row for row in ROWS if isinstance(KEPT[row[0]][row[1]], Shows)]
)
def test_option_that_can_change_takes_effect(
    command: str, option: str, began: Began, places: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    row = KEPT[command][option]
    assert isinstance(row, Shows)
    argv, out = began(command)
    if command == "demo":  # its fit takes long
        copied = lambda *_, output, **__: reconstruct.load(shutil.copytree(out / "quick", output))  # noqa: E731
        monkeypatch.setattr(reconstruct, "fit", copied)
    assert main(changed(argv, row, places, out)) == (3 if command == "compare" else 0)
    text = row.text.format(**places).encode()
    assert any(text in path.read_bytes() for path in out.glob(row.makes))


def test_same_command_resumes(began: Began) -> None:
    """Options that say what a run was started with are no others, in other words too."""
    argv, out = began("train")
    state = tree(out / "checkpoints")
    config = Run(out).method()
    for more in ([], ["--method", config.file], ["--preset", "quick"]):
        assert main([*argv, *more]) == 0
    assert main([*argv[:4], "--resume"]) == 0 and tree(out / "checkpoints") == state
    refused([*argv[:4], "--resume", "--for", "relighting"], "--for")


def test_resume_refuses_changed_method(began: Began, places: dict[str, str]) -> None:
    """In Python, too; the difference is named."""
    _, out = began("train")
    made = Run(out).method()
    data = places["data"]
    reconstruct.fit(data, made, output=out, resume=True, progress=Progress())
    longer = dataclasses.replace(made, iterations=500)
    again = lambda: reconstruct.fit(data, longer, output=out, resume=True, progress=Progress())  # noqa: E731
    refused(again, "method: iterations: the run was started with 6", " 500")


@pytest.mark.parametrize("option", ["--methods=a", "--seeds=1", "--preset=quick", "--set=a=1", "--workers=1"])
def test_table_without_data_refuses_options_of_a_fit(option: str, tmp_path: Path) -> None:
    refused(["compare", "-o", tmp_path, option], option.split("=")[0], "DATA")


# ---------------- commands that do everything again ----------------


def test_eval_does_not_depend_on_earlier_eval(places: dict[str, str], finished: Path, tmp_path: Path) -> None:
    """After another one it is what it would be without."""
    used, fresh = (Path(shutil.copytree(finished, tmp_path / name)) for name in ("used", "fresh"))
    assert main(["eval", str(used)]) == 0
    first = json.loads((used / "metrics.json").read_text())
    options = [
        value.format(**places)
        for row in ANEW["eval"].values()
        if isinstance(row, Shows)
        for value in row.argv
    ]
    assert all(main(["eval", str(folder), *options]) == 0 for folder in (used, fresh))
    found = [json.loads((folder / "metrics.json").read_text()) for folder in (used, fresh)]
    for result in (first, *found):
        del result["ms_per_frame"]
    assert found[0] == found[1] != first
    assert found[0]["samples"] == 4 and found[0]["dataset"] == places["moved"]


def test_render_replaces_image(finished: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(finished, tmp_path / "run"))
    assert main(["render", str(run), "-o", str(tmp_path / "used.exr")]) == 0
    first = (tmp_path / "used.exr").read_bytes()
    for name in ("used.exr", "fresh.exr"):
        assert (
            main(["render", str(run), "-o", str(tmp_path / name), "--samples", "4", "--aov", "albedo"]) == 0
        )
    assert (tmp_path / "used.exr").read_bytes() == (tmp_path / "fresh.exr").read_bytes() != first


def test_existing_output_is_refused(finished: Path, tmp_path: Path) -> None:
    """By the commands that make a new run."""
    out = Path(shutil.copytree(finished, tmp_path / "out"))
    before = tree(out)
    for argv in (["edit", str(finished), "--set", "roughness=0.5"], ["import", "any.ply"]):
        refused([*argv, "-o", out], out)
        assert tree(out) == before


# ---------------- two processes on one run ----------------

HOLD = """
import fcntl, sys
file = open(sys.argv[1], "a")
fcntl.flock(file, fcntl.LOCK_EX)
print("held", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def live(finished: Path, tmp_path: Path) -> Iterator[tuple[Path, subprocess.Popen[str]]]:
    """A run that another process changes, whose artefacts are older than its checkpoint."""
    run = Path(shutil.copytree(finished, tmp_path / "run"))
    model = json.loads((run / "model.json").read_text())
    (run / "model.json").write_text(json.dumps(model | {"iteration": 3}))
    argv = [sys.executable, "-c", HOLD, str(run / LOCK)]
    with subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        yield run, process
        process.kill()


def test_second_process_on_a_run_is_refused(
    live: tuple[Path, subprocess.Popen[str]], places: dict[str, str], tmp_path: Path
) -> None:
    """Commands that change the run are refused, those that look at it read the newest checkpoint."""
    run, process = live
    argv = train_command(Path(places["data"]), run, Path(places["method"]), "--resume")
    before = tree(run)
    for command in (argv, ["export", str(run)], ["export", str(tmp_path / "run"), "-o", str(run)]):
        refused(command, "another process trains this run", run)
    assert tree(run) == before
    scene = reconstruct.load(run)
    assert scene.trained.iteration == 6
    for command in (
        ["eval", str(run)],
        ["render", str(run), "-o", str(tmp_path / "a.exr")],
        ["export", str(run), "-o", str(tmp_path / "copy")],
    ):
        assert main(command) == 0
    assert json.loads((run / "metrics.json").read_text())["iterations"] == 6
    assert json.loads((run / "model.json").read_text())["iteration"] == 3  # nothing is written
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert main(argv) == 0 and not (run / LOCK).exists()


def test_save_refuses_locked_folder(live: tuple[Path, subprocess.Popen[str]], finished: Path) -> None:
    """Not even before it is a run."""
    run, _ = live
    (run / "config.toml").unlink()
    with pytest.raises(BusyError, match="another process trains this run"):
        reconstruct.load(finished).save(run)


def test_fit_locks_its_run(places: dict[str, str], tmp_path: Path) -> None:
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

    method = methods.load(places["method"], "quick", SETTINGS)
    reconstruct.fit(places["data"], method, output=run.path, progress=Watch())
    assert seen == ["busy"] * 6 and not (run.path / LOCK).exists()
    attempt()
    assert seen[-1] == "free"
    with run.alone(), run.alone():
        pass
