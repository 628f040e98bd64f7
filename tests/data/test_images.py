"""From image files to pixels: shrinking decoders, masks, opaque alpha, loading on request, the cache."""

import dataclasses
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from unittest.mock import Mock, create_autospec

import numpy as np
import pytest
from PIL import Image
from skimage.transform import resize_local_mean

from mi_refgs.data.dataset import View, read_dataset
from mi_refgs.data.images import BAND, ImageCache, ImageFile, ImageSource, Mask, Pixels, compose
from mi_refgs.data.survey import survey
from mi_refgs.fitting.targets import PIXEL_BYTES, Target, Targets
from mi_refgs.io.exr import write_exr
from mi_refgs.io.images import box_downscale, read_bytes, read_grey, read_png, write_png
from mi_refgs.methods.method import CoarseImages, DataOptions
from tests.helpers import refused
from tests.scenes.highlight import ball
from tests.scenes.layouts import write_transforms
from tests.scenes.tiny import write_data


def smooth(width: int, height: int, scale: float = 20.0) -> np.ndarray:
    """An image without detail, which JPEG compression hardly changes."""
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    waves = [np.sin(x / scale), np.cos(y / scale), np.sin((x + y) / (2 * scale))]
    return 0.5 + 0.4 * np.stack(waves, axis=-1)


def read(path: Path, downscale: float, mask: Mask | None = None) -> tuple[np.ndarray, np.ndarray | None]:
    return compose(ImageFile.of(path, downscale, mask).decode(), 0.0)


def jpeg(path: Path, pixels: np.ndarray, **options: Any) -> Path:
    Image.fromarray(np.round(255 * pixels).astype(np.uint8)).save(path, quality=97, subsampling=0, **options)
    return path


@pytest.fixture
def decode(monkeypatch: pytest.MonkeyPatch) -> Mock:
    """Records the files that are decoded."""
    recorded: Mock = create_autospec(ImageFile.decode, side_effect=ImageFile.decode)
    monkeypatch.setattr(ImageFile, "decode", recorded)
    return recorded


@pytest.mark.parametrize(("scale", "factor"), [(1, 1), (2, 2), (3, 1), (6.3, 2), (8, 8), (12, 4), (16, 8)])
def test_jpeg_decoder_shrinks_like_averaging(scale: float, factor: int, tmp_path: Path) -> None:
    """Whatever the orientation in EXIF data."""
    exif = Image.Exif()
    exif[0x0112] = 6
    path = jpeg(tmp_path / "a.jpg", smooth(157, 101), exif=exif)
    assert read_bytes(path, int(scale))[1] == factor
    image, alpha = read(path, scale)
    assert alpha is None and image.shape[:2] == (int(101 / scale), int(157 / scale))
    expected = box_downscale(read_png(path), scale)
    assert np.abs(image - expected).mean() < 3e-3 and np.abs(image - expected).max() < 0.03


@pytest.mark.parametrize("size", [(15, 25), (16, 26)])
def test_blocks_share_pixels(size: tuple[int, int], rng: np.random.Generator) -> None:
    """Each counts its part; what is left over is left out."""
    image = rng.random((*size, 3)).astype(np.float32)
    expected = resize_local_mean(image[:15, :25], (12, 20))
    np.testing.assert_allclose(box_downscale(image, 25 / 20), expected, atol=1e-6)


