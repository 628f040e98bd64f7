"""From a picture's file to pixels: shrinking decoders, masks, bands, orientation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mi_refgs.data.dataset import read_dataset
from mi_refgs.data.picture_files import BAND, Mask, PictureFile
from mi_refgs.data.survey import survey
from mi_refgs.errors import InputError
from mi_refgs.io.exr import read_exr_image, write_exr
from mi_refgs.io.images import box_downscale, read_bytes, read_grey, read_png, write_png
from tests.scenes.tiny import write_data


def smooth(width: int, height: int, scale: float = 20.0) -> np.ndarray:
    """A picture without detail, so that a JPEG file holds it nearly as it is."""
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    waves = [np.sin(x / scale), np.cos(y / scale), np.sin((x + y) / (2 * scale))]
    return 0.5 + 0.4 * np.stack(waves, axis=-1)


def read(path: Path, downscale: int, mask: Mask | None = None) -> tuple[np.ndarray, np.ndarray | None]:
    return PictureFile.find(path, downscale, mask).read(0.0)


def jpeg(path: Path, pixels: np.ndarray, **options: Any) -> Path:
    Image.fromarray(np.round(255 * pixels).astype(np.uint8)).save(path, quality=97, subsampling=0, **options)
    return path


@pytest.mark.parametrize(("downscale", "factor"), [(1, 1), (2, 2), (3, 1), (6, 2), (8, 8), (12, 4), (16, 8)])
@pytest.mark.parametrize("size", [(160, 96), (157, 101)])
def test_a_jpeg_is_shrunk_by_its_decoder(
    downscale: int, factor: int, size: tuple[int, int], tmp_path: Path
) -> None:
    """To what averaging its pixels gives: nothing is shifted, and the same pixels are left out."""
    path = jpeg(tmp_path / "a.jpg", smooth(*size))
    assert read_bytes(path, downscale)[1] == factor
    image, alpha = read(path, downscale)
    assert alpha is None and image.shape[:2] == (size[1] // downscale, size[0] // downscale)
    expected = box_downscale(read_png(path), downscale)
    assert np.abs(image - expected).mean() < 3e-3 and np.abs(image - expected).max() < 0.03


def test_a_picture_of_many_bands(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).random((3 * BAND + 5, 9, 4))
    write_png(tmp_path / "a.png", pixels)
    straight = read_png(tmp_path / "a.png")
    straight[..., :3] *= straight[..., 3:]
    for downscale in (1, 2, 7):
        image, alpha = read(tmp_path / "a.png", downscale)
        assert alpha is not None
        expected = box_downscale(straight, downscale)
        np.testing.assert_array_equal(np.dstack([image, alpha]), expected)


def test_a_mask_is_alpha(tmp_path: Path) -> None:
    """Colour outside of it does not bleed in when pixels are averaged; alpha of the picture counts, too."""
    covered = np.zeros((8, 8))
    covered[:, 3:] = 1
    colour = np.where(covered[..., None] > 0, [0.2, 0.4, 0.6], [1.0, 0.0, 1.0])
    write_png(tmp_path / "m.png", np.repeat(covered[..., None], 3, axis=-1))
    for path in (tmp_path / "a.png", jpeg(tmp_path / "a.jpg", smooth(8, 8))):
        if path.suffix == ".png":
            write_png(path, colour)
        image, alpha = read(path, 2, Mask(tmp_path / "m.png"))
        assert alpha is not None
        np.testing.assert_allclose(alpha, np.tile([0, 0.5, 1, 1], (4, 1)), atol=1e-6)
        if path.suffix == ".png":
            np.testing.assert_allclose(image[:, 1], np.tile([0.1, 0.2, 0.3], (4, 1)), atol=1e-6)
    own = np.full((8, 8, 1), 0.4)
    own[:, 6:] = 0
    write_png(tmp_path / "b.png", np.concatenate([colour, own], axis=-1))
    image, alpha = read(tmp_path / "b.png", 2, Mask(tmp_path / "m.png"))
    assert alpha is not None
    np.testing.assert_allclose(alpha, np.tile([0, 0.2, 0.4, 0], (4, 1)), atol=1e-6)
    np.testing.assert_allclose(image[:, 2], np.tile([0.08, 0.16, 0.24], (4, 1)), atol=1e-6)


def test_what_a_mask_may_hold(tmp_path: Path) -> None:
    """8 bits, labels 0 and 1, what is cut out, 16 bits, used in full or not; as depth, what is nearer."""
    bits = np.array([[0, 255, 128]], dtype=np.uint8)
    for name, image in {
        "grey": Image.fromarray(bits),
        "labels": Image.fromarray((bits == 255).astype(np.uint8)),
        "alpha": Image.merge("LA", [Image.fromarray(np.full_like(bits, 9)), Image.fromarray(bits)]),
        "deep": Image.fromarray(bits.astype(np.uint16) * 257),
        "deep labels": Image.fromarray((bits == 255).astype(np.uint16)),
        "shallow": Image.fromarray(bits.astype(np.uint16)),
        "black": Image.fromarray(0 * bits),
    }.items():
        image.save(tmp_path / f"{name}.png")
    expected = {"labels": [[0, 1, 0]], "deep labels": [[0, 1, 0]], "black": [[0, 0, 0]]}
    for name in ("grey", "labels", "alpha", "deep", "deep labels", "shallow", "black"):
        alpha = Mask(tmp_path / f"{name}.png").read()
        np.testing.assert_allclose(alpha, expected.get(name, [[0, 1, 128 / 255]]), atol=1e-6)
    assert read_grey(tmp_path / "deep.png")[1] == 65535
    np.testing.assert_array_equal(read_grey(tmp_path / "shallow.png")[0], bits)  # raw numbers, as of depths
    np.testing.assert_array_equal(Mask(tmp_path / "deep.png", below=128 * 257).read(), [[1, 0, 0]])


def test_a_mask_of_another_size_is_refused(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", np.ones((4, 6, 3)))
    write_png(tmp_path / "m.png", np.ones((6, 4, 3)))
    with pytest.raises(InputError, match=r"m\.png: mask: 4 × 6 pixels, but a\.png has 6 × 4"):
        read(tmp_path / "a.png", 1, Mask(tmp_path / "m.png"))


def test_pictures_are_used_as_they_lie(tmp_path: Path) -> None:
    """A camera's note that the picture is upright after a turn changes neither pixels nor size."""
    exif = Image.Exif()
    exif[0x0112] = 6
    pixels = smooth(40, 24)
    plain = jpeg(tmp_path / "a.jpg", pixels)
    turned = jpeg(tmp_path / "b.jpg", pixels, exif=exif)
    assert PictureFile.find(turned, 1).size == (40, 24)
    np.testing.assert_array_equal(read(turned, 2)[0], read(plain, 2)[0])


