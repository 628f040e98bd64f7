"""The recipe of an initialiser in CONTRIBUTING.md, followed line by line: it can be copied."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh

import mi_refgs
from mi_refgs import methods
from mi_refgs.data import hull
from mi_refgs.data.dataset import Dataset, read_dataset
from mi_refgs.fitting.initial import initial_surfels
from mi_refgs.methods.extensions import INITIALISERS, Start, Wanted
from mi_refgs.surfels.init import even_points
from tests.helpers import refused
from tests.scenes.tiny import METHOD, write_data, write_method

MESH = trimesh.creation.icosphere(3, radius=0.5)


def on_mesh(wanted: Wanted) -> Start | None:
    """Points evenly spread on a mesh of the object, with its normals; not for the background."""
    if not wanted.inside:
        return None
    points, normals = even_points(MESH.vertices, MESH.faces, wanted.count, wanted.rng)
    data = wanted.data
    return Start(points, hull.median_colours(points, data.views, data.background, normals), normals)


@pytest.fixture
def data(tmp_path: Path) -> Dataset:
    return read_dataset(write_data(tmp_path / "data", truth=False), "train", truth=False)


@pytest.fixture
def file(tmp_path: Path) -> Iterator[str]:
    mi_refgs.register_initialiser(mi_refgs.Initialiser("mesh", on_mesh))
    text = METHOD.replace("[surfels]\n", '[surfels]\nstart = ["mesh", "random"]\n')
    yield str(write_method(tmp_path, text))
    INITIALISERS.unregister("mesh")


def test_a_registered_initialiser_places_the_surfels(file: str, data: Dataset) -> None:
    method = methods.load(file, "quick", ["surfels.count=200"])
    first, second = (initial_surfels(method, data, np.random.default_rng(0)) for _ in range(2))
    raw, normal = first.to_numpy(), np.array(first.frame()[2]).T
    radius = np.linalg.norm(raw["position"], axis=1)
    assert first.count == 200 and np.all((radius > 0.49) & (radius <= 0.5 + 1e-6))
    assert np.all(np.sum(normal * raw["position"], axis=1) > 0.99 * radius)
    for name, values in second.to_numpy().items():
        np.testing.assert_array_equal(values, raw[name])


def test_others_are_refused_or_not_used(file: str, data: Dataset) -> None:
    unknown = ["surfels.start=['mush']"]
    refused(lambda: methods.load(file, "quick", unknown), "surfels.start: 'mush' is unknown")
    hull_first = methods.load(file, "quick", ["surfels.count=50", "surfels.start=['points', 'hull', 'mesh']"])
    position = initial_surfels(hull_first, data, np.random.default_rng(0)).raw["position"].numpy()
    assert np.linalg.norm(position, axis=1).std() > 0.01  # on the hull of three views
    method = methods.load(file, "quick", ["surfels.start=['points']"])
    refused(lambda: initial_surfels(method, data, np.random.default_rng(0)), "surfels.start: no initialiser")
