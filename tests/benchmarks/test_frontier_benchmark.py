"""The frontier: resumed cells, their identity, the Pareto front of known points, verdicts on presets."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from benchmarks.common.build import read_result, recorded
from benchmarks.common.report import Row
from benchmarks.frontier import __main__ as frontier
from benchmarks.frontier import cells, fit, page
from benchmarks.frontier.cells import Cell, Store
from mi_refgs.data.dataset import Dataset
from mi_refgs.errors import InputError
from mi_refgs.fitting.runner import begin
from tests.scenes.tiny import SIZE, write_data, write_method

AXES = "--surfels 50 100 --iterations 4 --presets quick --quiet".split()


@pytest.fixture(scope="module")
def balls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nine training views: two validation views, seven to fit."""
    return write_data(tmp_path_factory.mktemp("data") / "balls", views=9)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_method(tmp_path_factory.mktemp("method"))


def row(preset: str | None, seconds: float, psnr: float, seed: int = 0, **more: Any) -> Row:
    """A row of a cell; without a preset its number of iterations is its CPU time."""
    settings: Row = {
        "data": "balls",
        "method": "tiny",
        "preset": preset,
        "iterations": round(seconds),
        "max_surfels": 100,
        "downscale": 2,
        "samples": 1,
        "seed": seed,
    }
    results: Row = {
        "cpu_seconds": seconds,
        "wall_seconds": 2 * seconds,
        "peak_bytes": 5e8,
        "surfels": 90,
        "psnr": psnr,
        "ssim": 0.9,
        "normal_mae_deg": None,
        "width": 10,
        "height": 15,
        "full_width": 20,
        "full_height": 30,
        "views": 7,
        "validation_views": 2,
    }
    assert {*results} == {*cells.RESULTS}
    return settings | results | more


# ---------- Cells ----------


