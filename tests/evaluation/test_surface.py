"""Distance between a mesh and the true surface, and its concave regions."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import trimesh

from mi_refgs.data.dataset import read_dataset
from mi_refgs.data.images import Pixels
from mi_refgs.data.view import View
from mi_refgs.evaluation import surface
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.reference.camera import look_at
from tests.helpers import unit
from tests.scenes.integrator import joined
from tests.scenes.known import CENTRES, RADII, SIZE


@pytest.fixture(autouse=True)
def few_points(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(surface, "QUERIES", 4_000)


def truth_of(*shapes: Any) -> surface.TrueSurface:
    return surface.TrueSurface(joined(1e-3, *shapes))


def around(count: int = 8) -> list[View]:
    """Cameras on a circle and above that look at the origin."""
    views, pixels = [], Pixels(np.zeros((16, 16, 3), np.float32))
    for angle in 2 * np.pi * np.arange(count) / count:
        pose = look_at(6 * np.array([np.cos(angle), np.sin(angle), np.sin(3 * angle)]), np.zeros(3))
        views.append(View("", 16, 16, 16, 16, 8, 8, pose, pixels))
    return views


def ball(radius: float, centre: tuple[float, ...] = (0, 0, 0)) -> Any:
    return trimesh.creation.icosphere(subdivisions=4, radius=radius).apply_translation(centre)


@pytest.mark.parametrize(("radius", "percent"), [(1, 0), (1.1, 5)])
def test_distance_of_spheres(radius: float, percent: float) -> None:
    """In percent of the true diameter, either way."""
    found = surface.surface_distance(joined(1e-3, ball(radius)), truth_of(ball(1)), around())
    assert found == pytest.approx(dict.fromkeys(surface.SURFACE_KEYS, percent), rel=0.01, abs=1e-3)


def test_distance_counts_missing_but_not_hidden_surface() -> None:
    """A second ball beside the first is missing; one inside it is hidden, on either side."""
    both = truth_of(ball(1), ball(0.5, (1.7, 0, 0)))
    found = surface.surface_distance(joined(1e-3, ball(1)), both, around())
    assert found["surface_accuracy"] < 0.02 and found["surface_completeness"] > 2
    inside = trimesh.util.concatenate([ball(1), ball(0.5)])
    for ours, true in ((ball(1), inside), (inside, ball(1))):
        found = surface.surface_distance(joined(1e-3, ours), truth_of(true), around())
        assert found["surface_distance"] < 1e-3


def test_closed_cavity_counts_as_concave_error() -> None:
    """A box with a pit against the same box without: all distance is in the pit."""
    box = trimesh.creation.box((2, 2, 1)).subdivide().subdivide()
    poses = [look_at(np.array([0.1 * i, 0.3, 6]), np.zeros(3)) for i in range(3)]
    above = [replace(view, to_world=pose) for view, pose in zip(around(3), poses, strict=True)]
    found = surface.surface_distance(joined(1e-3, box), truth_of(pitted_box()), [*around(), *above])
    assert found["surface_distance_concave"] > 4 * found["surface_distance"] > 0
    assert found["surface_completeness_concave"] > 3


def pitted_box() -> Any:
    """The box of 2 × 2 × 1 whose top has a square pit, 1 wide and 0.6 deep, as an open surface."""
    box = trimesh.creation.box((2, 2, 1)).subdivide().subdivide()
    middle = box.triangles_center
    lid = (middle[:, 2] > 0.49) & (abs(middle[:, 0]) < 0.5) & (abs(middle[:, 1]) < 0.5)
    box.update_faces(~lid)
    pit = trimesh.creation.box((1, 1, 0.6)).subdivide()
    pit.apply_translation((0, 0, 0.2))
    pit.update_faces(pit.triangles_center[:, 2] < 0.49)
    return trimesh.util.concatenate([box, pit])


def test_ambient_visibility_inside_a_cap() -> None:
    """Everywhere inside a cap of a sphere it is 1 - h / 2R; on the outside 1."""
    sphere = trimesh.creation.icosphere(subdivisions=5)
    for height in (0.5, 1.0):
        cap = sphere.copy()
        cap.update_faces(cap.triangles_center[:, 2] < height - 1)
        occluder = Occluder(joined(1e-3, cap))
        point = unit(np.array([[0, 0, -1], [0.3, 0, -0.95], [0.2, 0.2, -0.96]]))
        inside = surface.ambient_visibility(occluder, mi.Point3f(point.T * 0.999), mi.Vector3f(-point.T))
        np.testing.assert_allclose(inside.numpy(), 1 - height / 2, atol=0.04)
        outside = surface.ambient_visibility(occluder, mi.Point3f(point.T * 1.001), mi.Vector3f(point.T))
        np.testing.assert_array_equal(outside.numpy(), 1)


def test_concave_pixels_are_between_the_balls(known: Path) -> None:
    truth = surface.TrueSurface.read(known / "data")
    assert truth is not None
    for view in (view.load() for view in read_dataset(known / "data", "test").views):
        concave = truth.concave(view)
        assert concave is not None and view.depth is not None
        hit = view.depth > 0
        assert not concave[~hit].any() and 0.02 < concave[hit].mean() < 0.4
        rays = np.array(view.camera().rays()).T.reshape(SIZE, SIZE, 3)
        point = view.to_world[:3, 3] + rays * view.depth[..., None]
        gap = np.abs(np.linalg.norm(point[..., None, :] - CENTRES, axis=-1) - RADII).max(axis=-1)
        assert gap[concave].mean() < 0.7 * gap[hit & ~concave].mean()
        assert truth.concave(replace(view, depth=None)) is None
