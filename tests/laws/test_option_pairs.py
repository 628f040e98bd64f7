"""Every two values of any two options in some image: the float64 reference's, with its derivatives.

Without `-m slow`, each value once; with `--hypothesis-profile thorough`, every three values of three options.
"""

import re
from functools import cache
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.plugins.aovs import suffixes
from mi_refgs.reference.models import MODELS as REFERENCE_MODELS
from mi_refgs.render.load_scene import reason
from mi_refgs.shade.options import QUALITY, TRACED
from mi_refgs.shade.reflectance import MODELS
from tests.helpers import with_grad
from tests.laws.covering import Case, combinations_of, completed, covering_array, marked
from tests.laws.option_cases import ACCURACY, DIMENSIONS, RULES, spec
from tests.laws.option_oracle import Oracle
from tests.laws.option_scenes import AROUND, Built, Values, build, values

SEED = 3
IMAGE = 3e-4  # largest error of a pixel, relative to its channel's largest value, and 1 at least
DERIVATIVE = 5e-3  # of a derivative, relative to a channel's largest; of a sum, to the root of its squares
STEP = 1e-6  # of central differences of the reference, in units of normal numbers
KEPT = 0.75  # share of the pixels outside the reference's declared discontinuities, at least
GROUPS = {
    "position": "shape", "rotation": "shape", "scale": "shape", "opacity": "shape",
    "curvature": "curvature",
    "background": "background", "light": "light", "data": "light", "radiance": "light",
    "brightness": "the light's scale",
}  # fmt: skip


@cache
def cases(strength: int = 2) -> list[Case]:
    return covering_array(DIMENSIONS, RULES, strength, SEED)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "case" in metafunc.fixturenames:
        found = cases(3 if metafunc.config.getoption("--hypothesis-profile") == "thorough" else 2)
        pairs = enumerate(zip(found, marked(found), strict=True))
        metafunc.parametrize("case", [pytest.param(case, id=str(i), marks=m) for i, (case, m) in pairs])


def group(name: str) -> str:
    """Values that are moved together."""
    return "surroundings" if name.startswith(AROUND) else GROUPS.get(name, "materials")


def test_images_and_derivatives_of_all_pairs_of_options(case: Case, tmp_path: Path, set_threads: Any) -> None:
    try:
        check(case, tmp_path, set_threads)
    except Exception as error:
        error.add_note(f"case: {spec(case)}")
        raise


def check(case: Case, folder: Path, set_threads: Any) -> None:
    first = values(case)
    built, oracle = build(case, first, folder), Oracle(case, first)
    set_threads(case["threads"])  # once Mitsuba has read its EXR files: with one thread it waits forever
    expected, kept = oracle.image(first), ~oracle.undecided()
    assert kept.mean() > KEPT
    samples = 0 if case["input"] == "xml" else case["samples"]
    moving = [n for n in built.parameters if not (n == "data" and case["map"] == "9 x 14")]  # is resampled
    leaves = {} if case["derivative"] == "none" else attached(built, moving)
    with_prior = case["derivative"] == "reverse with a prior"
    prior = sum((total(leaf) for leaf in leaves.values()), mi.Float(0)) if with_prior else mi.Float(0)
    image = mi.render(built.scene, mi.traverse(built.scene), sensor=built.sensor, spp=samples)
    compare(image.numpy(), expected, kept)
    rng = np.random.default_rng(5)
    tangent = {name: rng.normal(size=np.shape(first[name])) for name in moving}

    if case["derivative"] == "none":
        if case["component_format"] != "uint32":
            written = np.array(built.sensor.film().bitmap(), np.float64).reshape(image.shape)
            np.testing.assert_allclose(written, image.numpy(), rtol=1e-3, atol=1e-3)
    elif case["derivative"] == "forward":
        for name, leaf in leaves.items():
            dr.set_grad(leaf, type(leaf)(like(leaf, tangent[name])))
        compare(dr.forward_to(image).numpy(), moved_by(oracle, first, tangent), kept, DERIVATIVE, 0.05)
    else:
        weight = rng.normal(size=expected.shape) * kept[..., None] / np.maximum(1, abs(expected).max((0, 1)))
        dr.backward(dr.sum(image * mi.TensorXf(weight.astype(np.float32)), axis=None).array + prior)
        slopes: dict[str, float] = {}
        for name, leaf in leaves.items():
            gradient = dr.grad(leaf).numpy().ravel() - with_prior
            slope = float(np.sum(gradient * like(leaf, tangent[name]).ravel()))
            slopes[group(name)] = slopes.get(group(name), 0.0) + slope
        for kind, slope in slopes.items():
            moved = weight * moved_by(oracle, first, {n: x for n, x in tangent.items() if group(n) == kind})
            assert abs(np.sum(moved) - slope) < DERIVATIVE * np.linalg.norm(moved) + 1e-6, kind