class Measured:
    """Replaces the fits: counts them, and raises what `fails` says for some."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.presets: list[str] = []
        self.rehearsed: list[Cell] = []
        self.fails: Callable[[Cell], Row | None] = lambda cell: None
        monkeypatch.setattr(frontier, "measure", self.measure)

    def measure(self, cell: Cell) -> Row:
        if cell.preset == cells.REHEARSAL:
            self.rehearsed.append(cell)
            return {}
        if (failure := self.fails(cell)) is not None:
            return failure
        self.presets.append(cell.preset)
        made = row(None, 10.0 + len(self.presets), 20.0)
        return {name: made[name] for name in cells.RESULTS}


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> Measured:
    return Measured(monkeypatch)


@pytest.fixture
def command(balls: Path, tiny: Path, tmp_path: Path) -> list[str]:
    folders = ["--cells", str(tmp_path / "cells"), "-o", str(tmp_path / "out")]
    return [str(balls), "--methods", str(tiny), *AXES, *folders]


def test_an_interrupted_run_continues(measured: Measured, command: list[str], tmp_path: Path) -> None:
    def interrupt(cell: Cell) -> None:
        if cell.preset == "4:100":
            raise KeyboardInterrupt

    measured.fails = interrupt
    assert frontier.main(command) == frontier.INTERRUPTED
    assert measured.presets == ["4:50"] and not (tmp_path / "out").exists()

    measured.fails = lambda cell: None
    assert frontier.main(command) == 0
    assert measured.presets == ["4:50", "4:100", "quick"]
    assert frontier.main(command) == 0 and len(measured.presets) == 3
    assert len(measured.rehearsed) == 2  # once per run that measures anything
    rows = read_result(tmp_path / "out" / "frontier.json")["rows"]
    assert [found["cpu_seconds"] for found in rows] == [11, 12, 13]


def test_kernels_are_compiled_before_cells_are_timed(measured: Measured, command: list[str]) -> None:
    """Once per size of images and number of samples; the preset has those of the first."""
    assert frontier.main([*command, "--downscale", "1", "2", "--samples", "1", "4", "--seeds", "0", "1"]) == 0
    found = [(cell.downscale, cell.samples) for cell in measured.rehearsed]
    assert found == [(1, 1), (1, 4), (2, 1), (2, 4)]
    assert len(measured.presets) == 2 * (2 * 2 * 2 + 1)


@pytest.mark.parametrize("damage", ['{"identity": ', '{"identity": {}, "row": {}}'])
def test_a_damaged_cell_is_measured_again(
    damage: str, measured: Measured, command: list[str], tmp_path: Path
) -> None:
    assert frontier.main(command) == 0
    [path] = (tmp_path / "cells").glob("*4_100*.json")
    kept = path.read_text()
    path.write_text(damage)
    assert frontier.main(command) == 0
    assert measured.presets == ["4:50", "4:100", "quick", "4:100"]
    assert json.loads(path.read_text())["identity"] == json.loads(kept)["identity"]


def test_cells_without_a_result_are_listed_and_tried_again(
    measured: Measured, command: list[str], tmp_path: Path
) -> None:
    measured.fails = lambda cell: {"failed": "no memory"} if cell.preset == "quick" else None
    assert frontier.main(command) == 0
    text = (tmp_path / "out" / "frontier.md").read_text()
    assert re.search(r"^- balls tiny quick seed 0: no memory$", text, re.MULTILINE)
    assert "*Not measured in this run.*" in text  # verdicts on presets
    measured.fails = lambda cell: None
    assert frontier.main(command) == 0
    assert measured.presets[2:] == ["quick"]


def test_without_any_result_the_reason_is_the_error(
    measured: Measured, command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    measured.fails = lambda cell: {"failed": "no memory"}
    assert frontier.main(command) == 2
    assert "no memory" in capsys.readouterr().err


def test_results_of_other_inputs_are_not_used(
    balls: Path, tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Settings, data, code and machine; another place of the same files is the same."""
    data, method = tmp_path / "balls", tmp_path / "tiny.toml"
    shutil.copytree(balls, data)
    shutil.copy(tiny, method)
    cell = Cell(str(balls), str(tiny), "4:50", 1, 1, 0, 1)
    store = Store(tmp_path / "cells")
    made = row(None, 10.0, 20.0)
    store.write(cell, made)
    moved = replace(cell, data=str(data), method=str(method))
    assert store.read(cell) == store.read(moved) == made and store.unused([cell]) == 0

    for changed in (
        replace(cell, seed=1),
        replace(cell, samples=4),
        replace(cell, downscale=2),
        replace(cell, preset="4:60"),
    ):
        assert store.read(changed) is None, changed
    method.write_text(tiny.read_text().replace("height = 8", "height = 12"))
    assert store.read(moved) is None and store.unused([moved]) == 1
    (data / "train" / "r_0.png").write_bytes((data / "train" / "r_1.png").read_bytes())
    assert Store(store.folder).read(replace(moved, method=cell.method)) is None
    with monkeypatch.context() as patch:
        patch.setattr(cells.device, "machine", lambda: {"cpu": "another"})
        assert store.read(cell) is None
    monkeypatch.setattr(cells, "code_digest", lambda: "another")
    assert Store(store.folder).read(cell) is None
    with pytest.raises(InputError, match="changed while"):
        store.write(cell, made)
    assert store.read(cell) == made


