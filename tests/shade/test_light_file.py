"""Lat-long images of lights: every format, averaged to fewer rows."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from mi_refgs.errors import InputError
from mi_refgs.io.exr import write_exr
from mi_refgs.io.images import image_size, linear_from_srgb, read_png, write_png
from mi_refgs.reconstruction.new_light import NewLight
from mi_refgs.shade.light import envmap, lobe_matrices
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.light_file import read_radiance


def write_hdr(path: Path, mantissa: np.ndarray) -> None:
    """A Radiance image without run lengths of bytes (H, W, 3), all with the exponent of 1/256 per step."""
    height, width = mantissa.shape[:2]
    pixels = np.concatenate([mantissa, np.full((height, width, 1), 128, np.uint8)], axis=-1)
    path.write_bytes(f"#?RADIANCE\n\n-Y {height} +X {width}\n".encode() + pixels.tobytes())


def write_map(path: Path, kind: str, rng: np.random.Generator, height: int = 37) -> np.ndarray:
    """A random map of `kind`, and its linear radiance."""
    bytes_ = rng.integers(0, 256, (height, 74, 3), dtype=np.uint8)
    values = (bytes_ / 256).astype(np.float32)
    if kind == "hdr":
        write_hdr(path, bytes_)
    elif kind == "png":
        write_png(path, values)
        return np.asarray(linear_from_srgb(read_png(path)))
    else:
        write_exr(path, values, half=kind == "half")
    return values


@pytest.mark.parametrize("kind", ["exr", "half", "hdr", "png"])
@pytest.mark.parametrize("rows", [64, 12])
def test_every_format_is_read(kind: str, rows: int, tmp_path: Path, rng: np.random.Generator) -> None:
    """A map that is finer than wanted is averaged as `resample` does."""
    path = tmp_path / f"map.{kind if kind in ('hdr', 'png') else 'exr'}"
    values = write_map(path, kind, rng)
    expected = values if rows > len(values) else lobe_matrices.resample(values, rows)
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


def test_more_pixels_than_the_bound_are_refused_by_the_header(tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", np.ones((4, 6, 3)))
    good = (tmp_path / "a.exr").read_bytes()
    window, large = struct.pack("<4i", 0, 0, 5, 3), struct.pack("<4i", 0, 0, 2**15 - 1, 2**13)
    (tmp_path / "a.exr").write_bytes(good.replace(window, large) + bytes(2**22))
    for read in (image_size, read_radiance, EnvironmentLight.from_file, lambda path: NewLight(path).read()):
        with pytest.raises(InputError, match=r"a\.exr: size: 32768 × 8193 pixels are more than 268 million"):
            read(tmp_path / "a.exr")


def test_a_light_without_a_height_has_a_bound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(envmap, "FINEST", 16)
    for rows, expected in ((22, 16), (14, 12)):
        write_exr(tmp_path / "a.exr", np.full((rows, 2 * rows), 0.5))
        assert EnvironmentLight.from_file(tmp_path / "a.exr").height == expected


def test_what_is_no_light(tmp_path: Path) -> None:
    hole = np.ones((9, 8, 3))
    hole[7, 5, 1] = np.nan
    write_exr(tmp_path / "hole.exr", hole)
    write_exr(tmp_path / "xyz.exr", np.ones((4, 8, 3)), names="XYZ")
    write_exr(tmp_path / "row.exr", np.ones((1, 8, 3)))
    write_hdr(tmp_path / "cut.hdr", np.full((9, 16, 3), 200, np.uint8))
    (tmp_path / "cut.hdr").write_bytes((tmp_path / "cut.hdr").read_bytes()[:-60])
    write_exr(tmp_path / "cut.exr", np.random.default_rng(0).random((64, 64, 3)))
    (tmp_path / "cut.exr").write_bytes((tmp_path / "cut.exr").read_bytes()[:-9000])
    for name, words in {
        "hole.exr": "NaN or infinite values, the first at row 7, column 5",
        "xyz.exr": "channels: found X, Y, Z; export R, G, B",
        "row.exr": "8 × 1 pixels are no lat-long image",
        "cut.hdr": "truncated",
        "cut.exr": "pixels: not a readable EXR file",
        "none.exr": "missing",
    }.items():
        with pytest.raises(InputError, match=words):
            read_radiance(tmp_path / name)
