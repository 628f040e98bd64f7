"""A command touches only its own files: every command, run where others have the names of its output."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import mi_refgs
from mi_refgs.cli import demo, main
from mi_refgs.errors import InputError
from mi_refgs.formats import FORMATS, options_of
from mi_refgs.io.exr import write_exr
from mi_refgs.io.ownership import RECORD, OutputFolder
from mi_refgs.reconstruction.new_light import NewLight
from mi_refgs.reconstruction.relight import relight
from mi_refgs.runs.run import RUN_FILES, Run
from mi_refgs.viewer.panels import write_view
from mi_refgs.viewer.viewer_scene import DisplayOptions
from tests.helpers import command_names, refused
from tests.scenes.tiny import train_command

FOREIGN = b'{"of": "another program"}\n'  # JSON, so that model.json and its like can be read
BALL = """<scene version="3.0.0">
    <emitter type="constant"/>
    <shape type="sphere"><bsdf type="diffuse"/></shape>
</scene>"""


@dataclass(frozen=True)
class Case:
    """A command line, and the files that it writes: those of a clean run, or `names` if that takes long."""

    command: str
    arguments: Callable[[Path], list[str]]  # on the folder where it runs
    needs: tuple[str, ...] = ("run",)  # of what is copied into the place
    names: tuple[str, ...] = ()
    replaces: tuple[str, ...] = ()  # what the user names, which is replaced
    every: bool = True  # whether each name is tried, or the last alone, because a refusal takes seconds


def _train(place: Path) -> list[str]:
    return train_command(place / "data", place / "out", place / "tiny.toml")


def _dataset(place: Path, *more: str) -> list[str]:
    size = ["--views", "1", "--test-views", "1", "--size", "4", "--samples", "1"]
    return ["dataset", str(place / "ball.xml"), "-o", str(place / "out"), *size, *more]


def _on(command: str, *more: str) -> Callable[[Path], list[str]]:
    """A command on the run; @ in an argument is the place."""
    return lambda place: [
        command,
        str(place / "run"),
        *(text.replace("@", str(place)) for text in more),
    ]


def _compare(place: Path) -> list[str]:
    method = ["--methods", str(place / "tiny.toml"), "--preset", "quick"]
    return ["compare", str(place / "data"), "-o", str(place / "out"), *method]


NEEDED = {"faces": ("--faces", "100", "--texture", "64"), "where": ("--where", "opacity > 0")}


def _options_of(form: str) -> list[str]:
    """Options by which a format takes little time, and takes this run."""
    return [text for name, option in NEEDED.items() if name in options_of([form]) for text in option]


SEED = "out/runs/data/tiny/seed0"
CASES = [
    Case("doctor", lambda place: ["doctor", str(place / "data")], ("data",)),
    Case("profile", _on("profile", "--size", "8"), ("bare@run",)),
    Case(
        "demo",
        lambda place: ["demo", "-o", str(place / "out")],
        (),
        ("out/data/dataset.json", "out/data/train/r_000.png", "out/quick/mesh.ply", "out/quick/config.toml"),
    ),
    Case(
        "capture",
        lambda place: ["capture", str(place / "data/train"), "-o", str(place / "out")],
        ("data",),
        ("out/capture.json", "out/region.json", "out/images/r_0.png", "out/sparse/0/images.bin"),
    ),
    Case("dataset", _dataset, ("ball.xml",)),
    Case(
        "dataset",
        lambda place: _dataset(place, "--relight", str(place / "light.exr")),
        ("ball.xml", "light.exr"),
        ("out/relight/light/test/r_000.exr",),
    ),
    Case(
        "dataset",
        lambda place: _dataset(place, "--overwrite"),
        ("ball.xml", "run@out"),
        ("out/dataset.json",),
    ),
    Case("train", _train, ("data", "tiny.toml")),
    Case("eval", _on("eval")),
    Case(
        "compare",
        _compare,
        ("data", "tiny.toml"),
        (
            *(f"out/{name}" for name in ("compare.json", "table.json", "table.md", "index.html")),
            *("out/pictures/data_psnr.png", "out/pictures/data_crops.png"),
            *(f"{SEED}/{name}" for name in ("job.json", "job.log", "failed.json", "config.toml", "mesh.ply")),
        ),
    ),
    Case("render", _on("render", "-o", "@/view.exr"), replaces=("view.exr",)),
    Case("render", _on("render", "-o", "@/view.png"), replaces=("view.png",)),
    Case("render", _on("render", "-o", "@/run/envmap.exr"), names=("run/envmap.exr",)),
    Case("relight", _on("relight", "--envmap", "@/light.exr"), ("run", "light.exr"), every=False),
    Case(
        "relight",
        _on("relight", "--envmap", "@/light.exr", "-o", "@/out", "--turntable", "2"),
        ("run", "light.exr"),
    ),
    Case("edit", _on("edit", "-o", "@/out", "--set", "roughness=0.5", "--preview")),
    Case("export", _on("export"), names=("run/background.exr",)),
    Case("export", _on("export", "-o", "@/out")),
    *(
        Case(
            "export",
            _on("export", "--to", name, "-o", "@/out", *_options_of(name)),
            names=(f"out/{name}{made.suffix}",) if made.suffix else (),
            every=False,
        )
        for name, made in FORMATS.items()
    ),
    Case("export", _on("export", "--to", "3dgs-ply", "-o", "@/a.ply"), replaces=("a.ply",)),
    Case("export", _on("export", "--to", "3dgs-ply", "-o", "@/run/surfels.ply"), names=("run/surfels.ply",)),
    Case("import", lambda place: ["import", str(place / "a.ply"), "-o", str(place / "out")], ("a.ply",)),
    Case(
        "view",
        lambda place: ["view"],
        (),
        ("views/view_000.png", "views/view_000.json", "views/view_000.exr"),
    ),
]


@pytest.fixture(scope="module")
def sources(finished: Path, data: Path, method: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What places are copied from."""
    folder = tmp_path_factory.mktemp("sources")
    shutil.copytree(finished, folder / "run")
    shutil.copytree(data, folder / "data")
    shutil.copy(method, folder / "tiny.toml")
    shutil.copytree(finished, folder / "bare", ignore=shutil.ignore_patterns("checkpoints"))
    assert main(["export", str(finished), "--to", "3dgs-ply", "-o", str(folder / "a.ply")]) == 0
    (folder / "ball.xml").write_text(BALL)
    write_exr(folder / "light.exr", np.ones((4, 8, 3), np.float32))
    return folder


