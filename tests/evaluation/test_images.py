"""Panels of environment maps, and contact sheets."""

import numpy as np
import pytest

from mi_refgs.evaluation import images
from mi_refgs.evaluation.images import material_colours
from mi_refgs.shade.light.lobe_matrices import map_directions


def test_light_panels_have_one_exposure(rng: np.random.Generator) -> None:
    truth = rng.uniform(0.1, 5, (8, 16, 3))
    shown = images.light_panels(truth * [0.5, 2, 1], truth)
    np.testing.assert_allclose(shown["fitted environment"], shown["ground-truth environment"], atol=1e-6)
    assert np.all(images.light_panels(np.zeros((8, 16, 3)))["fitted environment"] == 0)


POLES = [((0, 0, 1), 0, None), ((0, 0, -1), -1, None)]


@pytest.mark.parametrize(
    ("world", "row", "column"), [*POLES, ((0, 1, 0), 31, 0), ((1, 0, 0), 31, 15), ((0, -1, 0), 31, 31)]
)
def test_maps_are_drawn_with_z_at_the_top(world: tuple[int, int, int], row: int, column: int | None) -> None:
    """A lobe around a direction is brightest where a map with +z at the top shows it."""
    lobe = np.repeat(np.clip(map_directions(64) @ np.array(world, float), 0, 1)[..., None], 3, axis=-1)
    drawn = images.upright(lobe)
    assert drawn.shape == (64, 128, 3)
    bright = drawn[row] if column is None else drawn[row : row + 2, 2 * column : 2 * column + 2]
    assert bright.min() > 0.99 and drawn[row if column is None else 0].max() < 1 + 1e-6


def test_metals_differ_from_what_is_beside_them() -> None:
    """On white, a metal (metallic 1) would not be visible; a white albedo is over white, as images are."""
    alpha = np.array([[1.0, 0.0]])
    metal, beside = material_colours(np.ones((1, 2)), alpha)[0]
    assert (metal == 1).all() and abs(metal - beside).max() > 0.1
    np.testing.assert_allclose(material_colours(np.ones((1, 2, 3)), alpha), 1)


def test_contact_sheet_accepts_rows_of_different_length() -> None:
    black, white = np.zeros((10, 30, 3)), np.ones((10, 30, 3))
    sheet = images.contact_sheet([{"a": black, "b": white}, {"a": black}], {"light": np.zeros((8, 16, 3))})
    assert sheet.ndim == 3 and sheet.shape[2] == 3
    assert (sheet[:, :, 0] == 0).sum() >= 2 * (13 * 10) * (13 * 30)
