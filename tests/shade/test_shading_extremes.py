"""Shading at the limits of its formulas: against the float64 reference, and conservation of energy."""

from typing import Any

import drjit as dr
import numpy as np
import pytest

from mi_refgs.shade.light.envmap import MIN_HEIGHT, EnvironmentLight
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.reflectance.split_sum import SplitSum
from tests.helpers import AXES, slow, unit, with_grad
from tests.scenes.shading_points import exact_light, exact_terms, points_of, shading_values

N = 24
TERMS = ("diffuse", "specular", "indirect")


def tilted(view: np.ndarray, cosine: float, rng: np.random.Generator) -> np.ndarray:
    """Unit normals at this cosine to unit views."""
    return cosine * view + np.sqrt(1 - cosine**2) * unit(np.cross(view, unit(rng.normal(size=view.shape))))


def mirrored_to(view: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Normals that mirror views to unit targets."""
    return unit(view + target)


def cases(rng: np.random.Generator) -> dict[str, dict[str, Any]]:
    """Values of N points by name, each with some at an end."""
    values = shading_values(rng, ("albedo", "metallic", "roughness", "radiance", "visibility", "indirect"), N)
    values |= {name: unit(values[name]) for name in ("normal", "view")}
    view = values["view"]
    across_the_seam = rng.normal(size=(N, 3)) * (1e-4, 1, 0) + [0, 0, -1]
    changed: dict[str, dict[str, Any]] = {
        **{f"roughness {end}": {"roughness": end} for end in (0.0, 1.0, 1e-6)},
        **{f"metallic {end}": {"metallic": end} for end in (0.0, 1.0)},
        **{f"n·v = {cosine}": {"normal": tilted(view, cosine, rng)} for cosine in (1e-3, 0.0, -0.3)},
        **{f"normals of length {length}": {"normal": length * values["normal"]} for length in (1e-9, 1e15)},
        "black albedo": {"albedo": 0.0, "metallic": 1.0},
        "n = v": {"normal": view},
        "towards the axes": {"normal": mirrored_to(view, AXES[np.arange(N) % 6])},
        "beside the pole": {"normal": mirrored_to(view, unit(rng.normal(size=(N, 3)) * 0.01 + [0, 1, 0]))},
        "beside the map's seam": {"normal": mirrored_to(view, unit(across_the_seam))},
    }
    return {
        name: values | {key: np.broadcast_to(x, values[key].shape).copy() for key, x in ends.items()}
        for name, ends in changed.items()
    }


LIGHTS = {
    "smooth": lambda rng: rng.uniform(0.1, 3, (16, 32, 3)),
    "a peak of 1e6": lambda rng: np.where(rng.random((16, 32, 1)) < 0.01, 1e6, 0.3) * np.ones(3),
    "black": lambda rng: np.zeros((16, 32, 3)),
    "the smallest map": lambda rng: rng.uniform(0.1, 3, (MIN_HEIGHT, 2 * MIN_HEIGHT, 3)),
}


@pytest.mark.parametrize(
    ("light", "diffuse"),
    [("smooth", "sh"), ("a peak of 1e6", "irradiance"), *(slow(light, "irradiance") for light in LIGHTS)],
)
def test_values_and_gradients_at_the_ends(light: str, diffuse: Any, rng: np.random.Generator) -> None:
    """Error ≤ 1e-4 of the brightest term, and gradients to 1 %: terms are at most quadratic up to S = 1, so
    that the reference's central difference is exact."""
    radiance = LIGHTS[light](rng)
    radiance[[0, -1]] = radiance[[0, -1]].mean(axis=1, keepdims=True)  # a pole has no azimuth, so one colour
    prefiltered = EnvironmentLight.from_radiance(radiance).prefilter()
    exact, options = exact_light(prefiltered), ShadingOptions(diffuse=diffuse)
    for name, values in cases(rng).items():
        made = points_of(values)
        keys = ("albedo", "metallic", "radiance", "roughness", "normal")
        leaves = with_grad({key: getattr(made, key) for key in keys})
        terms = SplitSum().shade(made, prefiltered, options)
        found = np.stack([np.broadcast_to(getattr(terms, t).numpy(), (3, N)).T for t in TERMS], 1)
        expected = exact_terms(values, exact, options)
        limit = 1e-4 * max(np.abs(expected).max(), 1e-3)
        np.testing.assert_allclose(found, expected, atol=limit, rtol=1e-4, err_msg=f"{name}, {light}")
        dr.backward(terms.total())
        for key, leaf in leaves.items():
            gradient = np.array(dr.grad(leaf)).reshape(-1, N).T
            assert np.isfinite(gradient).all(), f"{name}, {light}: δ{key}"
            if key not in keys[:3]:
                continue
            for column in range(gradient.shape[1]):
                step = np.zeros_like(values[key])
                step.reshape(N, -1)[:, column] = 5e-3
                sides = (values | {key: values[key] + sign * step} for sign in (1, -1))
                above, below = (exact_terms(side, exact, options).sum((1, 2)) for side in sides)
                slope = 100 * (above - below)
                scale = max(np.abs(slope).max(), 1e-3)
                where = f"{name}, {light}: δ{key}"
                np.testing.assert_allclose(gradient[:, column], slope, atol=1e-2 * scale, err_msg=where)


@pytest.mark.parametrize("dominant", [False, True])
def test_energy_under_a_constant_light_of_1(dominant: bool) -> None:
    """No more than 1 leaves any material at any angle, and a white one without absorption returns all."""
    axes = (np.arange(64) + 0.5) / 64, np.linspace(0, 1, 17), [0, 0.25, 0.5, 0.75, 1], [0, 0.5, 1]
    cosine, roughness, metallic, albedo = (x.ravel() for x in np.meshgrid(*axes, indexing="ij"))
    count = len(cosine)
    normal = np.stack([np.sqrt(1 - cosine**2), 0 * cosine, cosine], 1)
    values = {"normal": normal, "view": np.tile([0.0, 0, 1], (count, 1))}
    values |= {"albedo": np.repeat(albedo[:, None], 3, 1), "metallic": metallic, "roughness": roughness}
    light = EnvironmentLight.constant(1.0, 16).prefilter()
    options = ShadingOptions(diffuse="irradiance", dominant=dominant)
    total = SplitSum().shade(points_of(values), light, options).total().numpy()[0]
    assert total.min() >= 0 and total.max() <= 1 + 1e-3
    assert total[(albedo == 1) & (metallic == 0)].min() >= 1 - 1e-3
