"""Lat-long images of lights, averaged to fewer rows."""

from pathlib import Path

import numpy as np
import pytest

from mi_refgs.errors import InputError
from mi_refgs.io.exr import write_exr
from mi_refgs.io.images import linear_from_srgb, read_png, write_png
from mi_refgs.shade.light import envmap, lobe_matrices
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.light_file import read_radiance


@pytest.mark.parametrize("kind", ["float.exr", "half.exr", "8_bits.png"])
def test_a_map_that_is_finer_than_wanted_is_averaged(
    kind: str, tmp_path: Path, rng: np.random.Generator
) -> None:
    path, values = tmp_path / kind, rng.integers(0, 256, (37, 74, 3)).astype(np.float32) / 256
    if path.suffix == ".png":
        write_png(path, values)
        values = linear_from_srgb(read_png(path))
    else:
        write_exr(path, values, half=path.stem == "half")
    for rows, expected in ((64, values), (12, lobe_matrices.resample(values, 12))):
        np.testing.assert_allclose(read_radiance(path, rows), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("count", "wanted"), [(9, 8), (37, 12), (1000, 7), (5, 2), (8, 24)])
def test_matrices_of_grids_are_hats(count: int, wanted: int) -> None:
    """Area-weighted to coarsen, linear to refine; columns have their centres between those of the rows."""
    angles = lobe_matrices.row_angles
    hat = np.maximum(0, 1 - np.abs(angles(wanted)[:, None] - angles(count)) / angles(min(count, wanted))[1])
    hat *= lobe_matrices.row_areas(count) if wanted < count else 1
    rows = lobe_matrices.resampling(count, wanted).toarray()
    np.testing.assert_allclose(rows, hat / hat.sum(1, keepdims=True), atol=1e-12)
    between = lobe_matrices.column_angles(wanted)[:, None] - lobe_matrices.column_angles(count)
    apart = np.abs((between + np.pi) % (2 * np.pi) - np.pi)
    hat = np.maximum(0, 1 - apart * min(count, wanted) / (2 * np.pi))
    columns = lobe_matrices.resampling(count, wanted, periodic=True).toarray()
    np.testing.assert_allclose(columns, hat / hat.sum(1, keepdims=True), atol=1e-12)


def test_a_light_without_a_height_has_a_bound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(envmap, "FINEST", 16)
    for rows, expected in ((22, 16), (14, 12)):
        write_exr(tmp_path / "a.exr", np.full((rows, 2 * rows), 0.5))
        assert EnvironmentLight.from_file(tmp_path / "a.exr").height == expected


def test_what_is_no_light(tmp_path: Path) -> None:
    hole = np.ones((9, 8, 3))
    hole[7, 5, 1] = np.nan
    write_exr(tmp_path / "hole.exr", hole)
    write_exr(tmp_path / "row.exr", np.ones((1, 8, 3)))
    (tmp_path / "cut.hdr").write_bytes(b"#?RADIANCE\n\n-Y 9 +X 16\n" + bytes(9 * 16 * 4 - 60))
    write_exr(tmp_path / "cut.exr", np.random.default_rng(0).random((64, 64, 3)))
    (tmp_path / "cut.exr").write_bytes((tmp_path / "cut.exr").read_bytes()[:-9000])
    for name, words in {
        "hole.exr": "NaN or infinite values, the first at row 7, column 5",
        "row.exr": "8 × 1 pixels are no lat-long image",
        "cut.hdr": "truncated",
        "cut.exr": "pixels: not a readable EXR file",
    }.items():
        with pytest.raises(InputError, match=words):
            read_radiance(tmp_path / name)
