"""Panels of environment maps, and contact sheets."""

from __future__ import annotations

import numpy as np

from mi_refgs.evaluation import images


def test_light_panels_have_one_exposure(rng: np.random.Generator) -> None:
    truth = rng.uniform(0.1, 5, (8, 16, 3))
    shown = images.light_panels(truth * [0.5, 2, 1], truth)
    np.testing.assert_allclose(shown["fitted environment"], shown["ground-truth environment"], atol=1e-6)
    dark = images.light_panels(np.zeros((8, 16, 3)))
    assert np.all(dark["fitted environment"] == 0)


def test_contact_sheet_accepts_rows_of_different_length() -> None:
    black, white = np.zeros((10, 30, 3)), np.ones((10, 30, 3))
    sheet = images.contact_sheet([{"a": black, "b": white}, {"a": black}], {"light": np.zeros((8, 16, 3))})
    assert sheet.ndim == 3 and sheet.shape[2] == 3
    assert (sheet[:, :, 0] == 0).sum() >= 2 * (13 * 10) * (13 * 30)


def test_titles_of_a_sheet_are_as_large_as_fits() -> None:
    """Rows and columns of a title's ink: large above a wide image, whole above a narrow one."""

    def ink(width: int) -> tuple[int, int]:
        sheet = images.contact_sheet([{"ground-truth normals": np.ones((128, width, 3))}])
        rows, columns = np.nonzero(sheet[..., 0] < 0.5)
        assert 0 < columns.min() and columns.max() < width - 1
        return int(np.ptp(rows)), int(np.ptp(columns))

    assert ink(400)[0] > 1.5 * ink(128)[0] and ink(400)[1] > 1.5 * ink(128)[1]
