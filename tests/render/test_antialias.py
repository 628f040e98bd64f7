"""Reflections averaged over a pixel: the float64 reference, and the quadrature."""

import itertools
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter

from mi_refgs.kernels.device import upload
from mi_refgs.reference.image import bilinear_map
from mi_refgs.render.antialias import averaged
from mi_refgs.render.pipeline import Request, SurfelScene, render
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.points import RadianceTerms, ShadingPoints
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera
from mi_refgs.surfels.table import Surfels
from tests.helpers import refused
from tests.scenes import corner
from tests.scenes.splats import discs, seen_from

WIDTH, HEIGHT = 9, 7
NODES = np.polynomial.legendre.leggauss(2)[0] / 2  # the Gauss-Legendre rule's two, pixels from the centre


def test_nodes_against_the_reference(rng: np.random.Generator) -> None:
    """Normals and visibility are interpolated, also beside holes and at the border; or rays are traced in and
    beside pixels whose ray is blocked, also partly, one of the centre where all around are blocked and
    normals are equal. Elsewhere all light is visible."""
    alpha = rng.uniform(0.2, 1, (HEIGHT, WIDTH, 1))
    alpha[[0, 2, 5, 6], [3, 2, 8, 0]] = 0
    alpha[3:6, 3:6] = 0  # a pixel whose neighbours are empty, too
    normals, tint = rng.normal(size=(HEIGHT, WIDTH, 3)) * alpha, rng.random(HEIGHT * WIDTH)
    visibility = np.where(rng.random((HEIGHT, WIDTH)) < 0.1, rng.choice([0, 0.99], (HEIGHT, WIDTH)), 1)
    visibility[0, 0] = 0.5
    visibility[4:, 6:], normals[3:, 5:] = 0, [0.3, 0.2, 0.9]
    view = replace(seen_from(0.0, 0.3, 3.0, size=WIDTH), height=HEIGHT)
    given = {"visibility": upload(visibility.ravel()), "tint": upload(tint)}

    def vectors(planes: np.ndarray) -> mi.Vector3f:
        return mi.Vector3f(np.reshape(planes, (-1, 3)).T.astype(np.float32))

    def trace(at: ShadingPoints, of: mi.UInt32) -> ShadingPoints:
        return at.replaced(visibility=at.view.x, indirect=mi.Color3f(at.tint, mi.Float(of), at.normal.z))

    def radiance(at: ShadingPoints) -> RadianceTerms:
        n, seen = at.normal, mi.Color3f(at.visibility)
        return RadianceTerms(mi.Color3f(n.x * n.y, n.z, n.z**3), seen, at.get("indirect"))

    points = ShadingPoints(vectors(normals), -dr.normalize(view.rays()), given)
    near, once = (minimum_filter(visibility, 3) < 1).ravel(), (maximum_filter(visibility, 3) == 0).ravel()
    assert near.any() and not near.all() and once.sum() == 4
    y, x = (axis.ravel() + 0.5 for axis in np.mgrid[:HEIGHT, :WIDTH])

    def expected(normals: np.ndarray) -> np.ndarray:
        total, centre = np.zeros((2, 3, 3, len(tint))), normals[..., 2].ravel()
        for dx, dy in itertools.product(NODES, NODES):
            n = bilinear_map(normals, x + dx, y + dy).T
            diffuse, nothing = [n[0] * n[1], n[2], n[2] ** 3], np.zeros((3, len(tint)))
            free = bilinear_map(visibility[..., None], x + dx, y + dy)[:, 0]
            own = -dr.normalize(view.rays(None, (float(dx), float(dy))))
            seen = np.where(near, np.where(once, points.view.x, own.x), 1)
            beyond = np.where(near, [tint, np.arange(len(tint)), np.where(once, centre, n[2])], 0)
            total += np.array([[diffuse, [free] * 3, nothing], [diffuse, [seen] * 3, beyond]]) / 4
        return total

    turn = rng.normal(size=normals.shape)
    slopes = (expected(normals + 1e-3 * turn) - expected(normals - 1e-3 * turn)) / 2e-3
    for own, *values in zip((None, trace), expected(normals), slopes, strict=True):
        dr.enable_grad(points.normal)
        dr.set_grad(points.normal, vectors(turn))
        found = averaged(radiance, points, view, None, own).filled()
        terms = found.diffuse, found.specular, found.indirect
        np.testing.assert_allclose([term.numpy() + 0 * tint for term in terms], values[0], atol=1e-5)
        moved = dr.forward_to(*terms)
        np.testing.assert_allclose([term.numpy() + 0 * tint for term in moved], values[1], atol=1e-4)