@pytest.fixture
def small_demo(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("VIEWS", 1), ("TEST_VIEWS", 1), ("SIZE", 8), ("SAMPLES", 1)):
        monkeypatch.setattr(demo, name, value)


def place_of(case: Case, sources: Path, folder: Path) -> Path:
    """A place for a case; "run@out" is the run in the folder "out"."""
    folder.mkdir()
    for need in case.needs:
        source, _, target = need.partition("@")
        copy: Any = shutil.copytree if (sources / source).is_dir() else shutil.copy
        copy(sources / source, folder / (target or source))
    return folder


def contents(place: Path) -> dict[str, bytes]:
    """Every file of a place but the records, by its path."""
    files = (path for path in sorted(place.rglob("*")) if path.is_file() and path.name != RECORD)
    return {path.relative_to(place).as_posix(): path.read_bytes() for path in files}


def tried(case: Case, names: tuple[str, ...]) -> list[str]:
    """The names that are tried: in folders of an output folder one of each kind of file."""
    kinds = {(Path(name).parent, Path(name).suffix if name.count("/") > 1 else name): name for name in names}
    return [*kinds.values()] if case.every else [names[-1]]


def run(case: Case, place: Path) -> int:
    """Run the command; `refgs view` saves a view, as its page would."""
    if case.command != "view":
        return main(case.arguments(place))
    planes = [np.full(4, 0.5, np.float32)] * 4
    frame = SimpleNamespace(background=None, radiance=planes[:3], alpha=planes[3])
    drawable: Any = SimpleNamespace(fine=lambda *_: frame, light=None)
    pose: Any = SimpleNamespace(camera=lambda *_: None, transforms=lambda *_: {})
    write_view(drawable, pose, (2, 2), DisplayOptions(), place / "views")
    return 0


