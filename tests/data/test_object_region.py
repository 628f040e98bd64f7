"""The region of an object: what supports it is left out, what it consists of is inside."""

from functools import partial

import numpy as np

from mi_refgs.data.images import Pixels
from mi_refgs.data.object_region import (
    camera_positions,
    fitted_region,
    in_free_space,
    object_region,
    seen_share,
    shown_whole,
    support_planes,
)
from mi_refgs.data.region import Region, region_of
from mi_refgs.data.view import View
from mi_refgs.reference.camera import look_at

TABLE = -0.5  # height of the table in these scenes


def views_around(target: tuple[float, float, float], focal: float = 120.0, count: int = 24) -> list[View]:
    """Views of 100² pixels from above the table, at a distance of about 4."""
    angle = np.arange(count) * 2.4
    height = 1 + np.arange(count) % 5 / 3
    origins = np.stack([4 * np.cos(angle), 4 * np.sin(angle), height], axis=1)
    pixels = Pixels(np.zeros((100, 100, 3), np.float32))
    return [View("v", 100, 100, focal, focal, 50, 50, look_at(o, np.array(target)), pixels) for o in origins]


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
    region = object_region(region_of(views), camera_positions(views), points, partial(seen_share, views))
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
        assert support_planes(some, camera_positions(views), Region((0, 0, 0), 1.0)) == ()


def test_tall_object_is_whole(rng: np.random.Generator) -> None:
    """Taller than what the views show entirely around the point that they look at."""
    views = views_around((0, 0, 0.3))
    item = box((-0.2, -0.2, TABLE), (0.2, 0.2, 1.8), 1500, rng)
    points = np.concatenate([table(rng), item])
    sphere, origins, seen = region_of(views), camera_positions(views), partial(seen_share, views)
    assert not sphere.contains(item).all()
    region = object_region(sphere, origins, points, seen)
    assert region.contains(item[item[:, 2] > TABLE + 0.12]).all() and region.estimated
    assert shown_whole(views, region, points)
    assert not shown_whole(views_around((0, 0, 0.3), focal=300.0), region, points)
    few = np.concatenate([table(rng), item[:20]])
    assert object_region(sphere, origins, few, seen).radius == sphere.radius


def test_surfaces_of_fit_enclose_object_alone(rng: np.random.Generator) -> None:
    views = views_around((0, 0, 0.3))
    item = box((-0.2, -0.2, TABLE), (0.2, 0.2, 1.6), 8000, rng)
    beside = box((0.9, -0.2, TABLE), (1.2, 0.2, 0.2), 4000, rng)
    points = np.concatenate([table(rng, 20_000), item, beside])
    region = Region((0, 0, 0.3), 1.2, ((0, 0, 1, TABLE + 0.05),), True)
    origins, seen = camera_positions(views), partial(seen_share, views)
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


def test_object_that_cameras_approach_is_whole(rng: np.random.Generator) -> None:
    """A long object on a wall: around its middle, cameras near its end leave room for a part of it only."""
    wall = np.column_stack([np.zeros(2000), rng.uniform(-3, 3, (2000, 2))])
    thing = box((0.1, -0.4, -0.4), (2.2, 0.4, 0.4), 3000, rng)
    origins = np.array([[2.3, 0.5 * np.sin(t), 0.5 * np.cos(t)] for t in np.linspace(0, 6, 20)])
    region = Region((1.0, 0, 0), 1.2, ((1.0, 0.0, 0.0, 0.05),))
    found = fitted_region(region, origins, np.concatenate([wall, thing]), lambda points: np.ones(len(points)))
    assert found is not None
    assert found.radius <= 0.8 * np.linalg.norm(origins - np.array(found.centre), axis=1).min() + 1e-9
    middle = np.array([1.15, 0, 0])
    room = 0.8 * np.linalg.norm(origins - middle, axis=1).min()
    around_middle = np.mean(np.linalg.norm(thing - middle, axis=1) <= room)
    assert np.mean(found.contains(thing)) > around_middle + 0.05 and 0.1 < found.centre[0] < middle[0]


def test_free_space_is_right_in_front_of_a_camera() -> None:
    """Not behind or beside it, nor farther away than 0.15 of the distance to the object."""
    views, region = views_around((0, 0, 0)), Region((0, 0, 0), 1)
    pose, distance = views[0].to_world, np.linalg.norm(views[0].to_world[:3, 3])
    local = np.array([[0, 0, 0.14], [0, 0, 0.16], [0, 0, -0.1], [0.1, 0, 0.1], [0.03, 0, 0.1]]) * distance
    points = local @ pose[:3, :3].T + pose[:3, 3]
    assert in_free_space(views[:1], region, points).tolist() == [True, False, False, False, True]
    assert in_free_space(views, region, points)[0] and not in_free_space(views[1:2], region, points).any()
