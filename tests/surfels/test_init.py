"""Initial surfels from points."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.stats import kstest

from mi_refgs.errors import InputError
from mi_refgs.surfels import init
from mi_refgs.surfels.attributes import SH_DC, Attribute, sigmoid
from tests.helpers import refused, unit


def test_from_points(rng: np.random.Generator) -> None:
    points, normals = rng.normal(size=(200, 3)), rng.normal(size=(200, 3))
    normals[0] = (0, 0, 5)
    colours = rng.random((200, 3))
    degree = {"radiance_sh": 1}
    surfels = init.from_points(points, normals, colours, rng=rng, degree=degree, opacity=0.2, roughness=0.3)
    surfels.validate()
    np.testing.assert_allclose(np.array(surfels.frame()[2]).T, unit(normals), atol=1e-6)
    squared = np.sort(np.sum((points[:, None] - points[None]) ** 2, axis=-1), axis=1)[:, 1:4]
    np.testing.assert_allclose(np.array(surfels.scale())[0], np.sqrt(squared.mean(axis=1)), rtol=1e-5)
    np.testing.assert_allclose(np.array(surfels.value("radiance_sh")[0]).T * SH_DC + 0.5, colours, atol=1e-6)
    np.testing.assert_allclose(np.array(surfels.opacity()), 0.2, rtol=1e-6)
    np.testing.assert_allclose(np.array(surfels.value("roughness")), 0.3, rtol=1e-6)
    assert np.abs(np.array(surfels.value("albedo")) - 0.5).max() <= 0.0251
    assert np.all(surfels.to_numpy()["indirect_sh"] == 0) and surfels.sh_degree() == 1


def test_random_rotations_are_uniform(rng: np.random.Generator) -> None:
    """The mean normal of 20000 uniform rotations is 0 to 3 / √20000, its second moment 1/3."""
    normal = np.array(init.from_points(rng.random((20000, 3)), rng=rng, attributes=()).frame()[2])
    assert np.abs(normal.mean(axis=1)).max() < 0.02
    np.testing.assert_allclose(normal @ normal.T / 20000, np.eye(3) / 3, atol=0.02)


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_few_or_doubled_points_have_finite_scales(count: int, rng: np.random.Generator) -> None:
    points, normals = np.ones((count, 3)), np.zeros((count, 3))
    surfels = init.from_points(points, normals, rng=rng, attributes=("radiance_sh",))
    surfels.validate()
    assert surfels.count == count
    assert list(surfels.raw) == ["position", "rotation", "scale", "opacity", "radiance_sh"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"normals": np.zeros((3, 3))}, r"normals: shape \(3, 3\), expected \(4, 3\)"),
        ({"points": np.full((4, 3), np.nan)}, "points: 12 values are NaN"),
        ({"degree": {"radiance_sh": 4}}, "degree of radiance_sh: 4"),
        ({"opacity": 1.5}, r"opacity: 1\.5"),
        ({"attributes": ("albdeo",)}, "albdeo.* is unknown"),
        ({"scale": 0.1}, "scale: follows from the points"),
        ({"attributes": ["albedo"], "roughness": 0.3}, "roughness: .* not in `attributes`"),
    ],
)
def test_bad_points_are_refused(change: dict[str, object], message: str, rng: np.random.Generator) -> None:
    with pytest.raises(InputError, match=message):
        init.from_points(**({"points": np.zeros((4, 3)), "rng": rng} | change))  # type: ignore[arg-type]


def test_random_normals_are_uniform(rng: np.random.Generator) -> None:
    normals = init.random_normals(20_000, rng)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(normals.T @ normals / 20_000, np.eye(3) / 3, atol=0.02)
    assert all(kstest(axis, "uniform", (-1, 2)).pvalue > 1e-3 for axis in normals.T)  # Archimedes


def test_attribute_starts_at_its_activated_value(rng: np.random.Generator) -> None:
    activate: dict[Any, Callable[..., np.ndarray]] = {
        "exp": np.exp, "sigmoid": sigmoid, "identity": np.asarray
    }  # fmt: skip
    for kind, function in activate.items():
        declared = Attribute("width", (2,), kind, 1e-3, ("w_0", "w_1"), initial=0.2)
        for value in (None, 0.7, np.linspace(0.1, 0.9, 10).reshape(5, 2)):
            raw = declared.start(5, 2, rng, value)
            assert raw.shape == (5, 2)
            np.testing.assert_allclose(function(raw), 0.2 if value is None else value, rtol=1e-6)
    size, given = Attribute("width", (2,), "exp", 1e-3, ("w_0", "w_1")), np.arange(1.0, 4)
    np.testing.assert_allclose(np.exp(size.start(3, 1, rng, given)), [[1], [2], [3]])
    refused(partial(size.start, 3, 2, rng, given), "width: shape (3,); give one number, or an array (3, 2)")
    for value in (0.0, -1.0, np.inf):
        refused(partial(size.start, 1, 1, rng, value), "width: ", " is out of range; start it above 0")


def test_harmonics_start_with_a_constant_part(rng: np.random.Generator) -> None:
    surfels = init.from_points(rng.random((5, 3)), rng=rng, degree={"indirect_sh": 1}, indirect_sh=0.4)
    raw = surfels.to_numpy()["indirect_sh"]
    np.testing.assert_allclose(raw[:, :3] * 0.28209479, 0.4, rtol=1e-6)
    assert np.all(raw[:, 3:] == 0)


def steps(points: np.ndarray) -> float:
    """Mean distance from each point to the next."""
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).mean())


@pytest.mark.parametrize("outlier", [False, True])
def test_morton_order_puts_neighbours_together(rng: np.random.Generator, outlier: bool) -> None:
    """Consecutive points of 4096 are about a cell apart, 1/16 of the edge."""
    points = rng.uniform(-1, 3, (4096, 3)).astype(np.float32)
    if outlier:
        points[7] = 1e6
    order = init.morton_order(points)
    assert sorted(order) == list(range(4096))
    kept = points[order][:-1] if outlier else points[order]
    assert steps(kept) < 0.15 * 4 < 0.4 * steps(rng.uniform(-1, 3, (4096, 3)))


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.ones((1, 3)), np.ones((5, 3))])
def test_morton_order_keeps_points_without_extent(points: np.ndarray) -> None:
    np.testing.assert_array_equal(init.morton_order(points), np.arange(len(points)))
