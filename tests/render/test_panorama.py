"""The background in all directions from one point: orientation, distances, what is near or large."""

import numpy as np
import pytest

from mi_refgs.render.panorama import panorama
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.lobe_matrices import map_directions
from tests.scenes.splats import opaque

CENTRE = np.array([0.3, -0.2, 0.5])
HEIGHT = 32


def test_background_map_is_seen_as_it_is() -> None:
    """In the orientation of `EnvironmentLight`, wherever the centre is; nothing is near."""
    wave = 0.5 + 0.3 * map_directions(HEIGHT)
    far = opaque(np.array([[0.0, 0.0, -900.0]]), np.array([[0.0, 0.0, 1.0]]), np.zeros((1, 3)), [1e-3])
    seen = panorama(Surroundings(far, EnvironmentLight.from_radiance(wave)), CENTRE, HEIGHT, 0.01)
    np.testing.assert_allclose(seen.radiance, wave, atol=0.02)  # the far disc is a part of a pixel
    assert not seen.nearness.any()
    np.testing.assert_allclose(seen.points(7.0), CENTRE + 7 * map_directions(HEIGHT))


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1, -1])
def test_surfels_have_their_radiance_and_distance(axis: int, sign: int) -> None:
    """A large disc across one axis: the texels that see it have its plane's distance, and its colour."""
    towards = sign * np.eye(3)[axis]
    colour = np.array([[0.2, 0.5, 0.8]])
    points, normals = CENTRE + np.outer([0.5, 2], towards), -np.stack([towards, towards])
    both = opaque(points, normals, np.concatenate([0 * colour, colour]), [0.05, 9.0])  # one nearer
    seen = panorama(Surroundings(both), CENTRE, HEIGHT, 1.0)
    directions = map_directions(HEIGHT)
    central = directions @ towards > 0.9
    np.testing.assert_allclose(seen.nearness[central], directions[central] @ towards / 2, rtol=0.03)
    np.testing.assert_allclose(seen.radiance[central], np.broadcast_to(colour, (central.sum(), 3)), atol=0.02)
    assert not seen.nearness[directions @ towards < -0.1].any()


def test_large_gaussians_nearby_do_not_cover_all_directions() -> None:
    """Beside one of half its distance's size, small ones all around keep their colours."""
    directions = map_directions(12)[1:-1].reshape(-1, 3)
    colour, sizes = np.array([0.2, 0.5, 0.8]), [*[0.7] * len(directions), 0.25]
    beside = directions[[40]]
    colours = np.concatenate([np.broadcast_to(colour, directions.shape), [[1.0, 0.0, 0.0]]])
    directions = np.concatenate([directions, beside])
    points = CENTRE + np.append(np.full(len(directions) - 1, 4.0), 0.5)[:, None] * directions
    cloud = opaque(points, -directions, colours, sizes, "gaussian")
    seen = panorama(Surroundings(cloud), CENTRE, HEIGHT, 0.1)
    np.testing.assert_allclose(seen.radiance, np.broadcast_to(colour, seen.radiance.shape), atol=0.03)
