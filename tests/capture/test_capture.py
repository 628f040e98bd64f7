"""`refgs capture`: cameras of a scene that the tests photograph, and error messages."""

import contextlib
import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import trimesh
from PIL import Image

from mi_refgs.capture import colmap, output, pipeline
from mi_refgs.capture.colmap import EXHAUSTIVE, Solved, pairs_to_match
from mi_refgs.capture.frame import region_of_interest, up_direction
from mi_refgs.capture.photographs import find_masks, find_photographs, mask_pixels
from mi_refgs.capture.pipeline import require_placed
from mi_refgs.cli import main
from mi_refgs.data.lens import Lens, undistortion
from mi_refgs.io.images import exif_tags, read_png
from tests.helpers import read_loaded, refused, slow
from tests.scenes import photographed as scene

COUNT = 9
NAMES = [f"{i:02} ({i}).png" for i in range(COUNT)]
stopped = Mock(side_effect=KeyboardInterrupt)
needs_colmap = pytest.mark.skipif(not find_spec("pycolmap"), reason='pip install "mi_refgs[capture]"')


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    """What a level camera sees from an arc."""
    return [scene.photograph(shot) for shot in scene.around(COUNT)]


@pytest.fixture(scope="module")
def captured(images: Sequence[np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with photographs and their data set: names with spaces, one EXIF-rotated photograph, masks."""
    folder = tmp_path_factory.mktemp("with space")
    for i, image in enumerate(images):
        stored = np.rot90(image) if i == 4 else image
        scene.save(folder / "photographs" / NAMES[i], stored, focal35=38, orientation=6 if i == 4 else 1)
        mask = np.zeros(stored.shape[:2], dtype=np.uint8)
        mask[: len(mask) // 2] = 255
        Image.fromarray(mask).save(_made(folder / "masks") / NAMES[i])
    arguments = ["--masks", str(folder / "masks")]
    assert main(["capture", str(folder / "photographs"), "-o", str(folder / "data"), *arguments]) == 0
    return folder


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _model(data: Path) -> Any:
    return colmap.pycolmap.Reconstruction(data / "sparse" / "0")


@needs_colmap
def test_cameras_are_found_up_to_a_similarity(captured: Path) -> None:
    solved = Solved.of(_model(captured / "data"))
    shots = scene.around(COUNT)
    assert solved.names == NAMES
    true = np.array([shot.origin for shot in shots])
    matrix = trimesh.registration.procrustes(solved.origin, true, reflection=False)[0]
    scale, shift = np.cbrt(np.linalg.det(matrix[:3, :3])), matrix[:3, 3]
    rotation, extent = matrix[:3, :3] / scale, np.linalg.norm(true - true.mean(axis=0), axis=1).max()
    found = solved.origin @ matrix[:3, :3].T + shift
    assert np.linalg.norm(found - true, axis=1).max() < 0.01 * extent
    turned = solved.rotation @ rotation.T
    cosine = [(np.trace(a @ b.rotation.T) - 1) / 2 for a, b in zip(turned, shots, strict=True)]
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 0.5
    # The world is upright, and its unit ball contains the block.
    assert rotation[2] @ [0, 0, 1] > np.cos(np.radians(1)) and 0.5 < scale < 2
    assert np.linalg.norm(shift - np.array([0, 0, scene.BLOCK[2] / 2])) < 0.5 * scale


@needs_colmap
def test_capture_writes_images_masks_region_and_report(captured: Path, images: list[np.ndarray]) -> None:
    data = captured / "data"
    report = json.loads((data / "capture.json").read_text())
    assert (report["placed"], report["photographs"], report["not_placed"]) == (COUNT, COUNT, [])
    assert 0 < report["mean_reprojection_error"] < 0.5 and report["mean_track_length"] > 2
    region = json.loads((data / "region.json").read_text())
    assert (region["centre"], region["radius"], region["estimated"]) == ([0, 0, 0], 1, True)
    assert region["planes"][0][2] > 0.99  # the ground
    assert (data / "capture.png").stat().st_size > 10_000
    model = _model(data)
    [camera] = model.cameras.values()
    assert camera.model_name == "PINHOLE" and (camera.width, camera.height) == (scene.WIDTH, scene.HEIGHT)
    assert camera.focal_length_x == pytest.approx(scene.FOCAL, rel=0.02)
    # The rotated photograph is upright, and so is its mask.
    assert np.array_equal(read_png(data / "images" / NAMES[4]) * 255, images[4])
    mask = np.asarray(Image.open(data / "masks" / f"{NAMES[4]}.png"))
    half = scene.WIDTH // 2
    assert mask.shape == (scene.HEIGHT, scene.WIDTH) and not mask[:, :half].any() and mask[:, half:].all()
    error = pytest.approx(report["mean_reprojection_error"], rel=0.1)
    assert model.compute_mean_reprojection_error() == error
    # Straightened coordinates, moved cameras and moved points belong together.
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() < 0.5


@needs_colmap
def test_captured_data_set_is_read(captured: Path) -> None:
    """Cameras, alpha from the masks, points and region, as one set that every eighth view tests."""
    train, test = (read_loaded(captured / "data", split) for split in ("train", "test"))
    assert [view.name for view in test.views] == [NAMES[0], NAMES[8]] and len(train.views) == COUNT - 2
    assert all(view.alpha is not None and {0.0, 1.0} == {*np.unique(view.alpha)} for view in train.views)
    assert train.region is not None and train.points is not None
    # What pycolmap has written is what its own reader finds.
    model = _model(captured / "data")
    [camera], solved = model.cameras.values(), Solved.of(model)
    assert {(view.fx, view.fy, view.cx, view.cy) for view in train.views} == {tuple(camera.params)}
    for view in train.views:
        i = NAMES.index(view.name)
        np.testing.assert_allclose(view.to_world[:3, 3], solved.origin[i], atol=1e-9)
        np.testing.assert_allclose(view.to_world[:3, 2], solved.axis[i], atol=1e-9)


@needs_colmap
def test_second_capture_computes_nothing(captured: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = captured / "data"
    before = {path.name: path.stat().st_mtime_ns for path in (data / "images").iterdir()}
    origin = Solved.of(_model(data)).origin
    for name in ("extract", "match", "reconstruct"):
        monkeypatch.setattr(colmap, name, stopped)
    command = ["capture", *map(str, (captured / "photographs", "-o", data, "--masks", captured / "masks"))]
    assert main(command) == 0
    assert {path.name: path.stat().st_mtime_ns for path in (data / "images").iterdir()} == before
    np.testing.assert_array_equal(Solved.of(_model(data)).origin, origin)
    assert main([*command, "--region", "0.1", "0.2", "0.3", "0.5"]) == 0
    region = json.loads((data / "region.json").read_text())
    assert (region["centre"], region["radius"]) == ([0.1, 0.2, 0.3], 0.5) and "estimated" not in region
    # What a user saved stays.
    (data / "region.json").write_text(json.dumps(region | {"radius": 0.75, "planes": [[0, 0, 1, -2]]}))
    assert main(command) == 0
    kept = json.loads((data / "region.json").read_text())
    assert (kept["radius"], kept["planes"]) == (0.75, [[0, 0, 1, -2]])


@pytest.mark.slow
@needs_colmap
def test_interrupted_capture_goes_on(captured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Features and matches that are there are not made again, and the result is that of one run."""
    data = tmp_path / "data"
    command = ["capture", str(captured / "photographs"), "-o", str(data)]
    whole, calls = colmap.match, []

    def interrupted(database: Path, pairs: Sequence[tuple[str, str]]) -> None:
        whole(database, pairs[:10])
        raise KeyboardInterrupt

    monkeypatch.setattr(colmap, "match", interrupted)
    assert main(command) == 130
    monkeypatch.setattr(colmap, "match", whole)
    monkeypatch.setattr(colmap, "begin", lambda *_: calls.append("begin"))
    assert main(command) == 0 and not calls and not (data / "masks").exists()
    found, expected = (Solved.of(_model(folder)).origin for folder in (data, captured / "data"))
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.slow
@needs_colmap
def test_distorted_lens_is_estimated_and_undone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shots = scene.around(10)
    for i, shot in enumerate(shots):
        scene.save(tmp_path / "photographs" / f"{i}.png", scene.photograph(shot, k1=-0.15))
    assert main(["capture", str(tmp_path / "photographs"), "-o", str(tmp_path / "data")]) == 0
    report = json.loads((tmp_path / "data" / "capture.json").read_text())
    assert report["lens"]["model"] == "SIMPLE_RADIAL" and report["placed"] == 10
    assert report["lens"]["cameras"][0]["parameters"][3] == pytest.approx(-0.15, abs=0.03)
    [pinhole] = _model(tmp_path / "data").cameras.values()
    # The image is what a pinhole sees whose focal length is longer by the same factor.
    zoom = pinhole.focal_length_x / report["lens"]["cameras"][0]["parameters"][0]
    monkeypatch.setattr(scene, "FOCAL", scene.FOCAL * zoom)
    wanted = scene.photograph(shots[3], samples=2) / 255

    def error(folder: str) -> float:
        return float(np.sqrt(np.mean((read_png(tmp_path / folder / "3.png") - wanted) ** 2)))

    assert error("data/images") < 0.5 * error("photographs")
    model = _model(tmp_path / "data")
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() < 0.6


def test_images_of_a_lens_are_straightened(rng: np.random.Generator) -> None:
    pixels = rng.integers(0, 255, (24, 32, 3), dtype=np.uint8)
    undo = undistortion(Lens(False, (0.1,)), 32, 24, 30.0, 30.0, 16.0, 12.0)
    found = output.Straight((32, 24), (30.0, 30.0), (16.0, 12.0), undo).resample(pixels)
    np.testing.assert_array_equal(found, np.rint(undo.resample(pixels.astype(np.float32))))
    assert np.abs(found.astype(int) - pixels).max() > 10


@needs_colmap
def test_other_lens_rewrites_images(captured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Images and cameras share one lens; a list of test views is kept, masks removed if none are given."""
    data = tmp_path / "data"
    shutil.copytree(captured / "data", data)
    (data / "sparse" / "0" / "test.txt").write_text(NAMES[3])
    whole, inode = output.straighten, (data / "images" / NAMES[0]).stat().st_ino

    def longer(*arguments: Any) -> dict[str, output.Straight]:
        found = whole(*arguments)
        return {name: replace(s, focal=(s.focal[0] * 1.01, s.focal[1] * 1.01)) for name, s in found.items()}

    monkeypatch.setattr(output, "straighten", longer)
    [before] = _model(data).cameras.values()
    command = ["capture", str(captured / "photographs"), "-o", str(data)]
    with monkeypatch.context() as patch:
        patch.setattr(output, "write_model", stopped)
        assert main(command) == 130 and not (data / "sparse/0/images.bin").exists()
    assert main(command) == 0 and not (data / "masks").exists()
    [after] = _model(data).cameras.values()
    assert after.focal_length_x == pytest.approx(1.01 * before.focal_length_x)
    assert (data / "images" / NAMES[0]).stat().st_ino != inode
    assert [view.name for view in read_loaded(data, "test").views] == [NAMES[3]]
    # Masks that a user made are of the images beside which they were made.
    (data / "masks").mkdir()
    (data / "masks/mine.png").write_bytes(b"")
    monkeypatch.setattr(output, "straighten", whole)
    assert main(command) == 0 and (data / "oldmasks1/mine.png").is_file() and not (data / "masks").exists()
    assert len([*(data / "oldmasks").iterdir()]) == len(NAMES)  # of the first capture: they may be corrected
    # A region that a user saved is of the cameras that it was saved with.
    (data / "region.json").write_text('{"centre": [0, 0, 0], "radius": 2}')
    monkeypatch.setattr(pipeline, "VERSION", 0)
    monkeypatch.setattr(pipeline, "_solve", stopped)
    assert main(command) == 130 and not (data / "region.json").exists()
    assert json.loads((data / "region.old.json").read_text())["radius"] == 2
    monkeypatch.setattr(pipeline, "_solve", Mock(side_effect=RuntimeError("disk")))
    refused(command, ".work: COLMAP: disk; free some space, or remove it")


@needs_colmap
def test_output_around_the_source_is_refused(captured: Path) -> None:
    data, photographs = captured / "data", captured / "photographs"
    before = sorted(data.rglob("*"))
    for arguments in [(data / "images", "-o", data), (photographs, "-o", captured)]:
        refused(["capture", *arguments], "which is read; choose another")
    refused(["capture", photographs, "-o", data, "--masks", data / "masks"], "which is read")
    refused(["capture", photographs, "-o", captured / "masks"], "not empty, and no capture")
    assert sorted(data.rglob("*")) == before


def _one_place(i: int) -> np.ndarray:
    """The camera turns on the spot."""
    target = (0.35 * np.cos(i), 0.35 * np.sin(i), 0.3)
    return scene.photograph(scene.look(np.array([3.0, 0.4, 1.6]), target))


@needs_colmap
@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda i: np.full((96, 128, 3), 100 + i, dtype=np.uint8), "patterned ground"),
        (lambda i: (scene.noise(50 + i, 192) * 255).astype(np.uint8), "two thirds"),
        slow(_one_place, "walk around"),
    ],
    ids=["flat", "unrelated", "one place"],
)
def test_failed_capture_names_a_remedy(make: Callable[[int], np.ndarray], words: str, tmp_path: Path) -> None:
    for i in range(5):
        scene.save(tmp_path / "photographs" / f"{i}.png", make(i))
    refused(["capture", tmp_path / "photographs", "-o", tmp_path / "data"], words)
    assert not (tmp_path / "data" / "sparse").exists()


def test_disconnected_groups_are_counted(tmp_path: Path) -> None:
    refused(lambda: require_placed(tmp_path, 9, [4, 3]), "only 4, 3 could be placed together, in 2 groups")
    require_placed(tmp_path, 8, [4, 3])


def test_unusable_photographs_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    photographs = _made(tmp_path / "photographs")
    command = ["capture", photographs, "-o", tmp_path / "data"]
    (photographs / "a.HEIC").write_bytes(b"0")
    refused(command, "convert its .HEIC files to JPEG")
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        (photographs / name).write_bytes(b"0")
    refused(command, "a.jpg: pixels: not a readable image")
    (photographs / "a.jpg").write_bytes(b"\0\0\0\x24ftypheic" + bytes(99))
    refused(command, "a.jpg: pixels: a HEIC, AVIF or video file of another name")
    refused([*command, "--camera-model", "PIG"], "unknown lens model")
    refused([*command, "--region", 0, 0, "nan", 1], "--region: centre, radius: not three numbers")
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        scene.save(photographs / name, np.zeros((8, 8, 3), dtype=np.uint8))
    refused([*command, "--masks", tmp_path / "no"], "no such folder")
    assert not (tmp_path / "data").exists()
    for width in range(9, 13):
        scene.save(photographs / f"{width}.jpg", np.zeros((8, width, 3), dtype=np.uint8))
    refused(command, "5 different sizes, such as 10 × 8 ('10.jpg')")


def test_photographs_in_subfolders(tmp_path: Path) -> None:
    """Whatever their format; masks are no photographs."""
    for i, kind in enumerate(("JPEG", "WEBP", "PNG")):
        Image.new("RGB", (6, 4), (80 * i, 0, 0)).save(_made(tmp_path / str(i)) / "a.jpg", kind, lossless=True)
        Image.new("L", (6, 4)).save(_made(tmp_path / "masks") / f"{i}.png")
    for copy in (".work/pictures/0.png", "images/0/a.jpg", ".thumbnails/a.jpg"):  # of a capture, of a desktop
        shutil.copy(tmp_path / "0/a.jpg", _made((tmp_path / "out" / copy).parent))
    shutil.copy(tmp_path / "0/a.jpg", _made(tmp_path / "run/previews"))
    (tmp_path / "run/.refgs").write_text("run")
    found = find_photographs(tmp_path)
    assert [photograph.name for photograph in found] == ["0/a.jpg", "1/a.jpg", "2/a.jpg"]
    said = list[str]()
    for name in ("b.jpg", "c.jpg", "d.jpg", "e.HEIC"):
        shutil.copy(tmp_path / "0/a.jpg", tmp_path / name)
    assert [one.name for one in find_photographs(tmp_path, said.append)] == ["b.jpg", "c.jpg", "d.jpg"]
    assert "3 images in subfolders" in said[0] and "1 .HEIC file; convert" in said[1] and len(said) == 2
    assert [np.asarray(photograph.load())[1, 2, 0] for photograph in found] == [0, 80, 160]


def test_missing_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pycolmap", None)
    refused(["capture", tmp_path, "-o", tmp_path / "data"], 'pip install "mi_refgs[capture]"')


def test_exif_gives_orientation_and_focal_length(tmp_path: Path) -> None:
    wide = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    tall = wide.transpose(1, 0, 2)
    shown = [turned for x in (wide, tall) for turned in (x, x[:, ::-1], x[::-1, ::-1], x[::-1])]
    for orientation in range(1, 9):
        scene.save(tmp_path / f"{orientation}.png", wide, orientation=orientation, focal35=43.2666 * 0.75)
    found = find_photographs(tmp_path)
    for photograph in found:
        upright = shown[photograph.orientation - 1]
        assert photograph.size == upright.shape[1::-1] and photograph.stored_size == (6, 4)
        # EXIF's focal length is whole: 32 mm.
        assert photograph.focal == pytest.approx(0.75, rel=0.05)
        # All lie one way, and `up` says where the top of the upright image went.
        lying = np.rot90(upright) if photograph.lying else upright
        np.testing.assert_array_equal(np.asarray(photograph.load()), lying)
        assert photograph.up == ((-1, 0) if photograph.lying else (0, -1))
    assert len({photograph.kept_size for photograph in found}) == 1


def test_exposure_in_exif_is_kept(tmp_path: Path) -> None:
    exif, settings = Image.Exif(), {0x829A: 0.01, 0x829D: 1.8, 0x8827: 200}
    exif[0x8769] = settings
    exif[0x0112] = 3
    (tmp_path / "photographs").mkdir()
    for name in ("a.jpg", "b.jpg", "c.png"):
        Image.new("RGB", (32, 24)).save(tmp_path / "photographs" / name, exif=exif)
    found = find_photographs(tmp_path / "photographs")
    undo = undistortion(Lens(False, (0.1,)), 32, 24, 30.0, 30.0, 16.0, 12.0)
    straight = output.Straight((32, 24), (30.0, 30.0), (16.0, 12.0), undo)
    output.write_images(found, {photograph.copy: straight for photograph in found}, {}, tmp_path)
    for photograph in found:
        with Image.open(tmp_path / "images" / photograph.name) as image:
            tags, kept = exif_tags(image)
        assert kept == {tag: pytest.approx(x) for tag, x in settings.items()} and 0x0112 not in tags


def test_broken_exif_is_ignored(tmp_path: Path) -> None:
    pixels = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    for name in ("a.jpg", "b.jpg", "c.png"):
        Image.fromarray(pixels).save(tmp_path / name, exif=b"Exif\0\0garbage")
    for photograph in find_photographs(tmp_path):
        assert (photograph.orientation, photograph.focal) == (1, None)
        assert photograph.load().size == (6, 4) and photograph.load(3).size == (3, 2)
    np.testing.assert_array_equal(np.asarray(photograph.load()), pixels)


def test_masks_match_photographs_by_name_and_size(tmp_path: Path) -> None:
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        scene.save(tmp_path / "p" / name, np.zeros((4, 6, 3), dtype=np.uint8))
    photographs = find_photographs(tmp_path / "p")
    mask = np.zeros((4, 6), dtype=np.uint8)
    mask[1] = 255
    masks = _made(tmp_path / "m")
    Image.fromarray(mask).save(masks / "a.png")
    Image.fromarray(mask.astype(np.uint16) * 100).save(masks / "b.jpg.png")  # 16 bits, not used in full
    refused(lambda: find_masks(masks, photographs), "m/c.png: mask: missing; add it")
    Image.fromarray(np.dstack([np.full((4, 6, 3), 9, dtype=np.uint8), mask])).save(masks / "c.png")
    found = find_masks(masks, photographs)
    for photograph in photographs:  # white where the object is; where an image is cut out, its alpha
        grey = round(25500 / 257) if photograph.name == "b.jpg" else 255
        pixels = mask_pixels(found[photograph.name], photograph)
        np.testing.assert_array_equal(pixels[..., 0], np.where(mask > 0, grey, 0))
    Image.fromarray(mask[:2]).save(masks / "c.png")
    refused(lambda: find_masks(masks, photographs), "6 × 2 pixels, but c.jpg has 6 × 4")
    for name in ("a_mask.png", "b_mask.png", "c_mask.png"):  # beside the photographs, which are no masks
        Image.fromarray(mask).save(tmp_path / "p" / name)
    beside = find_masks(tmp_path / "p", photographs)
    assert [path.name for path in beside.values()] == ["a_mask.png", "b_mask.png", "c_mask.png"]


@needs_colmap
def test_transparent_pixels_are_masks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If all images have some; opaque alpha is none."""
    monkeypatch.setattr(pipeline, "_solve", stopped)
    said = list[str]()
    for i in range(4):
        alpha = np.full((4, 6), 255, np.uint8)
        alpha[0] = 0 if i else 255
        Image.fromarray(np.dstack([np.zeros((4, 6, 3), np.uint8), alpha])).save(tmp_path / f"{i}.png")
    palette = Image.open(tmp_path / "1.png").convert("P")
    palette.save(tmp_path / "1.png", transparency=bytes([0, *[255] * 255]))
    found = find_photographs(tmp_path)
    assert [one.cut_out for one in found] == [False, True, True, True] and not any(one.plain for one in found)
    for words in ("3 of 4 images are not used", "3 of 3 images are masks"):
        with contextlib.suppress(KeyboardInterrupt):
            pipeline.capture(tmp_path, tmp_path / "out", tell=said.append)
        assert words in said[-1]
        (tmp_path / "0.png").unlink(missing_ok=True)


def test_large_sets_match_neighbours_and_similar_images(rng: np.random.Generator) -> None:
    """Images of ten places, each visited in every tenth image: likeness finds them, order does not."""
    places = rng.integers(0, 256, (10, 40, 128))
    count = EXHAUSTIVE + 50
    noisy = np.clip(np.tile(places, (count // 10, 1, 1)) + rng.normal(0, 8, (count, 40, 128)), 0, 255)
    features = {f"{i:03}": image.astype(np.uint8) for i, image in enumerate(noisy)}
    pairs = set(pairs_to_match(features))
    assert len(pairs) < 0.25 * count * (count - 1) / 2
    assert all((f"{i:03}", f"{i + 1:03}") in pairs for i in range(count - 1))
    far = [(a, b) for a, b in pairs if int(b) - int(a) > 8]
    assert far and np.mean([int(a) % 10 == int(b) % 10 for a, b in far]) > 0.9
    assert len(pairs_to_match({name: features[name] for name in sorted(features)[:5]})) == 10


def _solved(origin: np.ndarray, target: tuple[float, float, float], points: np.ndarray) -> Solved:
    rotation = np.array([scene.look(o, target).rotation for o in origin])
    names, length = [str(i) for i in range(len(origin))], np.full(len(points), 3)
    return Solved(names, rotation, origin, np.full(len(origin), 0.4), points, length)


@pytest.mark.parametrize("arc", [300.0, 5.0], ids=["around", "from the front"])
def test_up_direction_is_that_of_level_cameras(arc: float, rng: np.random.Generator) -> None:
    """Level cameras, a quarter of which is rolled by up to 60°, in a world that is turned anyhow."""
    origin = np.array([shot.origin for shot in scene.around(40, arc)])
    solved = _solved(origin, (0, 0, 1.5), np.empty((0, 3)))
    roll = np.where(np.arange(40) % 4 == 0, rng.uniform(-1, 1, 40), 0) * (arc > 90)
    up = np.stack([np.sin(roll), -np.cos(roll)], axis=1)
    world, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    world *= np.linalg.det(world)
    turned = replace(solved, rotation=solved.rotation @ world.T, origin=origin @ world.T)
    assert np.degrees(np.arccos((up_direction(turned, up) @ world)[2])) < (1 if arc > 90 else 5)


def test_region_of_interest_is_what_most_cameras_look_at(rng: np.random.Generator) -> None:
    origin = np.array([shot.origin for shot in scene.around(30, 300, radius=4)])
    near = rng.normal((0.2, 0, 0.4), 0.15, (400, 3))
    far = rng.uniform(-30, 30, (4000, 3))
    region = region_of_interest(_solved(origin, (0.2, 0, 0.4), np.concatenate([near, far])))
    assert np.linalg.norm(np.array(region.centre) - [0.2, 0, 0.4]) < 0.1
    assert 0.4 < region.radius < 1.3 and np.mean(region.contains(near)) > 0.9


@needs_colmap
def test_model_that_is_not_written_whole_is_refused(captured: Path, tmp_path: Path) -> None:
    """As on a full disk, of which COLMAP says nothing."""
    colmap.write(_model(captured / "data"), tmp_path)
    cut = (tmp_path / "points3D.bin").read_bytes()[:-20]
    broken = Mock(write_binary=lambda folder: (folder / "points3D.bin").write_bytes(cut))
    refused(lambda: colmap.write(broken, tmp_path), "output: not written whole; free some space, and repeat")
