"""Environment maps of surfaces at finite distances: directions against geometry, files, bad values."""

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.errors import InputError
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.lobe_matrices import map_directions
from mi_refgs.shade.light.near_field import LocalLight, NearField
from tests.helpers import unit, vector, with_grad

CENTRE = np.array([0.4, -0.3, 0.2])
COUNT = 2000


@pytest.fixture(scope="module")
def rays() -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) up to 0.5 from the centre, and unit directions."""
    rng = np.random.default_rng(0)
    point, direction = (unit(x) for x in rng.normal(size=(2, COUNT, 3)))
    return CENTRE + 0.5 * rng.random((COUNT, 1)) * point, direction


def towards(field: NearField, point: np.ndarray, direction: np.ndarray) -> np.ndarray:
    return np.array(field.seen_from(mi.Point3f(vector(point)), vector(direction))).T


def degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip(np.sum(a * b, axis=1), -1, 1)))


def test_round_room(rays: tuple[np.ndarray, np.ndarray]) -> None:
    """Exact where the distance is the same everywhere; infinitely far, the direction of the ray."""
    point, direction = rays
    offset = point - CENTRE
    along = np.sum(offset * direction, axis=1)
    t = np.sqrt(along**2 + 1.5**2 - np.sum(offset**2, axis=1)) - along
    expected = (offset + t[:, None] * direction) / 1.5
    found = towards(NearField(CENTRE, np.full((4, 8), 1 / 1.5)), point, direction)
    np.testing.assert_allclose(found, expected, atol=2e-6)
    far = NearField(CENTRE, np.zeros((4, 8)))
    np.testing.assert_allclose(towards(far, point, direction), direction, atol=1e-6)


def test_box_room(rays: tuple[np.ndarray, np.ndarray]) -> None:
    """A room of 2 × 3 × 4 around the centre, the floor 0.6 below: half a degree, not ten."""
    low, high = np.array([-1.0, -1.5, -0.6]), np.array([1.0, 1.5, 3.4])

    def distance(origin: np.ndarray, ray: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore"):
            return np.asarray(np.max([(low - origin) / ray, (high - origin) / ray], axis=0).min(axis=-1))

    point, direction = rays
    offset = point - CENTRE
    expected = unit(offset + distance(offset, direction)[:, None] * direction)
    field = NearField(CENTRE, 1 / distance(np.zeros(3), map_directions(64)))
    error = degrees(towards(field, point, direction), expected)
    assert degrees(direction, expected).mean() > 8 and error.mean() < 0.5 and np.median(error) < 0.1


def test_derivatives_are_those_of_the_lookup(rays: tuple[np.ndarray, np.ndarray]) -> None:
    """Forward mode against central differences; at borders of texels the two sides differ."""
    nearness = 1 / (1.5 + 0.5 * np.sin(3 * map_directions(32)).prod(axis=-1))
    field, step = NearField(CENTRE, nearness), np.random.default_rng(3).normal(size=(2, COUNT, 3))
    x, δ = np.array(rays), 2e-3
    position = with_grad(mi.Point3f(vector(x[0])), mi.Point3f(vector(step[0])))
    found = dr.forward_to(field.seen_from(position, with_grad(vector(x[1]), vector(step[1]))))
    expected = (towards(field, *(x + δ * step)) - towards(field, *(x - δ * step))) / (2 * δ)
    error = np.linalg.norm(np.array(found).T - expected, axis=1)
    assert error.mean() < 0.01 * np.linalg.norm(expected, axis=1).mean()


def test_points_beyond_surfaces_stay_finite() -> None:
    """A fit may place surfels behind its own walls."""
    point = CENTRE + np.array([[5.0, 0, 0], [0, 0.5, 0], [0, 0, 0]])
    field = NearField(CENTRE, np.full((4, 8), 2.0))
    for direction in np.concatenate([np.eye(3), -np.eye(3)]):
        found = towards(field, point, np.broadcast_to(direction, (3, 3)))
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)


def test_local_light_moves_reflections_but_not_irradiance() -> None:
    light = EnvironmentLight.from_radiance(np.random.default_rng(1).random((16, 32, 3))).prefilter()
    local = LocalLight(light, NearField(CENTRE, np.ones((4, 8))), mi.Point3f([0.9], [-0.3], [0.2]))
    up, moved = mi.Vector3f(0, 0, 1), mi.Vector3f(0.5, 0, 0.75**0.5)
    for found, expected in (
        (local.radiance(up), light.radiance(moved)),
        (local.specular(up, mi.Float(0.3)), light.specular(moved, mi.Float(0.3))),
        (local.irradiance(up), light.irradiance(up)),
    ):
        np.testing.assert_allclose(np.array(found), np.array(expected), rtol=1e-4)


def test_file(tmp_path: Path) -> None:
    """Written and read unchanged; whatever is no near field is refused by the file's name."""
    path, field = tmp_path / "near_field.npz", NearField(CENTRE, np.random.default_rng(2).random((8, 16)))
    field.write(path)
    again = NearField.read(path)
    assert np.array_equal(again.centre, CENTRE)
    assert np.array_equal(again.nearness, field.nearness.astype(np.float32))
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(InputError, match=r"near_field\.npz: near field: cannot be read"):
        NearField.read(path)
    for values, words in (
        ({"centre": CENTRE}, "cannot be read"),
        ({"centre": CENTRE, "nearness": -np.ones((8, 16))}, "negative"),
        ({"centre": np.full(3, np.nan), "nearness": np.ones((4, 8))}, "not finite"),
        ({"centre": CENTRE, "nearness": np.ones((4, 9))}, "shapes"),
    ):
        np.savez(path, **values)
        with pytest.raises(InputError, match=rf"near_field\.npz: near field: .*{words}"):
            NearField.read(path)
