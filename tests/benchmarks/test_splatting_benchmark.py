"""The benchmark of the splatter: counts, errors and fits are what they say. No times are tested."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.splatting import __main__ as measure
from benchmarks.splatting.cases import Workload, sphere
from benchmarks.splatting.renderers import Ours, Volprim
from benchmarks.stability import measure as stability
from benchmarks.stability.cases import Case, sky
from benchmarks.stability.exact import product_order, scene_of
from mi_refgs.reference import image as reference

BENCHMARK = "splatting"


@pytest.mark.slow
def test_small_instance_is_consistent(result: dict[str, Any]) -> None:
    """Counts are ordered, times exceed their bounds, errors are small."""
    assert len(result["rows"]) == 4
    for row in result["rows"]:
        assert 0 < row["contributing"] <= row["evaluated"] <= 16 * row["pairs"]
        assert row["bound_forward_ms"] < row["forward_ms"] and row["bound_both_ms"] < row["both_ms"]
    for stage in result["step"].values():
        assert {"project", "tile lists", "splat forward", "splat backward"} <= set(stage["phases_ms"])
    for row in result["errors"]:
        assert row["image"] <= 1e-4 and row["left_out"] < 0.2 and row["order"] < 1e-5
        assert all(0 < row[f"gradient_{name}"] <= 1e-3 for name in measure.CLASSES)


def opaque(count: int, size: int, spread: float) -> Workload:
    """A sphere of nearly opaque surfels, at which pixels end early; the image is no multiple of the tile."""
    workload = sphere(count, size, spread)
    return replace(workload, raw=workload.raw | {"opacity": np.full((count, 1), 5, np.float32)})


@pytest.mark.parametrize("make", [opaque, sphere])
def test_counts_match_reference(make: Any) -> None:
    workload = make(300, 30, 1.5)
    raw = workload.raw | {"radiance_sh": workload.features[:, :3]}
    case = Case("view", raw, workload.pinhole, sky(), at="surfel", reflectance="radiance")
    pixels = np.arange(workload.pixels)
    shown = reference.render(scene_of(case, pixels, product_order(case, pixels))).shown
    counts = Ours.of(workload, 0).counts()
    assert counts.contributing == pytest.approx(shown.sum(), rel=2e-3)  # float32 may decide otherwise
    if make is opaque:
        assert counts.evaluated < 0.9 * 16 * counts.pairs  # or this would not test that pixels end


def test_volprim_shows_the_same_object() -> None:
    """White surfels: its image is the coverage, up to where in a pixel it samples and its own cut."""
    workload = sphere(300, 32, 1.5)
    white = replace(workload, features=np.ones_like(workload.features))
    alpha = Ours.of(white, 3).forward()[-1].numpy().reshape(32, 32)
    image = Volprim(white).forward().numpy()[..., :3].mean(axis=2)
    inner = alpha > 0.999
    assert inner.mean() > 0.2 and np.abs(alpha - image)[inner].mean() < 0.01
    assert image.mean() == pytest.approx(alpha.mean(), rel=0.06)


@pytest.mark.parametrize("name", ["position", "opacity"])
def test_gradient_error_is_detected(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    original = stability.product

    def spoilt(*arguments: Any) -> stability.Found:
        found = original(*arguments)
        return replace(found, gradients=found.gradients | {name: 1.1 * found.gradients[name]})

    monkeypatch.setattr(stability, "product", spoilt)
    found = measure.compare(sphere(300, 48, 1.5), 16)
    assert found[f"gradient_{name}"] > 1e-2
    others = [other for other in measure.CLASSES if other != name]
    assert max(found[f"gradient_{other}"] for other in others) < 1e-3 and found["image"] < 1e-4
