"""The table and the plot of PSNR against seconds, from folders as `refgs compare` leaves them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import quality

CURVE = [(10.0, 20.0), (20.0, 30.0), (40.0, 34.0), (60.0, 33.5)]
"""Seconds and dB."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    run = tmp_path / "after" / "runs" / "chair" / "ref_gaussian" / "seed0"
    run.mkdir(parents=True)
    lines = [{"iteration": i, "seconds": s, "psnr": p} for i, (s, p) in enumerate(CURVE)]
    (run / "curve.jsonl").write_text(
        "\n".join(map(json.dumps, lines)) + '\n{"iterat'
    )  # a kill left half a line
    (run / "metrics.json").write_text('{"psnr": 33.25}')
    return tmp_path / "after"


def test_seconds_to_reach_psnr(folder: Path) -> None:
    (fit,) = quality.fits(folder)
    assert (fit.folder, fit.data, fit.method, fit.seed) == ("after", "chair", "ref_gaussian", "seed0")
    assert fit.reached(15.0) == 10 and fit.reached(36.0) is None
    assert fit.reached(25.0) == pytest.approx(15) and fit.reached(33.0) == pytest.approx(35)
    assert fit.final == 33.25


def test_table_and_plot_are_written(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = folder / "quality.png"
    assert quality.main([str(folder), "--at", "33", "36", "-o", str(image)]) == 0
    row = capsys.readouterr().out.splitlines()[2]
    assert row == "| chair | ref_gaussian | seed0 | after | 35 | – | 60 | 33.25 |"
    assert image.stat().st_size > 5_000
    with pytest.raises(SystemExit):
        quality.main([str(folder.parent)])
