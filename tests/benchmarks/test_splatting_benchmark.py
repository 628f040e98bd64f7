"""The benchmark of the splatter runs; its counts, errors and fits are what they say. No times are tested."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.common.report import where
from benchmarks.common.timing import milliseconds
from benchmarks.frontier import __main__ as frontier
from benchmarks.memory import __main__ as memory
from benchmarks.splatting import measure, page
from benchmarks.splatting.__main__ import main
from benchmarks.splatting.cases import Workload, sphere
from benchmarks.splatting.renderers import Ours, Volprim
from benchmarks.stability import __main__ as stability_page
from benchmarks.stability import measure as stability
from benchmarks.stability.cases import Case, sky
from benchmarks.stability.exact import product_order, scene_of
from mi_refgs.profiling.profile import Counts
from mi_refgs.reference import image as reference
from mi_refgs.reference.camera import rotation_axes
from mi_refgs.splat import list_by_tile, project
from mi_refgs.surfels.table import Surfels

BENCHMARK = "splatting"
Row = dict[str, Any]


def opaque(count: int, size: int, spread: float = 1.5) -> Workload:
    """A sphere of nearly opaque surfels, at which pixels end early; the image is no multiple of the tile."""
    workload = sphere(count, size, spread)
    raw = workload.raw | {"opacity": np.full((count, 1), 5, np.float32)}
    return replace(workload, raw=raw)


# ---------- The small instance ----------


def test_reports_are_written(folder: Path, result: dict[str, Any]) -> None:
    text = (folder / "splatting.md").read_text()
    assert not re.search(r"\bnan\b|\binf\b|\bNone\b", text)
    links = re.findall(r"\]\((images/splatting_\w+\.png)\)", text)
    assert len(links) == 2 and all((folder / link).stat().st_size > 10_000 for link in links)
    assert len(result["rows"]) == 4
    for row in result["rows"]:
        assert page.label(row) in text


def test_counts_are_ordered(result: dict[str, Any]) -> None:
    for row in result["rows"]:
        assert 0 < row["contributing"] <= row["evaluated"] <= 16 * row["pairs"]
        assert row["covered"] <= min(row["pixels"], row["contributing"])
        assert row["share"] == pytest.approx(row["contributing"] / row["evaluated"])
        assert row["misses_forward"] == row["misses_both"] == 0
        assert 0 < row["launches_forward"] <= row["launches_both"]
        assert 0 < row["bytes_forward"] < row["bytes_both"]
    large, small = (where(result["rows"], surfels=2000, size=size)[0] for size in (64, 32))
    assert 3 < large["contributing"] / small["contributing"] < 5  # four times the pixels


def test_times_exceed_their_bounds(result: dict[str, Any]) -> None:
    for row in result["rows"]:
        assert row["bound_forward_ms"] < row["forward_ms"] and row["bound_both_ms"] < row["both_ms"]
    for stage in result["step"].values():
        assert set(measure.PHASES) <= set(stage["phases_ms"])


def test_errors_are_small(result: dict[str, Any]) -> None:
    for row in result["errors"]:
        assert row["image"] <= 1e-4 and row["left_out"] < 0.2 and row["order"] < 1e-5
        assert all(0 < row[f"gradient_{name}"] <= 1e-3 for name in measure.CLASSES)


def test_bad_input_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--small", "--quiet", "--scene", str(tmp_path), "-o", str(tmp_path / "out")]) == 2
    assert "config.toml" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", [main, memory.main, stability_page.main, frontier.main])
def test_help_is_printed(command: Any, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        command(["--help"])
    assert "--json FILE" in capsys.readouterr().out


# ---------- Counts ----------


def exact(workload: Workload) -> np.ndarray:
    """What contributes (N, P) by the float64 reference in the product's order."""
    raw = workload.raw | {"radiance_sh": workload.features[:, :3]}
    case = Case("view", raw, workload.pinhole, sky(), at="surfel", reflectance="radiance")
    pixels = np.arange(workload.pixels)
    return reference.render(scene_of(case, pixels, product_order(case, pixels))).shown


