"""Numbers of the pages are those of the data files in benchmarks/results, each table of one build.

What is not measured yet is listed in stale.toml.
"""

from __future__ import annotations

import re
import tomllib
from argparse import Namespace
from collections import Counter
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from benchmarks import all as everything
from benchmarks import pages
from benchmarks.common.build import RESULTS, merged, read_result, recorded, write_result
from benchmarks.fits import page as fits
from benchmarks.fits.plan import GROUPS, RING, SOURCES, Fit
from mi_refgs.errors import InputError
from mi_refgs.evaluation.scores import PIXEL_CLASSES
from tests.helpers import ROOT, run_process

TEXTS = {page: (ROOT / page).read_text(encoding="utf-8") for page in pages.PAGES}
FIT_FIELDS = [field.name for field in fields(Fit)]
STALE: dict[str, Any] = tomllib.loads(pages.STALE.read_text(encoding="utf-8"))


# ---------- The pages ----------


def test_pages_are_what_their_data_files_say() -> None:
    """`python -m benchmarks.pages` would change nothing; rows of several builds are refused."""
    for path, text in pages.rewritten().items():
        assert path.read_text(encoding="utf-8") == text, f"{path}: run python -m benchmarks.pages"


def test_missing_data_files_are_listed() -> None:
    """Those of markers and of whole pages; `benchmarks.all` measures each."""
    named = set().union(*map(pages.files_of, TEXTS.values()), pages.TEMPLATES)
    assert {name for name in named if not (RESULTS / f"{name}.json").is_file()} == set(STALE["files"])
    assert named == {part.name for part in everything.PARTS}


@pytest.mark.parametrize("page", pages.PAGES)
def test_measured_numbers_have_a_data_file(page: str) -> None:
    """Numbers outside of markers are listed in stale.toml."""
    listed = [*STALE["numbers"][page], *STALE["settings"][page]]
    assert Counter(pages.unmarked(TEXTS[page])) == Counter(listed)


@pytest.mark.parametrize("page", pages.PAGES)
def test_tables_of_markers_have_a_caption_of_their_files(page: str) -> None:
    text = re.sub(
        r"<!-- \w+\.\w+ -->\n\n\|.*?<!-- / -->", "", TEXTS[page], flags=re.DOTALL
    )  # generated tables
    parts = text.split("\n\n")
    for part, following in zip(parts, [*parts[1:], ""], strict=True):
        if part.startswith("|") and pages.MARKER.search(part):
            assert pages.files_of(part) <= pages.files_of(f"{following}<!-- / -->"), part
    assert not re.search(r"^<!-- \w+\.\w+ -->.", text, flags=re.MULTILINE), "HTML at the start of a line"


# ---------- What finds a mistake ----------


def row(**values: Any) -> dict[str, Any]:
    """The row of a fit as `benchmarks.fits.measure` leaves it."""
    keys = (*fits.NUMBERS, "error_budget")
    found = {"source": RING.source, "method": "auto", "preset": "quick", "threads": 1, "decisions": []}
    found |= dict.fromkeys(keys, None) | {"psnr": 28.04, "train_seconds": 90.0, "build": "abc"}
    return found | values


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """A folder with two data files of one build."""
    build = recorded(dict)["build"] | {"commit": "abc", "clean": True}
    first = {"build": build, "seconds": 1.0, "rows": [row(), row(psnr=30.04), row(source="chair")]}
    write_result(tmp_path / "front.json", first)
    write_result(tmp_path / "viewer.json", {"build": build, "seconds": 1.0, "result": {"a": [{"b": 7}]}})
    return tmp_path


def test_markers_are_filled(results: Path) -> None:
    names = ("front.mirror_ring_auto_psnr", "viewer.a_0_b", "kill.not_measured")
    text = " ".join(f"<!-- {name} -->?<!-- / -->" for name in names)
    assert re.sub(r"<!--.*?-->", "", pages.filled(text, results)) == "28.0 dB 7 ?"
    found = pages.filled("<!-- front.table -->?<!-- / -->", results)
    assert "| 29.0 dB ± 1.4 dB |" in found and "*Commit abc, " in found and "load " in found
    assert pages.filled(found, results) == found
    with pytest.raises(InputError, match="correct the marker"):
        pages.filled("<!-- front.nothing -->?<!-- / -->", results)