def test_every_command_has_a_case() -> None:
    assert {case.command for case in CASES} == {*command_names()}


@pytest.mark.usefixtures("small_demo")
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.command)
def test_command_changes_only_its_own_files(
    case: Case, sources: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A foreign file keeps every byte; a command that refuses says one sentence and changes nothing."""
    names = case.names
    if not names:
        place = place_of(case, sources, tmp_path / "clean")
        before = contents(place)
        assert run(case, place) == 0, capsys.readouterr().err
        names = tuple(name for name in contents(place) if name not in before)
        assert {*case.replaces} <= {*names}
    for i, name in enumerate(tried(case, names)):
        place = place_of(case, sources, tmp_path / str(i))
        if not (place / name).exists():
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            (place / name).write_bytes(FOREIGN)
        before = contents(place)
        capsys.readouterr()
        code, after = run(case, place), contents(place)
        said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("refgs: ")]
        if name in case.replaces:
            assert code == 0 and after[name] != FOREIGN
            continue
        assert after[name] == before[name], name
        assert code in (0, 2), said
        if code == 2:
            assert after == before, f"{name}: refused, and yet changed something"
            assert "; " in said[-1], said
        else:
            assert {key: after.get(key) for key in before} == before, f"{name}: changed another file"


# ---------------- what is a command's own ----------------


def test_export_replaces_only_exports_of_the_same_run(sources: Path, tmp_path: Path) -> None:
    first, second = (shutil.copytree(sources / "run", tmp_path / name) for name in ("first", "second"))
    out = tmp_path / "out"
    export = ["export", str(first), "-o", str(out)]
    assert main(export) == 0
    (out / "surfels.ply").write_bytes(b"spoilt")
    assert main(export) == 0 and (out / "surfels.ply").read_bytes() == (first / "surfels.ply").read_bytes()
    before = contents(out)
    other = ["export", str(second), "-o", str(out)]
    refused(other, "--overwrite")
    assert contents(out) == before
    (out / "background.exr").write_bytes(FOREIGN)
    refused(export, "background.exr: output: exists")
    assert main([*other, "--overwrite"]) == 0 and not (out / "background.exr").exists()
    refused(export, "surfels.ply: output: exists")


def test_run_is_never_overwritten(sources: Path, tmp_path: Path) -> None:
    """Not even with --overwrite; nor its files one by one, also in a run without checkpoints."""
    shutil.copytree(sources / "run", tmp_path / "run")
    bare = shutil.copytree(sources / "bare", tmp_path / "bare")
    before = contents(bare)
    for more in ([], ["--overwrite"]):
        command = ["export", str(tmp_path / "run"), "-o", str(bare), *more]
        refused(command, "contains a run, which is never overwritten")
        (bare / "config.toml").rename(tmp_path / "config.toml")
        refused(command, "belongs to a run, which is never overwritten")
        (tmp_path / "config.toml").rename(bare / "config.toml")
    with pytest.raises(InputError, match="contains a run already"):
        mi_refgs.load(tmp_path / "run").save(bare)
    assert contents(bare) == before


def test_save_refuses_foreign_files(sources: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out/mesh.ply").write_bytes(FOREIGN)
    with pytest.raises(InputError, match=r"mesh\.ply: output: exists"):
        mi_refgs.load(sources / "run").save(tmp_path / "out")
    assert contents(tmp_path / "out") == {"mesh.ply": FOREIGN}


def test_format_replaces_only_files_of_the_same_run(sources: Path, tmp_path: Path) -> None:
    found, out = mi_refgs.load(sources / "run"), tmp_path / "out"
    for _ in range(2):
        assert all(path.is_file() for path in found.export("cameras", out))
    copy = mi_refgs.load(shutil.copytree(sources / "run", tmp_path / "copy"))
    in_memory = found.edit(set={"roughness": 0.5})
    for other in (copy, in_memory):
        with pytest.raises(InputError, match=r"overwrite=True"):
            other.export("cameras", out)
    copy.export("cameras", out, overwrite=True)
    assert not [path for path in out.iterdir() if path.is_dir() and path.name.startswith(".")]


def test_resumed_fit_keeps_foreign_logs_and_checkpoints(
    data: Path, method: Path, sources: Path, tmp_path: Path
) -> None:
    run = shutil.copytree(sources / "run", tmp_path / "run")
    foreign = [run / name for name in ("notes.jsonl", "checkpoints/9999999.npz", "checkpoints/0000001.npz")]
    for path in foreign:
        path.write_bytes(FOREIGN)
    assert main(["train", str(data), "-o", str(run), "--resume"]) == 0
    state = Run(run).load_checkpoint()
    assert state is not None
    Run(run).save_checkpoint(7, state)
    Run(run).save_checkpoint(8, state)
    assert all(path.read_bytes() == FOREIGN for path in foreign)
    assert {path.name for path in (run / "checkpoints").iterdir()} == {
        *(path.name for path in foreign[1:]),
        *("0000007.npz", "0000008.npz"),
    }


def test_run_of_earlier_version_is_recognised(sources: Path, tmp_path: Path) -> None:
    """A run without a record: its usual files are its own, and recorded with the first that is written."""
    run = shutil.copytree(sources / "run", tmp_path / "run")
    (run / RECORD).unlink()
    (run / "notes.txt").write_bytes(FOREIGN)
    assert main(["eval", str(run)]) == 0 and main(["eval", str(run)]) == 0 and main(["export", str(run)]) == 0
    owners = Run(run).output.owners()
    assert {"surfels.ply", "checkpoints/0000006.npz", "metrics.json"} <= owners.keys()
    assert "notes.txt" not in owners and set(owners.values()) == {"run"}


def test_every_file_of_a_run_is_listed(sources: Path, tmp_path: Path) -> None:
    """Files that a run may get later are refused when it begins, not after minutes."""
    run = shutil.copytree(sources / "run", tmp_path / "run")
    assert main(["eval", str(run)]) == 0
    listed = {path for pattern in RUN_FILES for path in run.glob(pattern)}
    assert {path for path in run.rglob("*") if path.is_file() and path.name != RECORD} == listed


def test_records_of_two_processes_are_merged(tmp_path: Path) -> None:
    """Lines are appended; half a line of a process that was killed is skipped."""
    one, two = OutputFolder(tmp_path, "a"), OutputFolder(tmp_path, "b")
    one.claim("x")
    two.claim("y")
    with (tmp_path / RECORD).open("a") as record:
        record.write('{"owner": "c", "fi')
    one.claim("z")
    assert OutputFolder(tmp_path, "a").owners() == {"x": "a", "y": "b", "z": "a"}


def test_relight_refuses_another_map_of_the_same_name(sources: Path, tmp_path: Path) -> None:
    shutil.copytree(sources / "run", tmp_path / "run")
    for name, value in (("first", 1.0), ("second", 0.2)):
        (tmp_path / name).mkdir()
        write_exr(tmp_path / name / "studio.exr", np.full((4, 8, 3), value, np.float32))
    first, second = (NewLight(tmp_path / name / "studio.exr") for name in ("first", "second"))
    for _ in range(2):
        assert Path(relight(Run(tmp_path / "run"), first, turntable=1)["output"]).name == "studio"
    refused(lambda: relight(Run(tmp_path / "run"), second, turntable=1), "choose another -o")