@pytest.mark.parametrize("make", [opaque, sphere])
def test_counts_match_reference(make: Any) -> None:
    workload = make(300, 30, 1.5)
    counts, shown = Ours.of(workload, 0).counts(), exact(workload)
    assert counts.contributing == pytest.approx(shown.sum(), rel=2e-3)  # float32 may decide otherwise
    assert counts.covered == pytest.approx(shown.any(axis=0).sum(), abs=2)
    assert np.abs(np.array(counts.pixels_of_surfel) - shown.sum(axis=1)).max() <= 2
    p, (width, height) = workload.pinhole, workload.camera().tile
    tiles = (np.arange(p.width) // width) + -(-p.width // width) * (np.arange(p.height) // height)[:, None]
    held = np.array([[shown[:, (tiles == t).ravel()].any(1)] for t in range(tiles.max() + 1)])
    assert held.sum() <= counts.visited <= counts.pairs  # what contributes was visited
    if make is opaque:
        assert counts.visited < 0.9 * counts.pairs  # or this would not test that pixels end


def test_bytes_and_lower_bound_are_linear_in_counts() -> None:
    counts = Counts(10, 16, 16, 100, 50, 400, 16, None)
    forward = measure.bytes_moved(counts, 14)["forward"]
    assert forward == 24 * 100 + (4 + 4 * 24) * 50 + 4 * 16 * 16
    assert measure.lower_bound(counts, 1.0) == pytest.approx({"forward": 0.024, "both": 0.104})


# ---------- Renderers ----------


def test_surfels_are_tangential_discs() -> None:
    workload = sphere(500, 32, 0.75)
    normal = workload.raw["position"]
    assert np.allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-6)
    third = rotation_axes(workload.raw["rotation"])[2]
    assert np.abs(np.abs(np.sum(third * normal, axis=1)) - 1).max() < 1e-5
    assert np.allclose(np.exp(workload.raw["scale"]), 0.75 * np.sqrt(4 * np.pi / 500), rtol=1e-6)
    assert np.allclose(Surfels.from_numpy(workload.raw).opacity().numpy(), 0.8, atol=1e-6)


def test_volprim_shows_the_same_object() -> None:
    """White surfels: its image is the coverage, up to where in a pixel it samples and its own cut."""
    workload = sphere(500, 48, 1.5)
    white = replace(workload, features=np.ones_like(workload.features))
    alpha = Ours.of(white, 3).forward()[-1].numpy().reshape(48, 48)
    image = Volprim(white).forward().numpy().mean(axis=2)
    inner = alpha > 0.999
    assert inner.mean() > 0.3 and np.abs(alpha - image)[inner].mean() < 0.01
    assert image.mean() == pytest.approx(alpha.mean(), rel=0.05)
    gradients = Volprim(white).both()
    assert all(np.abs(gradient.numpy()).max() > 0 for gradient in gradients)


# ---------- Errors ----------


@pytest.mark.parametrize("name", measure.CLASSES)
def test_gradient_error_is_detected(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    original = stability.product

    def spoilt(*arguments: Any) -> stability.Found:
        found = original(*arguments)
        return replace(found, gradients=found.gradients | {name: 1.1 * found.gradients[name]})

    workload = sphere(300, 48, 1.5)
    sound = measure.compare(workload, 16)
    assert max(sound[f"gradient_{other}"] for other in measure.CLASSES) < 1e-3
    monkeypatch.setattr(stability, "product", spoilt)
    assert measure.compare(workload, 16)[f"gradient_{name}"] > 1e-2


def test_wrong_order_is_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    original = stability.product_order
    monkeypatch.setattr(stability, "product_order", lambda *arguments: original(*arguments)[::-1])
    assert measure.compare(sphere(300, 48, 1.5), 16)["order"] > 1e-3


def test_reference_includes_surfels_around_the_crop() -> None:
    """Else it would not miss one that no tile lists."""
    workload, listed = sphere(300, 48, 1.5), []
    for margin in (0, measure.MARGIN):
        part = measure.crop(workload, 16, margin)
        lists = list_by_tile(project(part.surfels(), part.camera()), part.camera())
        listed.append(set(np.array(lists.surfel_from_pair).tolist()))
    assert listed[0] < listed[1]


# ---------- Fits, turns ----------


def test_linear_fit_recovers_coefficients() -> None:
    rng = np.random.default_rng(0)
    rows = [dict(zip("abc", rng.uniform(1, 1e6, size=3), strict=True)) for _ in range(12)]
    for row in rows:
        row["y"] = 5e6 + 3 * row["a"] + 40 * row["b"]
    found = measure.plane(rows, "y", "abc")
    expected = {"constant": 5e6, "a": 3, "b": 40}
    assert all(found[key] == pytest.approx(value, rel=1e-3) for key, value in expected.items())
    assert found["c"] < 1e-2 and found["r2"] > 0.9999


def test_slow_calls_run_in_fewer_rounds() -> None:
    met: list[str] = []
    slow = {"slow": (lambda: met.append("s"), 2)}
    found = milliseconds({"fast": lambda: met.append("f")}, 1e-9, 5, slow)
    assert "".join(met) == "fs" + "fsfs" + "fff" and found.keys() == {"fast", "slow"}
