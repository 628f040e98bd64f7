"""Blending weights of surfels, against the blended image of one surfel alone."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.splat import splat
from mi_refgs.splat.camera import Camera
from mi_refgs.splat.weights import BlendedView
from mi_refgs.surfels.table import Surfels
from tests.scenes.integrator import raw_channels


def camera(eye: tuple[float, float, float]) -> Camera:
    return Camera.look_at(eye, [0, 0, 0], fov=40, size=24)


def test_weights_are_those_of_a_feature_of_one_surfel(rng: np.random.Generator) -> None:
    """Also with a map and the depth; the weights of all surfels sum to alpha."""
    surfels = Surfels.from_numpy(raw_channels())
    view = camera((0, -4, 1))
    values = rng.random(24 * 24).astype(np.float32)
    seen = BlendedView.of([surfels], view, [0, 1, mi.Float(2)])
    weight, weighted, deep = seen.sums([1, mi.Float(values), seen.maps.expected_depth])
    blended = splat([surfels], [mi.Float(row) for row in np.eye(surfels.count, dtype=np.float32)], view)
    images = np.array([image.numpy() for image in blended.features], np.float64)
    assert images.any()
    np.testing.assert_allclose(weight, images.sum(axis=1), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(weighted, images @ values, rtol=1e-4, atol=1e-5)
    assert deep == pytest.approx(images @ (blended.depth / dr.maximum(blended.alpha, 1e-3)).numpy(), rel=1e-4)
    assert weight.sum() == pytest.approx(float(dr.sum(blended.alpha)[0]), rel=1e-5)


def test_surfels_behind_the_camera_have_no_weights() -> None:
    surfels = Surfels.from_numpy(raw_channels())
    away = Camera.look_at((0, -4, 1), (0, -8, 1), fov=40, size=24)
    seen = BlendedView.of([surfels], away, [0])
    assert not seen.sums([1])[0].any() and not seen.tiles.any()


def test_surfels_are_listed_in_the_tiles_that_they_cover(rng: np.random.Generator) -> None:
    """A surfel contributes to the pixels of no other tile; behind others it costs as much."""
    surfels, view = Surfels.from_numpy(raw_channels()), camera((0, -4, 1))
    tiles = BlendedView.of([surfels], view, [0]).tiles
    width, height = view.tile
    for index in range(surfels.count):
        alone = [surfels.gather(mi.UInt32(index))]
        rows, columns = np.nonzero(splat(alone, [], view).alpha.numpy().reshape(24, 24) > 0)
        shown = {(row // height, column // width) for row, column in zip(rows, columns, strict=True)}
        assert len(shown) <= tiles[index] == BlendedView.of(alone, view, [0]).tiles[0]
    assert tiles.max() > tiles.min() >= 1
