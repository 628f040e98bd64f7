"""Open scenes: object, surroundings and background in one image, against float64."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from benchmarks.stability import exact
from mi_refgs.kernels.device import upload_tensor
from mi_refgs.render.display import displayed, srgb_from_linear
from mi_refgs.render.pipeline import Frame, SurfelScene, render
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.table import Surfels
from tests.helpers import with_grad
from tests.scenes.integrator import scattered_discs
from tests.scenes.open_pair import CASES, MAPS, Pair, weighted


@pytest.fixture(scope="module", params=CASES, ids=lambda case: " ".join(map(str, case)))
def pair(request: pytest.FixtureRequest) -> Pair:
    return Pair(*request.param)


def test_image_matches_float64(pair: Pair) -> None:
    """Radiance, alpha and depth of both; share and materials of the object; the background by its rays."""
    maps, band = pair.truth(pair.values)
    planes = pair.planes({name: upload_tensor(x) for name, x in pair.values.items()})
    assert np.mean(~band) > 0.9 and 0.1 < np.mean(maps["object_alpha"] / maps["alpha"].clip(1e-3) > 0.5) < 0.9
    for name in MAPS:
        found = np.stack([np.broadcast_to(np.array(x), len(band)) for x in planes[name]], 1)
        keep = ~band & (np.abs(maps["object_alpha"][:, 0] - 1e-3) > 5e-4)  # COVERAGE_FLOOR
        tolerance = 2e-4 * np.abs(maps[name]).max()
        np.testing.assert_allclose(found[keep], maps[name][keep], atol=tolerance, err_msg=name)


def test_both_derivative_modes_are_those_of_float64(pair: Pair) -> None:
    """Each class of parameters along a random direction, against central differences in float64."""
    params = with_grad({name: upload_tensor(x) for name, x in pair.values.items()})
    dr.backward(weighted(pair.planes(params), pair.weights))
    adjoint = {name: np.asarray(dr.grad(x).numpy(), np.float64) for name, x in params.items()}

    rng, step = np.random.default_rng(3), 1e-7
    for name, values in pair.values.items():
        direction = rng.normal(size=values.shape).astype(np.float32)
        moved = (np.asarray(values, np.float64) + sign * step * direction for sign in (1, -1))
        sides = [pair.loss(pair.values | {name: side}) for side in moved]
        expected = (sides[0] - sides[1]) / (2 * step)
        size = max(abs(expected), 0.05 * float(np.linalg.norm(adjoint[name])))
        assert np.sum(adjoint[name] * direction) == pytest.approx(expected, abs=0.01 * size), name

        fresh = {key: upload_tensor(x) for key, x in pair.values.items()}
        with_grad(fresh[name], upload_tensor(direction))
        total = weighted(pair.planes(fresh), pair.weights)
        forward = dr.forward_to(total, flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)  # 0 if it has none
        assert forward.numpy()[0] == pytest.approx(expected, abs=0.01 * size), name


def test_what_lies_behind_is_exposed_as_the_rest_is() -> None:
    """Composited in linear radiance, whatever the images are; a gain is of object and background alike."""
    half = mi.Float([0.5, 0.5])
    frame = Frame(half, half, None, mi.Color3f(0.1), background=mi.Color3f(0.4, 0.2, 0.0))
    gain = [mi.Float(2), mi.Float(1), mi.Float(1)]
    for linear in (False, True):
        planes = displayed(frame, np.ones(3), linear, gain)
        for plane, value in zip(planes, (2 * (0.1 + 0.5 * 0.4), 0.1 + 0.5 * 0.2, 0.1), strict=True):
            np.testing.assert_allclose(plane, srgb_from_linear(mi.Float([value] * 2)), rtol=1e-6)


def test_empty_models_render_nothing_and_screened_ones_skip_unusable_surfels() -> None:
    pair = Pair("pixel", "sh")
    params = {name: upload_tensor(x) for name, x in pair.values.items()}
    own = {name: params[name] for name in pair.case.raw}
    others = {name: np.array(x) for name, x in scattered_discs().items()}
    light = EnvironmentLight(params["light"]).prefilter()
    eye, shading = exact.fast_camera(pair.case), Shading("pixel", "split_sum", "sh")

    def radiance(surroundings: Surroundings | None) -> np.ndarray:
        frame = render(SurfelScene(Surfels(own), shading, light, surroundings=surroundings), eye)
        return np.array(frame.radiance)

    alone = radiance(None)
    empty = Surfels.from_numpy({name: x[:0] for name, x in others.items()})
    np.testing.assert_allclose(radiance(Surroundings(empty)), alone, atol=1e-6)
    kept = radiance(Surroundings(Surfels.from_numpy({n: x[:3] for n, x in others.items()})))
    for name in ("position", "radiance_sh"):  # that show nothing by themselves, and that would show
        broken = {n: x.copy() for n, x in others.items()}
        broken[name][3:] = np.nan
        screened = Surfels(Surfels.from_numpy(broken).raw, screened=True)
        np.testing.assert_allclose(radiance(Surroundings(screened)), kept, atol=1e-6)
    assert np.abs(kept - alone).max() > 0.05
