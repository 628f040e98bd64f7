"""The region of an object: what supports it is left out, what it consists of is inside."""

from functools import partial
from typing import Any

import numpy as np
import pytest

from mi_refgs.data import object_region as regions
from mi_refgs.data.images import Pixels
from mi_refgs.data.object_region import camera_positions, fitted_region, in_free_space, object_region
from mi_refgs.data.region import Region, region_of
from mi_refgs.data.view import View
from mi_refgs.reference.camera import look_at

TABLE = -0.5  # height of the table in these scenes


def views_around(at: tuple[float, float, float], focal: float = 120.0, distance: float = 4.0) -> list[View]:
    """24 views of 100² pixels from above the table."""
    angle, height = np.arange(24) * 2.4, 1 / 4 + np.arange(24) % 5 / 12
    origins = distance * np.stack([np.cos(angle), np.sin(angle), height], axis=1)
    pixels = Pixels(np.zeros((100, 100, 3), np.float32))
    return [View("v", 100, 100, focal, focal, 50, 50, look_at(o, np.array(at)), pixels) for o in origins]


def box(low: tuple[float, ...], high: tuple[float, ...], count: int, rng: np.random.Generator) -> np.ndarray:
    """Points on the sides of a box."""
    points = rng.uniform(low, high, (count, 3))
    axis, end = rng.integers(3, size=count), rng.integers(2, size=count)
    points[np.arange(count), axis] = np.where(end, np.array(high)[axis], np.array(low)[axis])
    return points


def table(rng: np.random.Generator, count: int = 2000, reach: float = 2.5) -> np.ndarray:
    """Points on the table, as inaccurate as triangulated ones."""
    points = rng.uniform(-reach, reach, (count, 3))
    points[:, 2] = TABLE + rng.normal(scale=0.003, size=count)
    return points


def test_table_is_found_and_left_out(rng: np.random.Generator) -> None:
    """With stray points above it and their mirror images below."""
    views = views_around((0, 0, 0))
    item = box((-0.3, -0.2, TABLE), (0.3, 0.2, 0.4), 400, rng)
    mirrored = item * [1, 1, -1] + [0, 0, 2 * TABLE]
    points = np.concatenate([table(rng), item, mirrored, rng.uniform(0, 3, (300, 3))])
    seen = partial(regions.seen_share, views)
    region = object_region(region_of(views), camera_positions(views), points, seen)
    ((*normal, offset),) = region.planes
    np.testing.assert_allclose(normal, [0, 0, 1], atol=0.01)
    assert TABLE < offset < TABLE + 0.06 * region.radius
    assert region.contains(item[item[:, 2] > TABLE + 0.1]).all()
    assert not region.contains(table(rng)).any()


def test_faces_of_object_support_nothing(rng: np.random.Generator) -> None:
    """A large box without a table: its faces have the object below them."""
    views = views_around((0, 0, 0))
    points = box((-1, -1, TABLE), (1, 1, 0.5), 4000, rng)
    points = points[points[:, 2] > TABLE]  # nobody sees the bottom
    for some in (points, points[:10], rng.normal(size=(4000, 3))):
        assert regions.support_planes(some, camera_positions(views), Region((0, 0, 0), 1.0)) == ()


def test_tall_object_is_whole(rng: np.random.Generator) -> None:
    """Taller than what the views show entirely around the point that they look at."""
    views = views_around((0, 0, 0.3))
    item = box((-0.2, -0.2, TABLE), (0.2, 0.2, 1.8), 1500, rng)
    points = np.concatenate([table(rng), item])
    sphere, origins, seen = region_of(views), camera_positions(views), partial(regions.seen_share, views)
    assert not sphere.contains(item).all()
    region = object_region(sphere, origins, points, seen)
    assert region.contains(item[item[:, 2] > TABLE + 0.12]).all() and region.estimated
    assert regions.shown_whole(views, region, points)
    assert not regions.shown_whole(views_around((0, 0, 0.3), focal=300.0), region, points)
    few = np.concatenate([table(rng), item[:20]])
    assert object_region(sphere, origins, few, seen).radius == sphere.radius


