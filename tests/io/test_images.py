"""Image files, the sRGB curve, and files that appear whole or not at all."""

import os
from functools import partial
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from mi_refgs.io.exr import read_exr_image, write_exr
from mi_refgs.io.files import replace_file, write_bytes
from mi_refgs.io.images import image_header, linear_from_srgb, srgb_from_linear
from tests.helpers import read_exr, refused

HEADER = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}


def test_srgb_curve() -> None:
    x = np.linspace(0, 4, 1001)
    np.testing.assert_allclose(linear_from_srgb(srgb_from_linear(x)), x, atol=1e-9)
    known = srgb_from_linear(np.array([0.0, 0.0031308, 0.5, 1.0]))
    np.testing.assert_allclose(known, [0, 0.04045, 0.735357, 1], atol=1e-5)
    assert np.isfinite(srgb_from_linear(np.array([-1.0]))).all()


def test_exr_round_trip(tmp_path: Path, rng: np.random.Generator) -> None:
    image = rng.normal(size=(5, 7, 3)).astype(np.float32)
    write_exr(tmp_path / "a.exr", image, names="XYZ")
    np.testing.assert_array_equal(read_exr_image(tmp_path / "a.exr", vectors=True), image)
    refused(lambda: read_exr_image(tmp_path / "a.exr"), "a.exr: channels: found X, Y, Z; export R, G, B")
    write_exr(tmp_path / "a.exr", image[..., 0], half=True)
    np.testing.assert_allclose(read_exr(tmp_path / "a.exr")["Y"], image[..., 0], rtol=1e-3)
    write_exr(tmp_path / "b.exr", image[..., :2], names="UV")
    refused(lambda: read_exr_image(tmp_path / "b.exr"), "channels: found U, V")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.exr", "b.exr"]


def test_colours_in_other_primaries_are_refused(tmp_path: Path) -> None:
    """Mitsuba would convert them; read unconverted, they would be silently wrong."""
    planes = {name: np.ones((2, 4), np.float32) for name in "RGB"}
    for name, chromaticities in (
        ("srgb", (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)),
        ("ap1", (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)),
    ):
        OpenEXR.File(HEADER | {"chromaticities": chromaticities}, planes).write(str(tmp_path / f"{name}.exr"))
    assert read_exr_image(tmp_path / "srgb.exr").shape == (2, 4, 3)
    refused(lambda: read_exr_image(tmp_path / "ap1.exr"), "ap1.exr: chromaticities:", "convert")


def test_one_part_of_exr_is_read_and_deep_pixels_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    planes = {"Y": np.ones((2, 4), np.float32)}
    colour = dict.fromkeys("RGB", 2 * planes["Y"])
    given = {"depth": planes, "left": colour, "right": colour}
    parts = [OpenEXR.Part(HEADER | {"name": name}, channels, name) for name, channels in given.items()]
    OpenEXR.File(parts).write(str(tmp_path / "parts.exr"))
    deep = {"Y": np.array([[np.ones(3, np.float32)] * 4] * 2 + [[None] * 4], dtype=object)[:2]}
    header = {"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.deepscanline}
    OpenEXR.File(header, deep).write(str(tmp_path / "deep.exr"))
    assert (read_exr_image(tmp_path / "parts.exr") == np.full((2, 4, 3), 2)).all()
    assert "parts.exr: 3 parts, of which 'left' is read" in capsys.readouterr().err
    refused(partial(image_header, tmp_path / "deep.exr"), "deep.exr: header: deep pixels; flatten")


def test_files_are_written_atomically(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_bytes(path, b"old")

    class Killed(BaseException):
        pass

    def torn(temporary: Path) -> None:
        assert temporary.parent == tmp_path and temporary.suffix == ".txt"
        temporary.write_bytes(b"ne")
        raise Killed

    with pytest.raises(Killed):
        replace_file(path, torn)
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["a.txt"]
    write_bytes(path, b"new")
    assert path.read_bytes() == b"new" and os.listdir(tmp_path) == ["a.txt"]
