"""A command writes into a folder of its own only: every command, run where others have put a file."""

import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

import mi_refgs
from mi_refgs.cli import main
from mi_refgs.errors import InputError
from mi_refgs.formats.format import FORMATS, options_of
from mi_refgs.io.exr import write_exr
from mi_refgs.io.ownership import MARK, RUN_FILES, own_folder, owner_of
from mi_refgs.reconstruction.new_light import NewLight
from mi_refgs.reconstruction.relight import relight
from mi_refgs.runs.run import Run
from tests.helpers import command_names, contents, refused
from tests.scenes.tiny import train_command

FOREIGN = b'{"of": "another program"}\n'
BALL = """<scene version="3.0.0">
    <emitter type="constant"/>
    <shape type="sphere"><bsdf type="diffuse"/></shape>
</scene>"""
OPTIONS = {"faces": ("--faces", "100", "--texture", "64"), "where": ("--where", "opacity > 0")}
"""Options by which a format takes little time, and takes this run."""
TRACED = ("--views", "1", "--test-views", "1", "--size", "4", "--samples", "1")

Arguments = Callable[[Path], Sequence[object]]  # of a command, on the folder with its inputs
FILLS: dict[str, Arguments] = {
    "demo": lambda at: ["-o", at / "out"],
    "capture": lambda at: [at / "data/train", "-o", at / "out"],
    "dataset": lambda at: [at / "ball.xml", "-o", at / "out", *TRACED],
    "dataset --overwrite": lambda at: [at / "ball.xml", "-o", at / "out", *TRACED],
    "train": lambda at: train_command(at / "data", at / "out", at / "tiny.toml")[1:],
    "compare": lambda at: [at / "data", "-o", at / "out", "--methods", at / "tiny.toml", "--preset", "quick"],
    "relight": lambda at: [at / "run", "--envmap", at / "light.exr", "-o", at / "out", "--turntable", "2"],
    "edit": lambda at: [at / "run", "-o", at / "out", "--set", "roughness=0.5"],
    "export": lambda at: [at / "run", "-o", at / "out"],
    "import": lambda at: [at / "a.ply", "-o", at / "out"],
}
"""Commands that fill the folder `out`."""
OTHERS = ("completion", "doctor", "eval", "render", "view")
"""Commands that write one file, into a run, or nothing."""