def filled(data: Path, but: str = "") -> Path:
    """A data set whose images keep alpha but have no transparent pixel; `but` for one."""
    for kind, read_file, write_file in ((".png", read_png, write_png), (".exr", read_exr_image, write_exr)):
        for path in [p for p in data.glob(f"t*/r_?{kind}") if p.stem != but]:
            image = np.array(read_file(path))
            image[..., 3] = 1
            write_file(path, image)
    return data


@pytest.mark.parametrize("images", ["png", "exr"])
def test_alpha_that_leaves_nothing_out_is_none(images: str, tmp_path: Path) -> None:
    """Photographs saved as RGBA are photographs, in both splits, and that is said; a mask stays a mask."""
    data = write_data(tmp_path / "ball", truth=False)
    for path in data.glob("*/*.png"):
        write_exr(path.with_suffix(".exr"), read_png(path))
    assert all(read_dataset(data, split, images=images).has_alpha for split in ("train", "test"))
    filled(data)
    for split in ("train", "test"):
        found = read_dataset(data, split, images=images)
        assert not found.has_alpha and all(view.alpha is None for view in found.views)
        assert found.region is not None and "no pixel is transparent" in found.notes[-1]
    assert survey(data).alpha == "none"
    if images == "png":
        for path in data.glob("*/r_?.png"):
            write_png(path, read_png(path)[..., :3])
            write_png(path.with_name(f"{path.stem}_alpha.png"), np.ones((20, 20, 3)))
        assert read_dataset(data, "train").has_alpha


def test_one_image_that_is_full_is_still_masked(tmp_path: Path) -> None:
    """What alpha means is a matter of the data set: others leave something out."""
    data = filled(write_data(tmp_path / "ball", truth=False), but="r_2")
    for split in ("train", "test"):
        assert read_dataset(data, split).has_alpha
