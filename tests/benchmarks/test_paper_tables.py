"""The tables of the paper: which figures are whose, and ours below them."""

from pathlib import Path

import pytest

from benchmarks import paper_tables
from benchmarks.paper_tables import TABLES, place_of
from mi_refgs.compare.table import Row, Scene, Statistic, Table
from mi_refgs.errors import InputError
from mi_refgs.methods import load, names

PLACES = {
    "data/ball": ("Shiny Blender", "ball"),
    "data/chair_400": ("NeRF-Synthetic", "chair"),
    "ref_real/gardenspheres": ("Ref-Real", "garden"),
    "ShinyBlender/teapot": ("Shiny Blender", "teapot"),
    "data/teapot_glossy": ("Glossy Synthetic", "teapot"),
    "data/teapot": None,
    "data/glass_ball": None,
}


def test_scenes_are_recognised_by_folder_name() -> None:
    assert {folder: place_of(Path(folder)) for folder in PLACES} == PLACES


def test_methods_name_rows_of_the_paper() -> None:
    known = {s for t in TABLES.values() for systems in t["metrics"].values() for s in systems}
    rows = {name: load(name).about.paper_row for name in names()}
    assert rows["ref_gaussian"] == "Ref-Gaussian" and set(rows.values()) <= known | {""}
    for name, row in rows.items():  # a row that a file inherits is another method's
        assert load(name).about.name.startswith("w/o") == row.startswith("w/o"), name


def scene_of(name: str, psnr: float, seconds: float) -> Scene:
    """A scene of the paper with one finished row."""
    row = Row("mine", "Mine", seeds=[0], runs=["run"], paper_row="Ref-Gaussian")
    row.numbers = {"psnr": Statistic.of([psnr]), "train_seconds": Statistic.of([seconds])}
    return Scene(name, name, rows=[row])


def test_paper_table_contains_our_figures() -> None:
    ours = Table([scene_of("ball", 36.0, 1800), scene_of("car", 30.0, 5400)])
    found = paper_tables.compared(1, ours)
    lines = {line.title: line for line in found.lines["psnr"]}
    assert lines["  ours: mine"].values == (36.0, 30.0, *[None] * 15)
    assert lines["  ours − paper"].values[:2] == pytest.approx((36.0 - 37.01, 30.0 - 31.04))
    assert found.missing["Shiny Blender"] == ["coffee", "helmet", "teapot", "toaster"]
    assert len(found.missing["Glossy Synthetic"]) == 8 and len(found.missing["Ref-Real"]) == 3
    assert [line.title for line in found.lines["ssim"] if "ours" in line.title] == []
    text = paper_tables.text(1, ours)
    assert "shiny_blender/toaster" in text and "shiny_blender/ball" not in text and "-1.01" in text

    means = paper_tables.compared(6, ours)
    by_title = {line.title: line.values for line in means.lines["psnr"]}
    assert by_title["  ours: mine"] == (33.0,) and by_title["  ours − paper"] == (None,) and means.partial
    hours = {line.title: line.values for line in paper_tables.compared(2, ours).lines["train_hours"]}
    assert hours["  ours: mine"] == (1.0,)


def test_table_without_runs() -> None:
    text = paper_tables.text(5, None)
    assert "NeRO (published)" in text and "29.73" in text and "glossy_synthetic/tbell" in text
    with pytest.raises(InputError, match="give one of 1, 2"):
        paper_tables.compared(9, None)