def mirror_before_wall(dx: float = 0, dy: float = 0, more: Any = (), **options: Any) -> Any:
    """A plane mirror before a wall, in pixels moved by (dx, dy); all surfels have `more` attributes."""
    wall = corner.wall_surfels(np.random.default_rng(0).normal(size=(400, 3))).to_numpy()
    floor = discs(position=[[0.6, 0, 0]], rotation=[[-1, 0, 0, 1]], scale=[[3.0, 3.0]])
    raw = {name: np.concatenate([x, np.reshape(floor.get(name, x[0]), (1, -1))]) for name, x in wall.items()}
    raw |= {name: np.tile(np.float32(values), (401, 1)) for name, values in dict(more).items()}
    surfels, shading = Surfels.from_numpy(raw), Shading(diffuse="irradiance", occlusion=True, **options)
    light = EnvironmentLight.from_radiance(corner.gradient_sky()).prefilter()
    view = Camera.look_at(corner.EYE, (0.7, 0, 0), (0, 1, 0), fov=9, size=8)
    scene = SurfelScene(surfels, shading, light, corner.with_materials(corner.corner(), surfels))
    return render(scene, replace(view, cx=view.cx - dx, cy=view.cy - dy), Request(("indirect",)))


def test_rays_of_nodes_leave_from_their_own_places(monkeypatch: pytest.MonkeyPatch) -> None:
    """Traced radiance is the mean of images whose pixels are moved, where normals turn."""
    monkeypatch.setattr("mi_refgs.render.antialias._turned", lambda nodes: True)
    steps = itertools.product(NODES.tolist(), repeat=2)
    expected = sum(mirror_before_wall(*step, traced_bounces=1).radiance.numpy() / 4 for step in steps)
    found, centre = (mirror_before_wall(traced_bounces=1, antialias=each).radiance for each in (True, False))
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-5)
    assert np.abs(centre.numpy() - expected).max() > 1e-3


def test_residual_adds_to_what_rays_meet() -> None:
    """As much as `indirect_sh` of these values are alone, and never so that less than nothing is left."""

    def indirect(bounces: int, **more: Any) -> Any:
        return mirror_before_wall(more=more, traced_bounces=bounces).terms.indirect.numpy()

    some = [1.5, 1.6, 1.7, 0.1, -0.2, 0.1, 0.2, 0.1, -0.2, 0.3, -0.1, 0.2]  # positive in all directions
    met, added = indirect(1), indirect(0, indirect_sh=some)
    np.testing.assert_allclose(indirect(1, residual_sh=some), met + added, atol=1e-5)
    np.testing.assert_allclose(indirect(1, indirect_sh=some), met, atol=1e-6)
    assert added.max() > 0.05 and not indirect(1, residual_sh=[-50.0, -50.0, -50.0]).any()


def test_points_integrate_cubic_radiance_exactly() -> None:
    """With x in pixels, the mean of x² over a pixel is that at its centre and 1/12 more."""
    view = seen_from(0.0, 0.3, 3.0, size=5, focal=4.0)
    rays = view.rays()

    def cubic(points: ShadingPoints) -> RadianceTerms:
        local = view.rotation @ -points.view
        x, y = (local.x / local.z * view.fx, local.y / local.z * view.fy)  # from the image's centre
        return RadianceTerms(specular=mi.Color3f(x * x, x * x * x, x * y * y))

    points = ShadingPoints(mi.Vector3f(0, 0, 1) + 0 * rays, -dr.normalize(rays))
    mean = averaged(cubic, points, view, None).specular.numpy()
    y, x = np.mgrid[-2:3, -2:3].reshape(2, -1)
    np.testing.assert_allclose(mean, [x**2 + 1 / 12, x**3 + x / 4, x * (y**2 + 1 / 12)], atol=2e-5)


def test_antialias_requires_deferred_shading() -> None:
    assert Shading().antialiased() == Shading(antialias=True)
    for other in (Shading("surfel"), Shading("surfel", reflectance="radiance")):
        assert other.antialiased() == other
    refused(lambda: Shading("surfel", antialias=True), "antialias: needs shading at pixel")
