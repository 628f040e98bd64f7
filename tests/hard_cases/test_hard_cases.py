"""The cheap hard cases of `benchmarks.stability` with its limits, and tests of the measurement itself."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.stability import __main__ as run, measure as module, response
from benchmarks.stability.cases import Case, catalogue, plain
from benchmarks.stability.measure import GRADIENTS, IMAGE_LIMIT, Row, measure
from mi_refgs.reference import image as oracle
from mi_refgs.surfels.primitives.surfel import FootprintAdjoint
from tests.helpers import slow

CASES = [case for case in catalogue() if case.quick]
ILL_CONDITIONED = {
    "normals that cancel but for 1e-3",
    "normals that cancel",
    "edge-on, cosine 0.0002",
    "edge-on, cosine 0.001",
    "anisotropy 1e+04, width of 1.5 pixels in a film of 1024²",
    "anisotropy 1e+06, width of 1.5 pixels in a film of 1024²",
    "surfels of 2 pixels in a film of 4096²",
}
"""What may miss the limits, and then only by what one unit in the last place of the inputs explains."""


@pytest.mark.parametrize("case", [*CASES[::2], *map(slow, CASES[1::2])], ids=lambda case: case.name)
def test_case(case: Case) -> None:
    row = measure(case, floors=False)
    assert row.verdict == "within limits" or case.name in ILL_CONDITIONED, row
    assert "FAILS" not in row.verdict, row


@pytest.mark.parametrize("name", ["roughness 0", "mirrors that reflect a pole"])
def test_slope_at_flat_split_sum_table(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The gradient of a mirror's roughness is tiny, and right: not the rounding of interpolated values."""
    monkeypatch.setattr(module, "NEGLIGIBLE", 0.0)
    case = next(case for case in CASES if case.name == name)
    assert measure(case, floors=False).gradients["roughness"] <= 1e-3


@pytest.mark.parametrize("row", response.CURVE, ids=str)
def test_response_curve(row: str) -> None:
    found = response._curve(row, response.CURVE[row])
    assert max(found["value"], found["slope"]) <= IMAGE_LIMIT


@pytest.mark.parametrize("image", response.images(), ids=lambda image: image[0])
def test_losses_of_extreme_images(image: Any) -> None:
    found = response._loss(*image)
    assert not found["non_finite"] and max(found["value"], found["slope"]) <= IMAGE_LIMIT, found


def test_reference_gradients_match_differences() -> None:
    """Complex steps and sums, against central differences of the loss, for every class of parameters."""
    case = plain("plain").rounded()
    pixels = module.chosen_pixels(case)
    scene = module.scene_of(case, pixels, module.product_order(case, pixels))
    weights = module._weights(oracle.render(scene), oracle.render(scene, band=0.02).band)
    exact = module._gradients(case, scene, oracle.render(scene, weights))
    rng = np.random.default_rng(0)

    def loss(values: dict[str, np.ndarray]) -> float:
        raw, light = {name: values[name] for name in scene.raw}, module.light_of(values["light"])
        maps = oracle.render(module.replace(scene, raw=raw, light=light)).maps
        return sum(float(np.sum(w * maps[name])) for name, w in weights.items())

    for name in GRADIENTS:
        step = 1e-8  # smaller than the way to the next texel of the light, where a slope jumps
        values = {**scene.raw, "light": np.asarray(case.light, np.float64)}
        direction = rng.normal(size=values[name].shape)
        sides = [loss(values | {name: values[name] + sign * step * direction}) for sign in (1, -1)]
        expected = (sides[0] - sides[1]) / (2 * step)
        assert np.sum(exact[name] * direction) == pytest.approx(expected, rel=1e-4, abs=1e-6), name


def test_scaled_case_scales_its_mesh() -> None:
    cases = {case.name: case for case in CASES}
    small, plates = cases["mesh and scene times 1e-3"], cases["two plates"]
    for one, other in zip(small.surface, plates.surface, strict=True):
        np.testing.assert_allclose(one, other if one is small.surface[1] else 1e-3 * other, rtol=1e-6)
    assert small.mesh is not None and small.mesh().voxel == pytest.approx(1e-6)


def test_wrong_footprint_gradients_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    right = FootprintAdjoint.columns
    monkeypatch.setattr(FootprintAdjoint, "columns", lambda *given: [1.02 * x for x in right(*given)])
    verdict = measure(plain("plain"), floors=False).verdict
    assert verdict.startswith("FAILS") and "position" in verdict and "image" not in verdict


def test_measured_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["", "--only", "one surfel", "-o", str(tmp_path), "--quiet"])
    assert run.main() == 0
    text = (tmp_path / "stability.json").read_text()
    assert '"one surfel"' in text and '"within limits"' in text and "NaN" not in text


def test_verdicts() -> None:
    def verdict(**changes: Any) -> str:
        given: dict[str, Any] = {
            "name": "", "image": 1e-5, "maps": 1e-5, "gradients": {"scale": 1e-3}, "non_finite": 0,
            "kept": 1.0, "order": 0.0, "image_floor": 0.0, "gradient_floor": {"scale": 0.0},
        }  # fmt: skip
        return Row(**(given | changes)).verdict

    assert verdict() == "within limits"
    assert verdict(image=2e-4).startswith("FAILS: image")
    assert verdict(image=2e-4, image_floor=1e-4).startswith("ill-conditioned: image")
    assert verdict(image=float("nan"), image_floor=1e-4).startswith("FAILS: image")
    assert verdict(gradients={"scale": 0.1}).startswith("FAILS: scale")
    assert verdict(non_finite=1, image_floor=1.0).startswith("FAILS")
    assert verdict(kept=0.1).startswith("FAILS") and verdict(order=1e-3).startswith("FAILS")