@pytest.fixture(scope="module")
def place(finished: Path, data: Path, method: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The inputs of all commands."""
    folder = tmp_path_factory.mktemp("place")
    shutil.copytree(finished, folder / "run")
    shutil.copytree(data, folder / "data")
    shutil.copy(method, folder / "tiny.toml")
    assert main(["export", str(finished), "--to", "3dgs-ply", "-o", str(folder / "a.ply")]) == 0
    (folder / "ball.xml").write_text(BALL)
    write_exr(folder / "light.exr", np.ones((4, 8, 3), np.float32))
    return folder


@pytest.fixture
def out(place: Path) -> Iterator[Path]:
    """The output folder, with a foreign file."""
    folder = place / "out"
    folder.mkdir()
    (folder / "notes.txt").write_bytes(FOREIGN)
    yield folder
    shutil.rmtree(folder)


def test_every_command_has_a_case() -> None:
    assert {*OTHERS, *(name.split()[0] for name in FILLS)} >= {*command_names()}


@pytest.mark.parametrize("command", FILLS)
def test_a_folder_with_a_foreign_file_is_refused(command: str, place: Path, out: Path) -> None:
    if command == "demo":  # its folders are below
        (out / "quick").mkdir()
        shutil.move(out / "notes.txt", out / "quick")
    before = contents(out)
    refused([command.split()[0], *FILLS[command](place), *command.split()[1:]], "output: ")
    assert contents(out) == before


@pytest.mark.parametrize("name", FORMATS)
def test_a_format_refuses_a_foreign_folder(name: str, place: Path, out: Path) -> None:
    target = out if FORMATS[name].suffix else out / name
    if target != out:
        target.mkdir()
        shutil.move(out / "notes.txt", target)
    more = [text for key, option in OPTIONS.items() if key in options_of([name]) for text in option]
    before = contents(out)
    refused(["export", place / "run", "--to", name, "-o", out, *more], "output: has other files")
    assert contents(out) == before


@pytest.mark.parametrize("command", [["render", "run"], ["export", "run", "--to", "3dgs-ply"]], ids=str)
def test_a_file_is_replaced_unless_a_run_has_it(command: list[str], place: Path, tmp_path: Path) -> None:
    suffix = ".exr" if command[0] == "render" else ".ply"
    (tmp_path / f"own{suffix}").write_bytes(FOREIGN)
    command = [command[0], str(place / "run"), *command[2:]]
    assert main([*command, "-o", str(tmp_path / f"own{suffix}")]) == 0
    assert (tmp_path / f"own{suffix}").read_bytes() != FOREIGN
    run = Path(shutil.copytree(place / "run", tmp_path / "copy"))
    for _ in range(2):  # also in the run's folder, where it is no file of the run
        assert main([*command, "-o", str(run / f"own{suffix}")]) == 0
    before = contents(run)
    file = run / ("envmap.exr" if suffix == ".exr" else "surfels.ply")
    refused([*command, "-o", file], f"{file}: output: belongs to a run, which is never overwritten")
    assert contents(run) == before
    image = place / "data" / ("environment.exr" if suffix == ".exr" else "train/points.ply")
    if suffix == ".ply":
        image.write_bytes(FOREIGN)
    deep = image.parent / f"a/b/deep{suffix}"
    deep.parent.mkdir(parents=True, exist_ok=True)
    deep.write_bytes(FOREIGN)
    for file in (image, deep):
        refused([*command, "-o", file], f"{file}: output: belongs to a data set")


def test_files_of_a_run_are_known(finished: Path) -> None:
    assert {path.name for path in finished.iterdir() if path.is_file()} - {MARK} <= RUN_FILES


def test_a_folder_belongs_to_one_owner(tmp_path: Path) -> None:
    """An empty one, or one with hidden files, to whoever comes first."""
    (tmp_path / ".lock").write_bytes(b"")
    own_folder(tmp_path, "first")
    (tmp_path / "file").write_bytes(FOREIGN)
    own_folder(tmp_path, "first")
    refused(lambda: own_folder(tmp_path, "second"), "output: has other files; choose an empty folder")
    assert owner_of(tmp_path) == "first" and owner_of(tmp_path / "none") is None


def test_export_replaces_only_exports_of_the_same_run(place: Path, tmp_path: Path) -> None:
    first, second = (shutil.copytree(place / "run", tmp_path / name) for name in ("first", "second"))
    out = tmp_path / "out"
    export = ["export", str(first), "-o", str(out)]
    assert main(export) == 0
    for name in ("surfels.ply", "background.exr"):  # of a scene with another background
        (out / name).write_bytes(b"spoilt")
    assert main(export) == 0 and (out / "surfels.ply").read_bytes() == (first / "surfels.ply").read_bytes()
    assert not (out / "background.exr").exists()
    before = contents(out)
    refused(["export", second, "-o", out], "output: has other files")
    mi_refgs.load(first).export("3dgs-ply", tmp_path / "formats")
    for folder in (out, tmp_path / "formats"):
        with pytest.raises(InputError, match="has other files"):
            mi_refgs.load(second).export("3dgs-ply", folder)
    assert contents(out) == before


def test_run_is_never_overwritten(place: Path, tmp_path: Path) -> None:
    """Also without its config.toml, as one that was killed while it was saved."""
    other = shutil.copytree(place / "run", tmp_path / "other")
    refused(lambda: mi_refgs.load(place / "run").save(other), "contains a run already")
    (other / "config.toml").unlink()
    before = contents(other)
    refused(["export", place / "run", "-o", other], "belongs to a run, which is never overwritten")
    assert contents(other) == before


def test_relight_refuses_another_map_of_the_same_name(place: Path, tmp_path: Path) -> None:
    run, file = Run(Path(shutil.copytree(place / "run", tmp_path / "run"))), tmp_path / "studio.exr"
    write_exr(file, np.ones((4, 8, 3), np.float32))
    for _ in range(2):
        assert Path(relight(run, NewLight(file), turntable=1)["output"]).name == "studio"
    write_exr(file, np.full((4, 8, 3), 0.2, np.float32))
    refused(lambda: relight(run, NewLight(file), turntable=1), "studio: output: has other files")
