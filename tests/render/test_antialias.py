"""Reflections averaged over a pixel: the float64 reference, and the quadrature."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.kernels.device import upload
from mi_refgs.reference.image import bilinear_map
from mi_refgs.render.antialias import averaged
from mi_refgs.shade.points import RadianceTerms, ShadingPoints
from mi_refgs.shade.shading import Shading
from tests.helpers import refused
from tests.scenes.splats import seen_from

WIDTH, HEIGHT = 9, 7
NODES = np.polynomial.legendre.leggauss(2)[0] / 2  # the Gauss-Legendre rule's two, pixels from the centre


@pytest.fixture
def maps(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Premultiplied normals, alpha with holes, at the border too, and visibility of 0 or 1."""
    alpha = rng.uniform(0.2, 1, (HEIGHT, WIDTH, 1))
    alpha[[0, 2, 5, 6], [3, 2, 8, 0]] = 0
    alpha[3:6, 3:6] = 0  # a pixel whose neighbours are empty, too
    normal = rng.normal(size=(HEIGHT, WIDTH, 3)) * alpha
    return {"normal": normal, "alpha": alpha, "visibility": 1.0 * (rng.random(alpha.shape) > 0.5)}


def columns(values: np.ndarray) -> list[mi.Float]:
    return [upload(np.ascontiguousarray(plane)) for plane in np.moveaxis(values, -1, 0)]


def radiance(points: ShadingPoints) -> RadianceTerms:
    """Radiance that is cubic in normal and visibility."""
    n, v = points.normal, points.visibility
    return RadianceTerms(specular=mi.Color3f(n.x * n.y, n.z * v, v * v * v))


def found(normal: list[mi.Float], alpha: mi.Float, seen: mi.Float, interpolate: bool = True) -> mi.Color3f:
    view = replace(seen_from(0.0, 0.3, 3.0, size=WIDTH), height=HEIGHT)
    points = ShadingPoints(mi.Vector3f(*normal), -dr.normalize(view.rays()), visibility=seen)
    return averaged(radiance, points, alpha, view, None, interpolate).specular


def expected(maps: dict[str, np.ndarray]) -> np.ndarray:
    """The same (H·W, 3) in float64."""
    y, x = (axis.ravel() + 0.5 for axis in np.mgrid[:HEIGHT, :WIDTH])
    total = np.zeros((HEIGHT * WIDTH, 3))
    for dx in NODES:
        for dy in NODES:
            weighted = maps["alpha"] * maps["visibility"]
            n, a, av = (bilinear_map(v, x + dx, y + dy) for v in (maps["normal"], maps["alpha"], weighted))
            v = np.where(a > 0, av / np.where(a > 0, a, 1), 1)[:, 0]
            total += np.stack([n[:, 0] * n[:, 1], n[:, 2] * v, v**3], -1) / 4
    return total


def test_interpolation_against_the_reference(maps: dict[str, np.ndarray]) -> None:
    given = columns(maps["normal"]), columns(maps["alpha"])[0], columns(maps["visibility"])[0]
    np.testing.assert_allclose(found(*given).numpy().T, expected(maps), atol=1e-6)
    centre = found(*given, interpolate=False).numpy()[2].reshape(HEIGHT, WIDTH)
    np.testing.assert_array_equal(centre, maps["visibility"][..., 0])


def test_points_integrate_cubic_radiance_exactly() -> None:
    """With x in pixels, the mean of x² over a pixel is that at its centre and 1/12 more."""
    view = seen_from(0.0, 0.3, 3.0, size=5, focal=4.0)
    rays, alpha = view.rays(), dr.ones(mi.Float, 25)

    def cubic(points: ShadingPoints) -> RadianceTerms:
        local = view.rotation @ -points.view
        x, y = (local.x / local.z * view.fx, local.y / local.z * view.fy)  # from the image's centre
        return RadianceTerms(specular=mi.Color3f(x * x, x * x * x, x * y * y))

    points = ShadingPoints(mi.Vector3f(0, 0, 1) + 0 * rays, -dr.normalize(rays))
    mean = averaged(cubic, points, alpha, view, None, False).specular.numpy()
    y, x = np.mgrid[-2:3, -2:3].reshape(2, -1)
    np.testing.assert_allclose(mean, [x**2 + 1 / 12, x**3 + x / 4, x * (y**2 + 1 / 12)], atol=2e-5)


def test_antialias_requires_deferred_shading() -> None:
    assert Shading().antialiased() == Shading(antialias=True)
    for other in (Shading("surfel"), Shading("surfel", reflectance="radiance")):
        assert other.antialiased() == other
    refused(lambda: Shading("surfel", antialias=True), "antialias: needs shading at pixel")