def test_image_of_many_bands_equals_whole_image(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", np.random.default_rng(0).random((3 * BAND + 5, 9, 4)))
    straight = read_png(tmp_path / "a.png")
    straight[..., :3] *= straight[..., 3:]
    for downscale in (1, 2, 2.6, 7):
        image, alpha = read(tmp_path / "a.png", downscale)
        assert alpha is not None
        np.testing.assert_array_equal(np.dstack([image, alpha]), box_downscale(straight, downscale))


def test_mask_becomes_alpha(tmp_path: Path) -> None:
    """Colour outside of the mask does not bleed in; own alpha, which premultiplies EXR files, multiplies."""
    covered = np.zeros((8, 8))
    covered[:, 3:] = 1
    colour = np.where(covered[..., None] > 0, [0.2, 0.4, 0.6], [1.0, 0.0, 1.0])
    write_png(tmp_path / "m.png", np.repeat(covered[..., None], 3, axis=-1))
    write_png(tmp_path / "a.png", colour)
    for path in (tmp_path / "a.png", jpeg(tmp_path / "a.jpg", smooth(8, 8))):
        image, alpha = read(path, 2, Mask(tmp_path / "m.png"))
        assert alpha is not None
        np.testing.assert_allclose(alpha, np.tile([0, 0.5, 1, 1], (4, 1)), atol=1e-6)
        if path.suffix == ".png":
            np.testing.assert_allclose(image[:, 1], np.tile([0.1, 0.2, 0.3], (4, 1)), atol=1e-6)
    own, mask = np.full((8, 8, 1), 0.4), Mask(tmp_path / "m.png")
    own[:, 6:] = 0
    write_png(tmp_path / "b.png", np.concatenate([colour, own], axis=-1))
    image, alpha = read(tmp_path / "b.png", 2, mask)
    np.testing.assert_allclose(alpha, np.tile([0, 0.2, 0.4, 0], (4, 1)), atol=1e-6)  # type: ignore[arg-type]
    np.testing.assert_allclose(image[:, 2], np.tile([0.08, 0.16, 0.24], (4, 1)), atol=1e-6)
    for stem, premultiplied in (("a", colour), ("b", np.concatenate([colour * own, own], axis=-1))):
        write_exr(tmp_path / f"{stem}.exr", premultiplied)
        linear, encoded = (read(tmp_path / f"{stem}.{kind}", 2, mask) for kind in ("exr", "png"))
        np.testing.assert_allclose(linear[0], encoded[0], atol=1e-3)
        np.testing.assert_allclose(np.asarray(linear[1]), np.asarray(encoded[1]), atol=1e-3)
    write_png(tmp_path / "m.png", np.ones((6, 4, 3)))
    refused(lambda: read(tmp_path / "a.png", 1, mask), "m.png: mask: 4 × 6 pixels, but a.png has 8 × 8")


def test_mask_formats(tmp_path: Path) -> None:
    """8 bits, labels 0 and 1, alpha, 16 bits used in full or not; and a depth with a threshold."""
    bits = np.array([[0, 255, 128]], dtype=np.uint8)
    files: dict[str, tuple[np.ndarray, list[float]]] = {
        "grey": (bits, [0, 1, 128 / 255]),
        "labels": ((bits == 255).astype(np.uint8), [0, 1, 0]),
        "alpha": (np.dstack([np.full_like(bits, 9), bits]), [0, 1, 128 / 255]),
        "deep": (bits.astype(np.uint16) * 257, [0, 1, 128 / 255]),
        "deep labels": ((bits == 255).astype(np.uint16), [0, 1, 0]),
        "shallow": (bits.astype(np.uint16), [0, 1, 128 / 255]),
        "black": (0 * bits, [0, 0, 0]),
        "green": (np.dstack([0 * bits, bits // 2, 0 * bits]), [0, 1, 64 / 127]),
    }
    for name, (pixels, expected) in files.items():
        Image.fromarray(pixels).save(tmp_path / f"{name}.png")
        np.testing.assert_allclose(Mask(tmp_path / f"{name}.png").read(), [expected], atol=1e-6)
    labels = Image.fromarray(np.array([[0, 1, 2]], np.uint8))
    labels.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0])  # their colours in DAVIS and VOC
    labels.save(tmp_path / "coloured.png")
    np.testing.assert_array_equal(Mask(tmp_path / "coloured.png").read(), [[0, 1, 1]])
    assert read_grey(tmp_path / "deep.png")[1] == 65535
    np.testing.assert_array_equal(read_grey(tmp_path / "shallow.png")[0], bits)  # unscaled, as of depths
    np.testing.assert_array_equal(Mask(tmp_path / "deep.png", below=128 * 257).read(), [[1, 0, 0]])


def make_opaque(data: Path, but: str = "") -> Path:
    """Make the images of a data set opaque, except one stem; as PNG and EXR."""
    for path in data.glob("t*/r_?.png"):
        image = np.array(read_png(path))
        image[..., 3] = np.where(path.stem == but, image[..., 3], 1)
        write_png(path, image)
        write_exr(path.with_suffix(".exr"), image)
    return data


@pytest.mark.parametrize("images", ["png", "exr"])
def test_opaque_alpha_is_ignored(images: str, tmp_path: Path) -> None:
    """Photographs saved as RGBA count as photographs, in both splits; an opaque mask stays a mask."""
    data = write_data(tmp_path / "ball", truth=False)
    make_opaque(data, but="r_2")
    assert all(read_dataset(data, split, images=images).has_alpha for split in ("train", "test"))
    make_opaque(data)
    for split in ("train", "test"):
        found = read_dataset(data, split, images=images)
        assert not found.has_alpha and all(view.load().alpha is None for view in found.views)
        assert found.region is not None and "no pixel is transparent" in found.notes[-1]
    assert not survey(data)["with alpha"]
    if images == "png":
        for path in data.glob("train/r_?.png"):  # while those of test stay RGBA
            write_png(path, read_png(path)[..., :3])
        assert not read_dataset(data, "test").has_alpha
        for path in data.glob("*/r_?.png"):
            write_png(path, read_png(path)[..., :3])
            write_png(path.with_name(f"{path.stem}_alpha.png"), np.ones((20, 20, 3)))
        assert read_dataset(data, "train").has_alpha
        for path in data.glob("*/r_?.png"):
            write_png(path, np.ones((20, 20, 4)))
        assert not read_dataset(data, "train").has_alpha  # a copy of its own
        for path in data.glob("*/r_?_alpha.png"):
            path.rename(path.with_name(path.name.replace("alpha", "mask")))
        assert read_dataset(data, "train").has_alpha


def test_images_without_masks_among_others_are_refused(tmp_path: Path) -> None:
    """Two of seven images are opaque RGBA without a mask. Doctor says it of splits that differ."""
    data = make_opaque(write_data(tmp_path / "ball", views=7, truth=False))
    for i in range(2, 7):
        path = data / f"train/r_{i}.png"
        write_png(path.with_name(f"{path.stem}_alpha.png"), np.eye(20)[..., None].repeat(3, axis=-1))
        write_png(path, read_png(path)[..., :3])
    lacking = "no alpha and no mask for 2 of 7 images, such as 'train/r_0'; give all images masks, or none"
    refused(lambda: read_dataset(data, "train"), lacking)
    for path in data.glob("*/r_?.png"):
        write_png(path, np.ones((20, 20, 3)))
    for i in range(7):
        write_png(data / f"train/r_{i}_alpha.png", np.eye(20)[..., None].repeat(3, axis=-1))
    assert "only some images have alpha; give all images masks, or none" in survey(data)["notes"]


@pytest.mark.parametrize("budget", [0, 1 << 20])
def test_cached_image_equals_decoded_image(budget: int, tmp_path: Path, rng: np.random.Generator) -> None:
    """For every kind of file; 8-bit numbers are cached where the view shows them."""
    for name, channels in (("rgb", 3), ("rgba", 4)):
        write_png(tmp_path / f"{name}.png", rng.random((12, 16, channels)))
        write_exr(tmp_path / f"{name}.exr", rng.random((12, 16, channels)).astype(np.float32))
    Image.fromarray(rng.integers(0, 255, (12, 16), dtype=np.uint8)).save(tmp_path / "mask.png")
    plain = ("rgb.png", "rgba.png", "rgb.exr", "rgba.exr")
    files = {name: ImageFile.of(tmp_path / name, 1) for name in plain}
    files["averaged"] = ImageFile.of(tmp_path / "rgba.png", 2)
    files["masked"] = ImageFile.of(tmp_path / "rgb.png", 1, Mask(tmp_path / "mask.png"))
    cache = ImageCache(budget)
    for name, file in files.items():
        source = ImageSource(file, 0.75, cache, file.has_alpha())
        expected = compose(file.decode(), 0.75)
        assert source.has_alpha == expected.has_alpha == (not name.startswith("rgb."))
        for _ in range(2):
            found = source.read()
            np.testing.assert_array_equal(found.image, expected.image)
            np.testing.assert_array_equal(found.alpha, expected.alpha)
            found.image[:] = 0  # a copy, which the caller may change
        assert cache.pixels(file).dtype == (np.uint8 if name in ("rgb.png", "rgba.png") else np.float32)
    assert cache.bytes <= budget


def test_cache_keeps_images_used_last(tmp_path: Path, rng: np.random.Generator, decode: Mock) -> None:
    for name in "abc":
        write_png(tmp_path / f"{name}.png", rng.random((10, 10, 4)))
    cache = ImageCache(2 * 400)
    for name in "abacabc":
        cache.pixels(ImageFile.of(tmp_path / f"{name}.png", 1))
    stems = [call.args[0].path.stem for call in decode.call_args_list]
    assert stems == ["a", "b", "c", "b", "c"] and cache.bytes == 800


def test_image_decoded_by_two_threads_counts_once(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_png(tmp_path / "a.png", rng.random((20, 20, 4)))
    cache, file = ImageCache(), ImageFile.of(tmp_path / "a.png", 1)
    decode, meet = ImageFile.decode, threading.Barrier(2)

    def together(file: ImageFile) -> np.ndarray:
        meet.wait(20)
        return decode(file)

    monkeypatch.setattr(ImageFile, "decode", together)
    with ThreadPoolExecutor(2) as pool:
        pool.map(cache.pixels, [file] * 2)
    assert cache.bytes == 20 * 20 * 4


def test_targets_are_uploaded_at_once_or_when_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both are equal and of the resolution of the iteration; the most recently used ones are kept."""
    data = ball(24, 5)
    coarse = CoarseImages(until=3, block=2), CoarseImages(until=2, block=4, least=37)
    options = DataOptions(coarse=coarse)
    whole, one = Targets(data, options), PIXEL_BYTES * 24 * 24
    camera = create_autospec(View.camera, side_effect=View.camera)
    monkeypatch.setattr(View, "camera", camera)
    few = Targets(data, options, 2 * one)
    assert not camera.called
    for index in (0, 1, 0, 2, 0, 1):
        assert few.at(4, index).camera.width == 24
        assert np.array_equal(few.at(4, index).image[0], whole.at(4, index).image[0])
        assert whole.at(1, index).camera.width == whole.at(3, index).camera.width == 12
        assert whole.at(4, index) is whole.at(5, index)
    assert [call.args[0].name for call in camera.call_args_list] == ["0", "1", "2", "1"]
    lone = Targets(data, options, 1)
    assert lone.at(4, 3) is lone.at(4, 3) is not lone.at(4, 4)


def test_crop_of_a_target_is_that_part_of_its_view() -> None:
    """Pixels, masks and rays are those of the whole image; a linear one has no clipped pixels."""
    whole = Targets(ball(24, 1), DataOptions()).at(0, 0)
    part = whole.cropped(8, 16, 10, 5)
    rows = (slice(16, 21), slice(8, 18))
    assert whole.alpha is not None and part.alpha is not None and whole.clipped is not None
    assert part.clipped is not None and (part.camera.width, part.camera.height) == (10, 5)
    pairs = [*zip(whole.image, part.image, strict=True), *zip(whole.clipped, part.clipped, strict=True)]
    for one, other in [*pairs, (whole.alpha, part.alpha)]:
        np.testing.assert_array_equal(np.array(other).reshape(5, 10), np.array(one).reshape(24, 24)[rows])
    rays = np.array(whole.camera.rays()).T.reshape(24, 24, 3)[rows]
    np.testing.assert_allclose(np.array(part.camera.rays()).T.reshape(5, 10, 3), rays, atol=1e-6)
    linear = dataclasses.replace(whole, clipped=None, alpha=None).cropped(0, 0, 8, 8)
    assert linear.clipped is None and linear.alpha is None


def test_view_is_decoded_only_by_load(tmp_path: Path, decode: Mock) -> None:
    """`image` of a view that is not loaded raises; `has_alpha` is from the header."""
    frames = [{"file_path": "a.jpg", "transform_matrix": np.eye(4).tolist()}]
    data = write_transforms(tmp_path, frames, camera_angle_x=0.7)
    jpeg(data / "a.jpg", smooth(40, 24))
    view = read_dataset(data, "train", truth=False).views[0]
    assert not view.has_alpha and view.alpha is None
    with pytest.raises(RuntimeError, match=r"view 'a' is not loaded; use view\.load\(\)\.image"):
        view.image  # noqa: B018
    assert not decode.called
    loaded = view.load()
    assert loaded.load() is loaded and loaded.alpha is None
    assert np.array_equal(loaded.image, view.load().image) and decode.call_count == 1
    Target.of(view, np.ones(3))
    assert decode.call_count == 1


def test_pixels_of_another_shape_or_range_than_a_view_has_are_refused() -> None:
    view = View("a", 3, 2, 3, 3, 1.5, 1, np.eye(4), Pixels(np.ones((3, 2, 3))))
    refused(lambda: Target.of(view, np.ones(3)), "a: pixels: image has shape (3, 2, 3)", "give (2, 3")
    view = dataclasses.replace(view, pixels=Pixels(np.full((2, 3, 3), 9, np.uint8)))
    refused(view.load, "a: pixels: image has 9; give 0 … 1, not 0 … 255")
    dataclasses.replace(view, is_linear_radiance=True).load()