def test_scenes_are_path_traced_once(
    measured: Measured, command: list[str], balls: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def make(scene: Path, target: Path, *, size: int, progress: bool) -> Path:
        assert (scene.name, size, progress) == ("balls.xml", 24, False)
        return Path(shutil.copytree(balls, target, dirs_exist_ok=True))

    monkeypatch.setattr(frontier, "make_dataset", make)
    assert frontier.main(["balls.xml", *command[1:], "--size", "24"]) == 0
    assert (tmp_path / "cells" / "data" / "balls_24" / "transforms_train.json").exists()
    assert "### balls_24 (" in (tmp_path / "out" / "frontier.md").read_text()


def test_bad_input_is_refused(command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for changed, word in (
        ([str(tmp_path / "none"), *command[1:]], "no such folder"),
        ([command[0], *command], "given twice"),
        ([*command, "--methods", "nothing"], "no such method"),
        ([*command, "--surfels", "0"], "ITERATIONS:SURFELS"),
        ([*command, "--surfels", "--presets"], "no cells"),
    ):
        assert frontier.main(changed) == 2
        assert word in capsys.readouterr().err
    with pytest.raises(SystemExit):
        frontier.main([])


# ---------- A fit ----------


def test_fit_leaves_out_validation_views_and_scores_them_at_full_size(
    balls: Path, tiny: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Dataset] = []

    def spy(method: Any, views: Dataset, *arguments: Any, **options: Any) -> Any:
        seen.append(views)
        return begin(method, views, *arguments, **options)

    monkeypatch.setattr(fit, "begin", spy)
    found = fit.fitted(Cell(str(balls), str(tiny), "6:60", 2, 4, 0, None))
    assert [view.name for view in seen[0].views] == [f"train/r_{i}" for i in range(1, 8)]
    assert (found["views"], found["validation_views"], found["surfels"]) == (7, 2, 45)
    assert (found["width"], found["height"]) == (SIZE // 2, SIZE // 2)
    assert (found["full_width"], found["full_height"]) == (SIZE, SIZE)
    assert 10 < found["psnr"] < 40 and 0 < found["ssim"] < 1 and 0 < found["normal_mae_deg"] < 90
    assert found["cpu_seconds"] > 0 and found["peak_bytes"] > 1e8


def test_settings_of_a_cell_are_those_of_its_method(balls: Path, tiny: Path) -> None:
    cell = Cell(str(balls), str(tiny), "60:200", 2, 4, 3, None)
    method = cell.resolved()
    assert (method.iterations, method.seed, method.data.downscale) == (60, 3, 2)
    assert [stage.samples for _, stage in method.stages()] == [4, 4]
    assert cell.described() == {
        "data": "balls",
        "method": "tiny",
        "preset": None,
        "iterations": 60,
        "max_surfels": 200,
        "downscale": 2,
        "samples": 4,
        "seed": 3,
    }
    preset = replace(cell, preset="standard", downscale=None, samples=None).described()
    assert (preset["preset"], preset["iterations"], preset["downscale"]) == ("standard", 4_000, 1)


def test_process_says_why_a_cell_cannot_be_fitted(tmp_path: Path) -> None:
    cell = Cell(str(tmp_path / "none"), "ref_gaussian", "6:60", None, None, 0, 1)
    assert "no such folder" in fit.measure(cell)["failed"]


# ---------- The front ----------

POINTS = [(10, 20.0), (20, 25.0), (30, 24.0), (40, 25.0), (50, 26.0), (60, 25.9)]
"""CPU seconds and PSNR: the first, second and fifth are on the front."""


def test_front_of_known_points() -> None:
    settings = page.settings_of([row(None, *point) for point in reversed(POINTS)], "balls")
    assert [setting.seconds for setting in settings] == [10, 20, 30, 40, 50, 60]
    assert [(one.seconds, one.psnr) for one in page.front(settings)] == [(10, 20), (20, 25), (50, 26)]
    assert page.front(settings[2:3]) == settings[2:3] and page.front([]) == []


def test_seeds_are_averaged_with_their_spread() -> None:
    rows = [row(None, 10, 20.0), row(None, 10, 21.0, seed=1), row(None, 20, 22.0)]
    first, second = page.settings_of(rows, "balls")
    assert first.psnr == 20.5 and first.spread() == pytest.approx(0.5**0.5) and second.spread() is None
    [found] = [line for line in text_of(rows)["tables"].splitlines() if line.startswith("| tiny, 10 ×")]
    assert "| 20.50 ± 0.71 |" in found


def verdict(preset: tuple[float, float], *others: tuple[float, float], seeds: int = 1) -> page.Verdict:
    rows = [row(None, *other, seed=seed) for other in others for seed in range(seeds)]
    rows += [row("quick", *preset, seed=seed) for seed in range(seeds)]
    [found] = page.verdicts(page.settings_of(rows, "balls"))
    return found


def test_presets_that_miss_the_front() -> None:
    found = verdict((30, 24.0), (10, 24.2), (20, 25.0), (40, 30.0))
    assert found.margin == pytest.approx(-1.0)
    assert found.text() == (
        "misses the front by 1.00 dB (tiny, 20 × 100); "
        "tiny, 10 × 100 reaches its PSNR in 1/3.0 of the CPU time"
    )


def test_presets_on_the_front() -> None:
    assert verdict((5, 10.0), (10, 20.0)).text() == "on the front: no other setting is as cheap"
    found = verdict((30, 26.0), (10, 20.0), (20, 25.0), (40, 30.0))
    assert found.margin == pytest.approx(1.0)
    assert found.text() == "on the front, 1.00 dB above tiny, 20 × 100"


def test_small_differences_require_seeds() -> None:
    """0.3 dB: not clear with one seed; with two it is if it is larger than the spread of both."""
    assert "not clear" in verdict((30, 24.7), (20, 25.0)).text()
    assert "not clear" in verdict((30, 25.3), (20, 25.0)).text()
    assert "not clear" not in verdict((30, 24.7), (20, 25.0), seeds=2).text()
    noisy = [row(None, 20, 24.6), row(None, 20, 25.4, seed=1)]
    preset = [row("quick", 30, 24.7), row("quick", 30, 24.7, seed=1)]
    [found] = page.verdicts(page.settings_of([*noisy, *preset], "balls"))
    assert "not clear" in found.text()


# ---------- The page ----------


def text_of(rows: list[Row]) -> dict[str, Any]:
    return page.page({"rows": rows, "failed": [], "version": "1", "code": "0123456789abcdef"})


def test_page_and_plot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From stored data; every table gives the sizes of images."""
    rows = [row(None, *point) for point in POINTS] + [row("quick", 35, 24.5), row("standard", 70, 27.0)]
    rows += [found | {"data": "cubes", "normal_mae_deg": 12.34} for found in rows]
    build = recorded(dict)["build"]
    result = {"build": build, "rows": rows, "failed": [], "seconds": 90.0}
    stored = tmp_path / "frontier.json"
    stored.write_text(json.dumps(result | {"version": "0.1.0", "code": "0123456789abcdef"}))
    assert frontier.main(["--json", str(stored), "-o", str(tmp_path / "out")]) == 0
    text = (tmp_path / "out" / "frontier.md").read_text()
    assert not re.search(r"\{\{|\}\}|\bnan\b|\binf\b|\bNone\b", text)
    assert "2 of 4 fits with a preset are on the Pareto front" in text and "one seed only" in text
    assert text.count("validation views of 20 × 30 pixels, 7 fitted views") == 2
    tables = [part for part in text.split("\n\n") if part.startswith("| ")]
    assert len(tables) == 3 and all("| 10 × 15 |" in line for t in tables for line in t.splitlines()[2:])
    assert "| 20 × 30 |" in tables[0] and "12.3" in tables[2] and "12.3" not in tables[1]
    assert [line.endswith("● |") for line in tables[1].splitlines()[2:]] == [
        *(True, True, False, False, False, True, False, True)
    ]
    (link,) = re.findall(r"\]\((images/\w+\.png)\)", text)
    assert (tmp_path / "out" / link).stat().st_size > 10_000


def test_page_with_seeds_does_not_claim_one() -> None:
    rows = [row(None, *point, seed=seed) for point in POINTS for seed in (0, 1)]
    assert "at least 2 seeds" in text_of(rows)["seeds"]
    assert "one seed only" in text_of(rows[:-1])["seeds"]
