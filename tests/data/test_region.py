"""The region of interest: contraction, the sphere that cameras suggest, its file."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from mi_refgs.data import region as regions
from mi_refgs.data.images import Pixels
from mi_refgs.data.object_region import NORMALS
from mi_refgs.data.region import REGION_FILE, Plane, Region, read_region, region_of, region_pixels
from mi_refgs.data.view import View
from mi_refgs.reference.camera import look_at
from tests.helpers import refused, unit


def view_from(origin: np.ndarray, focal: float = 100.0) -> View:
    """A view of 100² pixels that looks at the world's origin."""
    pixels = Pixels(np.zeros((100, 100, 3), np.float32))
    return View("v", 100, 100, focal, focal, 50, 50, look_at(origin, np.zeros(3)), pixels)


@pytest.mark.parametrize("planes", [(), ((0.0, 0.0, 1.0, 0.2), (-0.6, 0.8, 0.0, -0.4))])
def test_region_pixels_are_those_whose_rays_hit_it(planes: tuple[Plane, ...]) -> None:
    """Against points along the rays; from above, below and inside, and for rays along a plane."""
    region = Region((0.3, -0.2, 0.1), 0.4, planes)
    for origin in ([2.0, 1.0, 0.5], [-0.5, 0.6, -1.5], [0.35, 0.05, 0.3], [2.0, 0.0, 0.25]):
        view = replace(view_from(np.array(origin)), width=30, height=20, fx=25.0, fy=28.0, cx=12.0, cy=11.0)
        steps = origin + np.linspace(0, 6, 3000)[:, None, None] * unit(np.array(view.camera().rays()).T)
        moved = {e: tuple((a, b, c, d - e) for a, b, c, d in region.planes) for e in (-4e-3, 4e-3)}
        sure, never = (replace(region, radius=0.4 + e, planes=planes) for e, planes in moved.items())
        found = region_pixels(view, region).ravel()
        assert np.all(found[sure.contains(steps).any(axis=0)])
        assert not np.any(found[~never.contains(steps).any(axis=0)]) and found.any()
    assert not region_pixels(view_from(np.array([2.0, 1.0, 0.5])), Region((6.0, 3.0, 1.5), 0.4)).any()


def test_contraction_is_identity_inside_and_bounded_by_two() -> None:
    region = Region((1.0, 2.0, 3.0), 0.5)
    inside = np.array([[1.1, 2.2, 2.9], [1.0, 2.0, 3.5]])
    np.testing.assert_allclose(region.contract(inside), (inside - [1, 2, 3]) / 0.5)
    # Twice the radius away: 2 − 1/2.
    np.testing.assert_allclose(region.contract(np.array([[2.0, 2.0, 3.0]])), [[1.5, 0, 0]])
    points = np.random.default_rng(0).normal(size=(200, 3)) * 20
    assert np.linalg.norm(region.contract(points), axis=1).max() < 2
    np.testing.assert_allclose(region.expand(region.contract(points)), points, rtol=1e-9, atol=1e-9)


def test_region_of_cameras_is_what_they_show_entirely() -> None:
    origins = np.array([[4, 0, 1], [0, 4, 1], [-4, 0, 1], [0, -4, 1.0]])
    region = region_of([view_from(origin) for origin in origins])
    np.testing.assert_allclose(region.centre, 0, atol=1e-9)
    # sin atan ½ = 1/√5 of the distance √17.
    assert region.radius == pytest.approx(0.8 * np.sqrt(17 / 5))
    wide = region_of([view_from(origin, focal=10.0) for origin in origins])
    # sin atan 5 = 5/√26 of the distance.
    assert wide.radius == pytest.approx(0.8 * 5 / np.sqrt(26) * np.sqrt(17))