@pytest.mark.parametrize("group", GROUPS)
def test_every_table_can_be_made(group: str) -> None:
    budget = {"background": {"pixels": 0.5, "squared_error": 0.1, "normal_mae_deg": None}}
    trial = {"component": "surfels_2x", "stays": True, "with_it": {"psnr": 3.0}, "without": {"psnr": 2.0}}
    whole = {
        "error_budget": budget,
        "error_budget_samples": budget,
        "decisions": [trial],
        "relit": {"sky": 9.0},
    }
    made = fits.values(
        group, {"build": {"commit": "abc"}, "rows": [row(**whole), row(source="chair", **whole)]}
    )
    assert made["table"].count("\n") == (2 if group == "methods" else 3) and "50.0 %" in made["budget"]
    assert made["budget_background_pixels"] == "50.0 %"
    assert ("+1.0 dB: chosen" in made["table"]) == (group == "decisions")


def test_rows_and_tables_of_several_builds_are_refused(results: Path) -> None:
    result = {"build": {"commit": "abc"}, "rows": [row(), row(build="abd")]}
    with pytest.raises(InputError, match="several builds"):
        fits.values("front", result)
    first = pages.values(results / "viewer.json")["about"]
    with pytest.raises(InputError, match="abc and abd; measure all with one"):
        merged([first, first | {"commit": "abd"}])


def test_unmarked_numbers_are_found() -> None:
    text = "| time, ms |\n|---|\n| 4 |\n\n1.5 dB, `2 ms`, <!-- a.b -->3 s<!-- / -->, 200², 5 % and 7°."
    assert pages.unmarked(text) == ["| time, ms |", "1.5 dB", "5 %", "7°"]


# ---------- The command ----------


def test_fits_exist() -> None:
    """Scenes and methods; no two fits share a folder."""
    for fit in {fit for fits_of in GROUPS.values() for fit in fits_of}:
        source = SOURCES[fit.source]
        assert source.folder or (ROOT / "scenes" / f"{fit.source}.xml").is_file()
        assert (ROOT / "variants" / f"{fit.method}.toml").is_file()
    all_fits = {fit for group in GROUPS.values() for fit in group}
    assert len({(fit.name, fit.samples) for fit in all_fits}) == len({fit.name for fit in all_fits})


@pytest.mark.parametrize("path", [path for path in sorted(RESULTS.glob("*.json")) if path.stem in GROUPS])
def test_data_files_have_the_planned_fits(path: Path) -> None:
    found = [tuple(row[name] for name in FIT_FIELDS) for row in read_result(path)["rows"]]
    assert found == [tuple(getattr(fit, name) for name in FIT_FIELDS) for fit in GROUPS[path.stem]]


def test_printed_json_becomes_a_data_file(tmp_path: Path) -> None:
    printed, options = tmp_path / "printed", Namespace(small=False, data=None, output=None)
    part = everything.Part("soak", 1, f"json.tool {printed}")
    assert not everything.run(part, options, tmp_path)
    printed.write_text('{"steps": 1000}')
    assert everything.run(part, options, tmp_path)
    assert pages.filled("<!-- soak.steps -->?<!-- / -->", tmp_path) == "<!-- soak.steps -->1,000<!-- / -->"


def test_markers_name_numbers_of_planned_fits() -> None:
    for group, planned in GROUPS.items():
        names = {f"{fit.source}_{fit.method}_{key}" for fit in planned for key in fits.NUMBERS}
        names |= {f"budget_{kind}_{key}" for kind in PIXEL_CLASSES for key in ("pixels", "squared_error")}
        assert pages.names_of(group) <= names | {"table", "budget", "relit_least", "relit_most"}


def test_small_run_continues(tmp_path: Path) -> None:
    """A fit; a second call repeats neither a finished part nor a finished fit."""
    command = ("-m", "benchmarks.all", "--small", "-o", tmp_path, "--only", "images")
    first = run_process(*command)
    assert first.returncode == 0, first.stderr[-3000:]
    assert first.stdout.splitlines()[0].endswith("to do")
    found = pages.filled("<!-- images.table --><!-- / -->", tmp_path)
    assert "`mirror_ring`: gold ring" in found and " dB |" in found
    assert run_process(*command, "--list").stdout.splitlines()[0].endswith("done")
    (tmp_path / "images.json").unlink()
    [path] = (tmp_path / "work").glob("*/*/row.json")
    before = path.stat().st_mtime_ns
    assert run_process(*command).returncode == 0 and (tmp_path / "images.json").is_file()
    assert path.stat().st_mtime_ns == before


@pytest.mark.parametrize("rows", [[], [{"a": 1, "b": "x"}, {"a": 0.5, "b": None}], [{"a": 1}, {"b": 2}]])
def test_data_file_is_read_as_it_was_written(tmp_path: Path, rows: list[dict[str, Any]]) -> None:
    """Rows of the same keys, of different ones, and none."""
    result = {"build": {"commit": "abc"}, "seconds": 1.5, "rows": rows}
    assert write_result(tmp_path / "a.json", result) == result
    assert read_result(tmp_path / "a.json") == result