def test_surfaces_of_fit_enclose_object_alone(rng: np.random.Generator) -> None:
    views = views_around((0, 0, 0.3))
    item = box((-0.2, -0.2, TABLE), (0.2, 0.2, 1.6), 8000, rng)
    beside = box((0.9, -0.2, TABLE), (1.2, 0.2, 0.2), 4000, rng)
    points = np.concatenate([table(rng, 20_000), item, beside])
    region = Region((0, 0, 0.3), 1.2, ((0, 0, 1, TABLE + 0.05),), True)
    origins, seen = camera_positions(views), partial(regions.seen_share, views)
    assert region.contains(beside).any() and not region.contains(item[item[:, 2] > TABLE + 0.05]).all()
    found = fitted_region(region, origins, points, seen)
    assert found is not None and found.estimated
    assert found.contains(item[item[:, 2] > TABLE + 0.05]).all()
    assert not found.contains(beside).any() and not found.contains(table(rng)).any()
    # The plane may have had no sparse points; and there may be nothing.
    points[:20_000, 2] -= abs(rng.normal(scale=0.1, size=20_000))  # a polished table is fitted too low
    again = fitted_region(Region((0, 0, 0.3), 1.2), origins, points, seen)
    assert again is not None and again.contains(item[item[:, 2] > TABLE + 0.1]).all()
    assert not again.contains(beside).any() and np.mean(again.contains(table(rng))) < 0.05
    assert fitted_region(region, origins, table(rng), seen) is None


BAR, DISH = ((-1.0, -0.25, TABLE), (1.0, 0.25, 0.0)), ((-0.7, -0.7, TABLE), (0.7, 0.7, TABLE + 0.12))
L = ((-0.8, -0.8, TABLE), (0.8, -0.4, -0.2)), ((-0.8, -0.4, TABLE), (-0.4, 0.8, -0.2))


@pytest.mark.parametrize("distance", [4.0, 1.5])  # of the cameras: next to the object, a sphere cuts it
@pytest.mark.parametrize("boxes", [[BAR], L, [DISH]], ids=["bar", "L", "dish"])
def test_object_of_any_shape_is_whole(boxes: list[Any], distance: float, rng: np.random.Generator) -> None:
    """Before a fit and during it; without the table, what is beside the object, and the cameras."""
    views = views_around((0, 0, -0.2), 80.0, distance)
    cameras, seen, sphere = camera_positions(views), partial(regions.seen_share, views), region_of(views)
    item = np.concatenate([box(low, high, 4000, rng) for low, high in boxes])
    beside, cloth = box((1.3, 1.3, TABLE), (1.6, 1.6, -0.2), 1000, rng), table(rng, 10_000)
    points, above = np.concatenate([cloth, item, beside]), item[item[:, 2] > TABLE + 0.04]
    before = object_region(sphere, cameras, points, seen, regions.DENSE)
    during = fitted_region(before, cameras, points, seen)
    assert during is not None and len(during.planes) == len(before.supports) + len(regions.NORMALS)
    for region in (before, during):
        assert region.contains(above).all() and not region.contains(np.concatenate([cameras, cloth])).any()
    assert not during.contains(beside).any() and sphere.contains(above).all() == (distance > 2)
    # Lower than the points of a table are accurate: its neighbour must not become the object.
    points = np.concatenate([cloth, item * [1, 1, 0] + [0, 0, TABLE + 0.03], beside])
    low = object_region(sphere, cameras, points, seen, regions.DENSE)
    assert low.radius == sphere.radius and fitted_region(low, cameras, points, seen) is None


def test_a_camera_next_to_the_object_stays_outside(rng: np.random.Generator) -> None:
    """Right at the end of a long object on a wall, and in the hollow of an L."""
    wall = np.column_stack([np.zeros(2000), rng.uniform(-3, 3, (2000, 2))])
    ring = np.array([[2.3, 0.5 * np.sin(t), 0.5 * np.cos(t)] for t in np.linspace(0, 6, 20)])
    bar = box((0.1, -0.4, -0.4), (2.2, 0.4, 0.4), 3000, rng)
    both = np.concatenate([bar, box((0.1, 0.4, -0.4), (0.7, 1.8, 0.4), 2000, rng)])
    region, hollow = Region((1.0, 0.0, 0.0), 1.2, ((1.0, 0.0, 0.0, 0.05),)), np.array([[1.3, 0.8, 0.0]])
    for thing, cameras, least in ((bar, ring, 0.99), (both, hollow, 0.75)):
        found = fitted_region(region, cameras, np.concatenate([wall, thing]), lambda at: np.ones(len(at)))
        assert found is not None and not found.contains(cameras).any()
        assert np.mean(found.contains(thing)) >= least


def test_free_space_is_right_in_front_of_a_camera() -> None:
    """Not behind or beside it, nor farther away than 0.15 of the distance to the object."""
    views, region = views_around((0, 0, 0)), Region((0, 0, 0), 1)
    pose, distance = views[0].to_world, np.linalg.norm(views[0].to_world[:3, 3])
    local = np.array([[0, 0, 0.14], [0, 0, 0.16], [0, 0, -0.1], [0.1, 0, 0.1], [0.03, 0, 0.1]]) * distance
    points = local @ pose[:3, :3].T + pose[:3, 3]
    assert in_free_space(views[:1], region, points).tolist() == [True, False, False, False, True]
    assert in_free_space(views, region, points)[0] and not in_free_space(views[1:2], region, points).any()