def test_outward_or_coincident_cameras_have_no_region() -> None:
    refused(lambda: region_of([view_from(np.array([4.0, 0, 0]))]), "do not look at one point")
    origins = np.array([[4, 0, 1], [0, 4, 1], [-4, 0, 1], [0, -4, 1.0]])
    outward = [replace(v, to_world=v.to_world @ np.diag([-1.0, 1, -1, 1])) for v in map(view_from, origins)]
    refused(lambda: region_of(outward), "in front of them")
    inward = [view_from(origin) for origin in origins]
    assert region_of([*inward, view_from(np.array([4.0, 4, 1])), *outward[:2]]).radius > 0
    for place in ([0.0, 0, 0], [3.7, -1.9, 100.3]):
        panorama = []
        for view in outward:
            pose = view.to_world.copy()
            pose[:3, 3] = place
            panorama.append(replace(view, to_world=pose))
        refused(partial(region_of, panorama), "in front of them")


def test_region_file_is_read(tmp_path: Path) -> None:
    assert read_region(tmp_path) is None
    (tmp_path / REGION_FILE).write_text('{"centre": [1, 2, 3], "radius": 0.5}')
    assert read_region(tmp_path) == Region((1.0, 2.0, 3.0), 0.5)
    (tmp_path / REGION_FILE).write_text('{"centre": [1, 2, 3], "radius": 0.5, "planes": [[0, 0, 2, 1]]}')
    read = read_region(tmp_path)
    assert read == Region((1.0, 2.0, 3.0), 0.5, ((0.0, 0.0, 1.0, 0.5),)) and not read.estimated
    for region in (read, replace(read, planes=()), replace(read, estimated=True)):
        regions.write_region(tmp_path, region)
        again = read_region(tmp_path)
        assert again == region and again is not None and again.estimated == region.estimated


def test_region_moves_with_its_planes() -> None:
    region = Region((1.0, 2.0, 3.0), 2.0, ((0.6, 0.0, 0.8, 2.9), (0.0, 1.0, 0.0, 1.5)))
    points, offset = np.random.default_rng(0).uniform(0, 5, (500, 3)), np.array([5.0, -7.0, 0.5])
    inside = region.contains(points)
    np.testing.assert_array_equal(region.moved(offset).contains(points + offset), inside)
    others = [region.moved(np.full(3, e)) for e in (1e-7, 1e-5)] + [replace(region, planes=())]
    assert [region.is_close(other) for other in others] == [True, False, False] and 0 < np.sum(inside) < 500


@pytest.mark.parametrize(
    "text",
    ['{"centre": [1, 2], "radius": 1}', '{"centre": [1, 2, 3], "radius": 0}', '{"radius": 1}', "[]", "{",
     '{"centre": [1, 2, 1e10], "radius": 1}', '{"centre": [1, 2, NaN], "radius": 1}',
     '{"centre": [1, 2, true], "radius": 1}', '{"centre": [1, 2, "3"], "radius": 1}',
     '{"centre": [1, 2, 3], "radius": true}', '{"centre": [1, 2, 3], "radius": 1e10}',
     '{"centre": [1, 2, 3], "radius": 1, "planes": 3}',
     '{"centre": [1, 2, 3], "radius": 1, "planes": [[0, 0, 1]]}',
     '{"centre": [1, 2, 3], "radius": 1, "planes": [[0, 0, 0, 1]]}',
     '{"centre": [1, 2, 3], "radius": 1, "planes": [[0, 0, NaN, 1]]}',
     '{"centre": [1, 2, 3], "radius": 1e-300}', '{"centre": "123", "radius": 1}'],
)  # fmt: skip
def test_broken_region_file_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / REGION_FILE).write_text(text)
    refused(lambda: read_region(tmp_path), REGION_FILE)


def test_planes_around_an_object_are_told_from_its_supports() -> None:
    """Three opposite pairs or more, at the end."""
    table, faces = (0.0, 0.0, 1.0, -0.2), np.concatenate([NORMALS, np.eye(3), -np.eye(3)])
    pairs = [tuple(row) for row in np.column_stack([faces, np.full(len(faces), -1.0)]).tolist()]
    for planes in ((), (table,), (table, (0.0, 0.0, -1.0, -1.0)), (table, *pairs[:4])):
        assert Region((0, 0, 0), 1, planes).supports == planes
    for around in (pairs[:26], pairs[26:]):
        assert Region((0, 0, 0), 1, (table, *around)).supports == (table,)
