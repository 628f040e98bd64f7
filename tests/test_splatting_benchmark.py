"""The benchmark of the splatter runs; its counts, errors and fits are what they say. No times are tested."""

from __future__ import annotations

import csv
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmark_runs import read_result, small_instance  # first: it lets `benchmarks` be found

from benchmarks.splatting import errors, fits, limits, raster, targets
from benchmarks.splatting.__main__ import main
from benchmarks.splatting.baseline import baseline
from benchmarks.splatting.ours import Ours
from benchmarks.splatting.turns import turns
from benchmarks.splatting.volprim import Volprim
from benchmarks.splatting.workload import FEATURES, Workload, sphere
from mi_refgs.constants import ALPHA_MIN, TRANSMITTANCE_MIN
from mi_refgs.profiling.counts import Counts
from mi_refgs.reference import splat as oracle
from mi_refgs.reference.blend import differentiate
from mi_refgs.reference.pinhole import rotation_matrix
from mi_refgs.splat import list_by_tile, project
from mi_refgs.surfels.table import Surfels

Row = dict[str, Any]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output of the small instance."""
    return small_instance("splatting", tmp_path_factory.mktemp("splatting"))


@pytest.fixture(scope="module")
def result(folder: Path) -> dict[str, Any]:
    """Its JSON."""
    return read_result("splatting", folder)


def opaque(count: int, size: int, spread: float = 1.5) -> Workload:
    """A sphere of nearly opaque surfels, at which pixels end early; the image is no multiple of the tile."""
    workload = sphere(count, size, spread)
    raw = workload.raw | {"opacity": np.full((count, 1), 5, np.float32)}
    return replace(workload, raw=raw)


# ---------- The small instance ----------


def test_reports_are_written(folder: Path, result: dict[str, Any]) -> None:
    page = (folder / "splatting.md").read_text()
    assert not re.search(r"\bnan\b|\binf\b|\bNone\b", page)
    links = re.findall(r"\]\((images/splatting_\w+\.png)\)", page)
    assert len(links) == 2 and all((folder / link).stat().st_size > 10_000 for link in links)
    with (folder / "splatting.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(result["rows"]) == 4
    for row in result["rows"]:
        assert targets.label(row) in page


def test_counts_are_ordered(result: dict[str, Any]) -> None:
    for row in result["rows"]:
        assert 0 < row["contributing"] <= row["evaluated"] <= 16 * row["pairs"]
        assert row["covered"] <= min(row["pixels"], row["contributing"])
        assert row["share"] == pytest.approx(row["contributing"] / row["evaluated"])
        assert row["misses_forward"] == row["misses_both"] == 0
        assert 0 < row["launches_forward"] <= row["launches_both"]
        assert 0 < row["bytes_forward"] < row["bytes_both"]
    large, small = (targets.where(result["rows"], surfels=2000, size=size)[0] for size in (64, 32))
    assert 3 < large["contributing"] / small["contributing"] < 5  # four times the pixels


def test_every_renderer_and_stage_is_timed(result: dict[str, Any]) -> None:
    first = targets.where(result["rows"], surfels=200, size=32)[0]
    for key in ("forward", "both", "colour_both", "volprim_forward", "volprim_both", "raster_forward"):
        assert first[f"{key}_ms"] > 0
    for row in result["rows"]:
        assert all(row[f"{stage}_ms"] > 0 for stage in ("project", "bin", "blend", "adjoint"))
        assert row["bound_forward_ms"] < row["forward_ms"] and row["bound_both_ms"] < row["both_ms"]


def test_errors_are_within_the_promise(result: dict[str, Any]) -> None:
    for row in result["errors"]:
        assert row["image_max"] <= targets.IMAGE_ERROR and row["left_out"] < 0.2 and row["order"] < 1e-5
        assert all(row[f"gradient_{name}"] <= targets.GRADIENT_ERROR for name in errors.PARAMETERS)


def test_a_run_can_become_the_starting_point(result: dict[str, Any]) -> None:
    kept = baseline(result)
    assert len(kept["cases"]) == 4 and kept["stages"].keys() == {"initial", "deferred"}
    stage, old = result["step"]["stages"]["deferred"], kept["stages"]["deferred"]
    assert sum(old["stages_ms"].values()) == pytest.approx(sum(stage["stages_ms"].values()))


def test_bad_input_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--small", "--quiet", "--scene", str(tmp_path), "-o", str(tmp_path / "out")]) == 2
    assert "config.toml" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


# ---------- Counts ----------


def brute_force(workload: Workload) -> tuple[int, int]:
    """(Pairs visited, contributing) by our lists: a surfel after the other, in NumPy float64."""
    camera, p = workload.camera(), workload.pinhole
    footprints = project(workload.surfels(), camera)
    lists = list_by_tile(footprints, camera)
    pairs, begin, end = (
        np.array(x).astype(int) for x in (lists.surfel_from_pair, lists.pair_begin, lists.pair_end)
    )
    slopes, placed, _ = raster.project({k: v.astype(float) for k, v in workload.raw.items()}, p)
    visited = contributing = 0
    width, height = camera.tile
    for tile in range(lists.tiles_x * lists.tiles_y):
        left, top = width * (tile % lists.tiles_x), height * (tile // lists.tiles_x)
        x, y = (v.ravel() + 0.5 for v in np.meshgrid(left + np.arange(width), top + np.arange(height)))
        going = (x < p.width) & (y < p.height)
        transmittance = np.ones(len(x))
        for surfel in pairs[begin[tile] : end[tile]]:
            if not going.any():
                break
            visited += 1
            dx, dy = x - placed[surfel, 1], y - placed[surfel, 2]
            u, v, w = (slopes[surfel, 2 * i] * dx + slopes[surfel, 2 * i + 1] * dy for i in range(3))
            plane = (u * u + v * v) / (placed[surfel, 0] + w) ** 2
            alpha = placed[surfel, 3] * np.exp(-0.5 * np.minimum(plane, 12 * (dx * dx + dy * dy)))
            alpha = np.minimum(alpha, 0.99)
            hit = going & (alpha >= ALPHA_MIN)
            ends = hit & (transmittance * (1 - alpha) < TRANSMITTANCE_MIN)
            hit &= ~ends
            going &= ~ends
            contributing += int(hit.sum())
            transmittance = np.where(hit, transmittance * (1 - alpha), transmittance)
    return visited, contributing


@pytest.mark.parametrize("make", [opaque, sphere])
def test_counts_are_those_of_brute_force(make: Any) -> None:
    workload = make(300, 30, 1.5)
    counts = Ours.of(workload, 0).counts()
    visited, contributing = brute_force(workload)
    assert counts.visited == pytest.approx(visited, abs=3)  # float32 may decide otherwise at a cut
    assert counts.contributing == pytest.approx(contributing, rel=1e-3)
    assert int(np.sum(counts.pixels_of_surfel.numpy())) == counts.contributing
    if make is opaque:
        assert visited < 0.9 * counts.pairs  # or this would not test that pixels end


def test_contributing_pairs_are_the_oracle_s() -> None:
    workload = opaque(300, 28)
    raw = {name: values.astype(float) for name, values in workload.raw.items()}
    weights = np.zeros((FEATURES + 2, workload.pixels))
    truth = differentiate(raw, workload.features.astype(float), workload.pinhole, weights)
    counts = Ours.of(workload, 0).counts()
    assert counts.contributing == pytest.approx(truth.shown.sum(), rel=2e-3)
    assert counts.covered == pytest.approx(truth.shown.any(axis=0).sum(), abs=2)


def test_bytes_and_bound_grow_with_what_they_stand_for() -> None:
    counts = Counts(10, 16, 16, 100, 50, 400, 16, None)
    forward = limits.bytes_moved(counts, 14)["forward"]
    assert forward == 24 * 100 + (4 + 4 * 24) * 50 + 4 * 16 * 16
    assert limits.lower_bound(counts, 1.0) == pytest.approx({"forward": 0.024, "both": 0.104})


# ---------- Renderers ----------


def test_surfels_are_tangential_discs() -> None:
    workload = sphere(500, 32, 0.75)
    normal = workload.raw["position"]
    assert np.allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-6)
    third = np.stack([rotation_matrix(q)[:, 2] for q in workload.raw["rotation"]])
    assert np.abs(np.abs(np.sum(third * normal, axis=1)) - 1).max() < 1e-5
    assert np.allclose(np.exp(workload.raw["scale"]), 0.75 * np.sqrt(4 * np.pi / 500), rtol=1e-6)
    assert np.allclose(Surfels.from_numpy(workload.raw).opacity().numpy(), 0.8, atol=1e-6)


def test_numpy_rasteriser_shows_our_picture() -> None:
    workload = opaque(400, 30)
    out = Ours.of(workload, FEATURES).forward()
    ours = np.stack([image.numpy() for image in out], axis=1)
    plain = raster.forward(workload, FEATURES).reshape(ours.shape)
    assert np.abs(ours - plain).max() < 1e-4


def test_volprim_shows_the_same_object() -> None:
    """White surfels: its picture is the coverage, up to where in a pixel it samples and its own cut."""
    workload = sphere(500, 48, 1.5)
    white = replace(workload, features=np.ones_like(workload.features))
    alpha = Ours.of(white, 3).forward()[-1].numpy().reshape(48, 48)
    picture = Volprim(white).forward().numpy().mean(axis=2)
    inner = alpha > 0.999
    assert inner.mean() > 0.3 and np.abs(alpha - picture)[inner].mean() < 0.01
    assert picture.mean() == pytest.approx(alpha.mean(), rel=0.05)
    gradients = Volprim(white).both()
    assert all(np.abs(gradient.numpy()).max() > 0 for gradient in gradients)


# ---------- Errors ----------


def test_exact_form_is_the_oracle() -> None:
    workload = errors.crop(opaque(60, 40), 12)
    raw = {name: values.astype(float) for name, values in workload.raw.items()}
    features = workload.features.astype(float)
    weights = np.random.default_rng(0).normal(size=(FEATURES + 2, workload.pixels))

    def maps(channels: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        found = oracle.splat(channels, features, workload.pinhole, band=1e-2)
        images = [found.features, found.depth[..., None], found.alpha[..., None]]
        return np.concatenate(images, axis=-1).reshape(-1, FEATURES + 2), found.band.ravel()

    expected, band = maps(raw)
    weights[:, band] = 0
    truth = differentiate(raw, features, workload.pinhole, weights)
    assert np.abs(truth.maps - expected).max() < 1e-12
    surfel = int(np.argmax(np.abs(truth.gradients["opacity"])))
    for name, gradient in truth.gradients.items():
        if name == "features":
            continue
        for column in range(gradient.shape[1]):
            sides = []
            for step in (1e-6, -1e-6):
                moved = raw | {name: raw[name].copy()}
                moved[name][surfel, column] += step
                sides.append(np.sum(weights.T * maps(moved)[0]))
            slope = (sides[0] - sides[1]) / 2e-6
            scale = np.abs(truth.gradients[name]).max()
            assert gradient[surfel, column] == pytest.approx(slope, abs=1e-5 * scale), name


@pytest.mark.parametrize("name", errors.PARAMETERS)
def test_a_planted_gradient_error_is_seen(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    original = Ours.both

    def spoilt(self: Ours) -> list[Any]:
        out = original(self)
        place = len(out) - len(self.raw) - len(self.columns)
        if name == "features":
            out[place + len(self.raw)] = out[place + len(self.raw)] * 1.1
        else:
            place += list(self.raw).index(name)
            out[place] = out[place] * 1.1
        return out

    workload = sphere(300, 48, 1.5)
    assert max(v for key, v in errors.compare(workload, 16).items() if "gradient" in key) < 1e-3
    monkeypatch.setattr(Ours, "both", spoilt)
    found = errors.compare(workload, 16)
    assert found[f"gradient_{name}"] > 1e-2


def test_a_wrong_order_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    original = errors._order
    workload = sphere(300, 48, 1.5)
    monkeypatch.setattr(errors, "_order", lambda *arguments: original(*arguments)[::-1])
    assert errors.compare(workload, 16)["order"] > 1e-3


# ---------- Fits, turns, verdicts ----------


def test_fits_find_what_was_put_in() -> None:
    rng = np.random.default_rng(0)
    rows = [dict(zip("abc", rng.uniform(1, 1e6, size=3), strict=True)) for _ in range(12)]
    for row in rows:
        row["y"] = 5e6 + 3 * row["a"] + 40 * row["b"]
    found = fits.plane(rows, "y", "abc")
    expected = {"constant": 5e6, "a": 3, "b": 40}
    assert all(found[key] == pytest.approx(value, rel=1e-3) for key, value in expected.items())
    assert found["c"] < 1e-2 and found["r2"] > 0.9999
    line = fits.line([1, 10, 100], [5, 23, 203])
    assert line["a"] == pytest.approx(3) and line["b"] == pytest.approx(2)
    assert line["decades"] == pytest.approx(2) and line["r2"] == pytest.approx(1)
    assert fits.line([1, 10, 100], [0, 5, 0])["r2"] < 0.5


def test_slow_calls_take_fewer_turns() -> None:
    met: list[str] = []
    calls = {"fast": (lambda: met.append("f"), 5), "slow": (lambda: met.append("s"), 2)}
    found = turns(calls, 10.0)
    assert "".join(met) == "fs" + "fsfs" + "fff" and found.keys() == calls.keys()


def test_verdicts_say_no_where_it_is_no() -> None:
    assert targets.at_least("x", 2, 2.5).met and not targets.at_least("x", 2, 1.5).met
    assert targets.at_most("x", 2, 1.5).met and not targets.at_most("x", 2, 2.5).met
    row = {
        "case": "sphere", "surfels": 50_000, "size": 512, "spread": 1.5,
        "volprim_both_ms": 600.0, "both_ms": 60.0, "share": 0.5,
    }  # fmt: skip
    said = {verdict.what: verdict for verdict in targets._of_cases([row])}
    assert [verdict.met for verdict in said.values()] == [False, True, True]
