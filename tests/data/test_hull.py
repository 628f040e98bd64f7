"""Points to start from: on and in the visual hull of alpha masks, in a box, and their colours."""

import numpy as np
import pytest
from scipy.stats import kstest

from mi_refgs.data import hull
from mi_refgs.data.images import Pixels
from mi_refgs.data.view import View
from mi_refgs.reference.camera import look_at
from tests.helpers import refused, unit, with_pixels

BLACK = np.zeros(3)


def spheres(count: int, size: int, centre: np.ndarray, radius: float, rng: np.random.Generator) -> list[View]:
    """Exact masks of a sphere from cameras at distance 4 around it; the image shows the view's number."""
    views = []
    focal = 1.6 * size
    for number in range(count):
        to_world = look_at(centre - 4 * unit(rng.normal(size=3)), centre, (0.3, 0.5, 0.8))
        column, row = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
        rays = np.stack([(column - size / 2) / focal, (row - size / 2) / focal, -np.ones_like(row)], axis=-1)
        cosine = -rays[..., 2] / np.linalg.norm(rays, axis=-1)
        alpha = (4 * np.sqrt(1 - cosine**2) < radius).astype(np.float32)
        image = np.float32(number / count) * np.repeat(alpha[..., None], 3, axis=2)
        pinhole = (size, size, focal, focal, size / 2, size / 2)
        views.append(View("", *pinhole, to_world, Pixels(image, alpha), is_linear_radiance=True))
    return views


def test_visual_hull_of_sphere_masks_is_the_sphere(rng: np.random.Generator) -> None:
    """Off-centre sphere: points within a voxel of its surface, normals outward within 12° on average."""
    centre = np.array([0.4, -0.3, 0.2])
    views = spheres(40, 64, centre, 0.8, rng)
    bounds = hull.camera_bounds(views)
    np.testing.assert_allclose(bounds.mean(axis=0), centre, atol=1e-6)
    assert bounds[1, 0] - bounds[0, 0] == pytest.approx(2 * 4 / 1.6 / 2)
    points, normals = hull.visual_hull(views, bounds, resolution=40).surface_points(4000, rng)
    assert points.shape == normals.shape == (4000, 3)
    # Half a voxel off in each axis would be 0.054; the mean of 4000 points scatters by 0.013.
    assert np.linalg.norm(points.mean(axis=0) - centre) < 0.035
    outward, voxel = points - centre, 2.5 / 40
    distance = np.linalg.norm(outward, axis=1)
    assert abs(distance.mean() - 0.8) < voxel / 2 and np.abs(distance - 0.8).max() < 2 * voxel
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    cosine = np.sum(normals * outward, axis=1) / distance
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() < 12
    colours = hull.median_colours(points, views, BLACK)
    assert np.all((colours > 0.3) & (colours < 0.7))
    facing = hull.median_colours(points, views[:1], BLACK, normals)
    seen = np.sum(normals * (views[0].to_world[:3, 3] - points), axis=1) > 0
    # At the silhouette a mask of whole pixels may miss the point, which then stays grey.
    assert np.all(facing[~seen] == 0.5) and np.mean(facing[seen] == 0) > 0.8


def test_inner_points_are_uniform_across_voxels(rng: np.random.Generator) -> None:
    """A field that falls by 1/2 over 4.3 voxels in the sum of |x|, |y|, |z| bounds an octahedron exactly."""
    radius, voxel = 4.3, np.array([0.1, 0.2, 0.3])
    grid = np.stack(np.meshgrid(*[np.arange(-6, 7)] * 3, indexing="ij"), axis=-1)
    field = 1 - np.abs(grid).sum(axis=-1) / (2 * radius)
    shape = hull.Hull(field, np.array([5.0, 6.0, 7.0]) - 6 * voxel, voxel)
    points = (shape.inner_points(50_000, rng) - (5.0, 6.0, 7.0)) / voxel
    size = np.abs(points).sum(axis=1) / radius
    assert size.max() < 1 and kstest(size**3, "uniform").pvalue > 1e-3
    for axis in points.T:  # a coordinate of an octahedron has density (1 - |x| / r)²
        cumulative = 0.5 + 0.5 * np.sign(axis) * (1 - (1 - np.abs(axis) / radius) ** 3)
        assert kstest(cumulative, "uniform").pvalue > 1e-3
    tiny = hull.Hull(0.500001 * (field == 1), np.zeros(3), np.ones(3))
    assert len(tiny.inner_points(10, rng)) < 10 and len(tiny.surface_points(10, rng)[0]) == 10


def test_empty_hull_and_parallel_cameras_are_refused(rng: np.random.Generator) -> None:
    views = spheres(4, 16, np.zeros(3), 0.8, rng)
    nothing = [with_pixels(view, alpha=np.zeros((16, 16), np.float32)) for view in views]
    refused(lambda: hull.visual_hull(nothing, hull.camera_bounds(views), resolution=8), "inside every mask")
    refused(lambda: hull.camera_bounds(views[:1]), "do not look at one point")
    assert np.all(hull.median_colours(rng.normal(size=(100, 3)), nothing, BLACK) == 0.5)