def attached(built: Built, moving: list[str]) -> dict[str, Any]:
    params = mi.traverse(built.scene)
    keys = {name: built.parameters[name] for name in moving}
    leaves = with_grad({name: type(params[key])(dr.detach(params[key])) for name, key in keys.items()})
    for name, key in keys.items():
        params[key] = leaves[name]
    params.update()
    return leaves


def total(leaf: Any) -> Any:
    """The sum of all numbers (mi.Float) of a leaf, as a prior of a user gathers them."""
    if not isinstance(leaf, mi.TensorXf):
        return dr.sum(leaf, axis=None)
    return dr.sum(dr.gather(mi.Float, leaf.array, dr.arange(mi.UInt32, dr.width(leaf.array))))


def like(leaf: Any, tangent: np.ndarray) -> np.ndarray:
    """A tangent of a value as one of the parameter: of its rows, its inner columns, its constant."""
    if isinstance(leaf, mi.TensorXf):
        shape = tuple(leaf.shape)
        if len(shape) == 3 and tangent.ndim == 1:
            tangent = np.broadcast_to(tangent, shape)
        elif len(shape) == 3 and shape[1] == tangent.shape[1] + 2:  # Mitsuba repeats a column on either side
            tangent = np.pad(tangent, ((0, 0), (1, 1), (0, 0)))
    return np.ascontiguousarray(tangent, np.float32)


def moved_by(oracle: Oracle, first: Values, tangent: Values) -> np.ndarray:
    """The image's derivative in a direction, by central differences of the reference."""
    moved = ({n: first[n] + sign * STEP * x for n, x in tangent.items()} for sign in (1, -1))
    above, below = (oracle.image(first | values) for values in moved)
    return (above - below) / (2 * STEP)


def compare(
    found: np.ndarray, expected: np.ndarray, kept: np.ndarray, tolerance: float = IMAGE, least: float = 1.0
) -> None:
    assert found.shape == expected.shape and np.isfinite(found).all()
    limit = tolerance * np.maximum(least, np.abs(expected[kept]).max(0))
    worst = np.abs(found - expected)[kept].max(0) / limit
    assert worst.max() <= 1, f"errors of the channels in tolerances: {np.round(worst, 2)}"


def test_every_pair_is_there() -> None:
    found = {c for case in cases() for c in combinations_of({n: [v] for n, v in case.items()}, 2)}
    for combination in combinations_of(DIMENSIONS, 2):
        allowed = completed(dict(combination), DIMENSIONS, RULES) is not None
        assert allowed == (combination in found), combination
    assert not any(rule.broken(case) for case in cases() for rule in RULES)


def test_every_registered_thing_is_an_option() -> None:
    assert not {*QUALITY} - {*TRACED} - {*ACCURACY}
    assert {name.partition("/")[0] for name in DIMENSIONS["shading"]} == {*MODELS} <= {*REFERENCE_MODELS}
    assert {*suffixes()} == {
        "albedo", "metallic", "roughness", "tint", "normal", "depth", "alpha", "visibility", "diffuse",
        "specular", "indirect", "confidence",
    }  # fmt: skip


def test_what_does_not_go_together_is_refused_in_a_sentence(tmp_path: Path) -> None:
    refusals = [rule for rule in RULES if rule.refusal]
    for rule in refusals:
        forbidden = combinations_of({name: DIMENSIONS[name] for name in rule.names}, len(rule.names))
        others = [other for other in RULES if other.names != rule.names]
        for combination in forbidden:
            if not rule.broken(dict(combination)):
                continue
            case = completed(dict(combination) | {"input": "tensors"}, DIMENSIONS, others)
            assert case is not None
            with pytest.raises(Exception) as info:
                build(case, values(case), tmp_path)
            sentence = reason(info.value)
            assert re.search(rule.refusal, sentence) and "\n" not in sentence, (spec(case), sentence)
