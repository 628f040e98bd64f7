"""Numbers of the pages are those of the data files in benchmarks/results, each table of one build."""

import re
from collections import Counter
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from benchmarks import all as everything, pages, plots, tables
from benchmarks.common.build import RESULTS, merged, read_result, recorded, write_result
from benchmarks.fits import GROUPS, SOURCES, TIMED, Fit
from mi_refgs.errors import InputError
from mi_refgs.evaluation.scores import PIXEL_CLASSES
from tests.helpers import ROOT, completed, refused

TEXTS = {page: (ROOT / page).read_text(encoding="utf-8") for page in pages.PAGES}
FIT_FIELDS = [field.name for field in fields(Fit)]


def test_pages_are_what_their_data_files_say() -> None:
    """`python -m benchmarks.pages` would change nothing; rows of several builds are refused."""
    for path, text in pages.rewritten().items():
        assert path.read_text(encoding="utf-8") == text, f"{path}: run python -m benchmarks.pages"


def test_every_data_file_is_displayed_and_measured() -> None:
    """A page has a marker of it, and `benchmarks.all` measures it, but for gpu.sh and a corpus."""
    text = "".join(TEXTS.values())
    for name in plots.PLOTS:
        assert f"](images/{name}.png)" in text and (ROOT / "docs/images" / f"{name}.png").is_file()
    named = set().union(*map(pages.files_of, TEXTS.values()))
    files = {path.stem for path in RESULTS.glob("*.json")} - {"gpu", "corpus"}
    assert named - {"corpus"} == files == {part.name for part in everything.PARTS}


@pytest.mark.parametrize("page", pages.PAGES)
def test_measured_numbers_have_a_data_file(page: str) -> None:
    """Numbers with a unit outside of markers are listed in settings.toml."""
    assert Counter(pages.unmarked(TEXTS[page])) == Counter(pages.SETTINGS[page])


def row(**values: Any) -> dict[str, Any]:
    """The row of a fit as `benchmarks.fits` leaves it."""
    keys = (*tables.NUMBERS, "error_budget")
    found = {"source": TIMED.source, "method": "auto", "preset": "quick", "threads": 1, "decisions": []}
    found |= dict.fromkeys(keys, None) | {"psnr": 28.04, "train_seconds": 90.0, "build": "abc"}
    return found | values


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """A folder with two data files of one build."""
    build = recorded(dict)["build"] | {"commit": "abc", "clean": True}
    first = {"build": build, "seconds": 1.0, "rows": [row(), row(psnr=30.04), row(source="chair")]}
    write_result(tmp_path / "images.json", first)
    write_result(tmp_path / "frames.json", {"build": build, "seconds": 1.0, "frames": [{"frame_ms": 7}]})
    return tmp_path


def test_markers_are_filled(results: Path) -> None:
    names = ("images.mirror_ring_auto_psnr", "frames.frames_0_frame_ms", "relighting.not_measured")
    text = " ".join(f"<!-- {name} -->?<!-- / -->" for name in names)
    assert re.sub(r"<!--.*?-->", "", pages.filled(text, results)) == "28.0 dB 7.00 ?"
    found = pages.filled("<!-- images.table -->?<!-- / -->", results)
    assert "| 29.0 dB ± 1.4 dB |" in found and "*Commit abc, " in found and "load " in found
    assert pages.filled(found, results) == found
    refused(lambda: pages.filled("<!-- images.nothing -->?<!-- / -->", results), "correct the marker")


def test_results_of_several_builds_are_refused(results: Path) -> None:
    with pytest.raises(InputError, match="several builds"):
        tables.fits("images", {"build": {"commit": "abc"}, "rows": [row(), row(build="abd")]})
    first = pages.values(results / "frames.json")["about"]
    refused(lambda: merged([first, first | {"commit": "abd"}]), "abc and abd; measure all with one")


def test_unmarked_numbers_are_found() -> None:
    text = "| time, ms |\n|---|\n| 4 |\n\n1.5 dB, `2 ms`, <!-- a.b -->3 s<!-- / -->, 200², 5 % and 7°."
    assert pages.unmarked(text) == ["| time, ms |", "1.5 dB", "5 %", "7°"]


def test_fits_exist() -> None:
    """Scenes and methods; no two fits share a folder; markers name planned fits."""
    for fit in {fit for fits_of in GROUPS.values() for fit in fits_of}:
        assert SOURCES[fit.source].folder or (ROOT / "scenes" / f"{fit.source}.xml").is_file()
        assert (ROOT / "variants" / f"{fit.method}.toml").is_file()
    for group, planned in GROUPS.items():
        names = {f"{fit.source}_{fit.method}_{key}" for fit in planned for key in tables.NUMBERS}
        names |= {f"budget_{kind}_{key}" for kind in PIXEL_CLASSES for key in ("pixels", "squared_error")}
        assert pages.names_of(group) <= names | {"table", "budget"}


@pytest.mark.parametrize("group", GROUPS)
def test_data_files_have_the_planned_fits(group: str) -> None:
    rows = read_result(RESULTS / f"{group}.json")["rows"]
    found = [tuple(row.get(key, "missing") for key in FIT_FIELDS) for row in rows]
    assert found == [tuple(getattr(fit, key) for key in FIT_FIELDS) for fit in GROUPS[group]]


@pytest.mark.slow
def test_small_run_continues(tmp_path: Path) -> None:
    """A fit; a second call repeats neither a finished part nor a finished fit."""
    command = ("-m", "benchmarks.all", "--small", "-o", tmp_path, "--only", "images")
    completed(*command)
    found = pages.filled("<!-- images.table --><!-- / -->", tmp_path)
    assert "`mirror_ring`: gold ring" in found and " dB |" in found
    assert completed(*command, "--list").splitlines()[0].endswith("done")
    (tmp_path / "images.json").unlink()
    [path] = (tmp_path / "work").glob("*/*/row.json")
    before = path.stat().st_mtime_ns
    completed(*command)
    assert (tmp_path / "images.json").is_file()
    assert path.stat().st_mtime_ns == before
