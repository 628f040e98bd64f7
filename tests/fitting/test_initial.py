"""What a fit starts from: surfels on and inside the visual hull, coloured by the images."""

import functools
from dataclasses import replace

import numpy as np
import pytest

from mi_refgs import methods
from mi_refgs.data import dataset, hull
from mi_refgs.fitting.initial import initial_surfels
from tests.helpers import with_pixels
from tests.scenes.tiny import RADIUS, write_data

COUNT = 2_000


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hull of fewer voxels: images of 20² show no more."""
    monkeypatch.setattr(hull, "visual_hull", functools.partial(hull.visual_hull, resolution=32))


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> dataset.Dataset:
    """Twelve views of a ball coloured by its normals, at RADIUS around the origin."""
    folder = write_data(tmp_path_factory.mktemp("hull") / "ball", views=12, truth=False)
    return dataset.read_dataset(folder, "train")


def start(ball: dataset.Dataset, inside: float, seed: int = 0, *settings: str) -> dict[str, np.ndarray]:
    assigned = [f"surfels.count={COUNT}", f"surfels.inside={inside}", *settings]
    method = methods.load("ref_gaussian", "quick", assigned)
    surfels = initial_surfels(method, ball, np.random.default_rng(seed))
    return surfels.to_numpy() | {"normal": np.array(surfels.frame()[2]).T}


def test_share_inside_is_spread_over_volume(ball: dataset.Dataset) -> None:
    """Below 0.8 of the radius lies half of the volume of the ball, and nothing of its surface."""
    deep = {}
    for share in (0.0, 0.5, 1.0):
        distance = np.linalg.norm(start(ball, share)["position"], axis=1)
        assert len(distance) == COUNT
        deep[share] = np.mean(distance < 0.8 * RADIUS)
    assert deep[0.0] == 0
    # The hull of twelve views is up to a tenth wider than the ball.
    assert 0.35 < deep[1.0] < 0.55 and deep[0.5] == pytest.approx(deep[1.0] / 2, abs=0.04)


def test_normals_and_colours_of_both_kinds(ball: dataset.Dataset) -> None:
    table = start(ball, 0.5)
    distance = np.linalg.norm(table["position"], axis=1)
    outward = np.sum(table["normal"] * table["position"], axis=1) / distance
    inner, outer = distance < 0.8 * RADIUS, distance > 0.95 * RADIUS
    assert np.median(outward[outer]) > 0.9
    assert abs(outward[inner].mean()) < 0.15 and np.mean(outward[inner] < 0) > 0.4
    colour = colour_of(table)
    assert np.all(np.isfinite(colour)) and np.all((colour >= 0) & (colour <= 1))


def colour_of(table: dict[str, np.ndarray]) -> np.ndarray:
    return 0.5 + table["radiance_sh"][:, :3] * 0.28209479


def test_albedo_starts_with_hue_of_images(ball: dataset.Dataset) -> None:
    """As bright everywhere as its initial value; without it, it is grey."""
    table = start(ball, 0.5, 0, "surfels.from_images=['albedo']", "surfels.initial.albedo=0.6")
    albedo, colour = 1 / (1 + np.exp(-table["albedo"])), colour_of(table)
    hue = 0.6 * colour / colour.max(axis=1, keepdims=True)
    # Its own jitter breaks ties, and its ends are cut off.
    assert np.abs(albedo - np.clip(hue, 0.02, 0.9)).max() < 0.026
    assert np.abs(albedo - 0.6).max() > 0.3
    assert np.abs(1 / (1 + np.exp(-start(ball, 0.5)["albedo"])) - 0.5).max() < 0.026


def test_without_alpha_surfels_fill_box(ball: dataset.Dataset) -> None:
    bare = replace(ball, views=tuple(with_pixels(view, alpha=None) for view in ball.views))
    table = start(bare, 0.5)
    assert len(table["position"]) == COUNT and np.linalg.norm(table["position"], axis=1).max() > 1.1 * RADIUS


@pytest.mark.parametrize("variant", methods.names())
def test_methods_start_alike(variant: str) -> None:
    """A method is compared with another one from the same points."""
    full, other = (methods.load(name, "quick").surfels for name in ("ref_gaussian", variant))
    assert (full.inside, full.count, full.max_count) == (other.inside, other.count, other.max_count)
