"""Files of lights: as other programs write them, averaged to fewer rows, or no light."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

from mi_refgs.errors import InputError
from mi_refgs.io import exr
from mi_refgs.io.exr import Part, write_exr
from mi_refgs.io.images import linear_from_srgb, read_png, write_png
from mi_refgs.render.load_scene import load_scene
from mi_refgs.shade.light import envmap, lobe_matrices
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.latlong import environment_image
from mi_refgs.shade.light.light_file import read_radiance
from mi_refgs.shade.light.lobe_matrices import map_directions
from tests.helpers import refused, unit

Captured = pytest.CaptureFixture[str]
SIZE = 32  # pixels of a face
HALF = np.float16


def marked(direction: Any) -> np.ndarray:
    """Radiance of one place by direction in Mitsuba's frame: each axis has a colour of its own."""
    return np.asarray(0.5 + 0.4 * unit(np.stack(np.broadcast_arrays(*direction), -1)), np.float32)


def faces() -> dict[str, np.ndarray]:
    """Of OpenGL's cube (table 8.19 of its specification): left-handed, +z is the middle of a lat-long map."""
    s, t = np.meshgrid(*[(np.arange(SIZE) + 0.5) / SIZE * 2 - 1] * 2)
    seen = {"+x": (1, -t, -s), "-x": (-1, -t, s), "+y": (s, 1, t), "-y": (s, -1, -t), "+z": (s, -t, 1)}
    return {name: marked((-np.array(x), y, z)) for name, (x, y, z) in (seen | {"-z": (-s, -t, -1)}).items()}


def openexr_cube() -> np.ndarray:
    """By the drawing in ImfEnvmap.h: right-handed, the outer pixels of a face are on its edges."""
    s, t = np.meshgrid(np.linspace(-1, 1, SIZE), np.linspace(-1, 1, SIZE))
    seen = ((1, -t, s), (-1, -t, -s), (s, 1, -t), (s, -1, t), (-s, -t, 1), (s, -t, -1))
    return np.concatenate([marked(direction) for direction in seen])


def angular(size: int = 4 * SIZE) -> np.ndarray:
    """Debevec's light probe, black outside of its disc."""
    u, v = np.meshgrid(*[(np.arange(size) + 0.5) / size * 2 - 1] * 2)
    radius = np.hypot(u, v)
    sine = np.sin(np.pi * radius) / radius
    return np.where(radius[..., None] < 1, marked((-u * sine, -v * sine, np.cos(np.pi * radius))), 0)


def layout(name: str) -> np.ndarray:
    gl, empty = faces(), np.zeros((SIZE, SIZE, 3), np.float32)
    gl |= {".": empty, "z-": gl["-z"][::-1, ::-1]}
    table = {
        "row": "+x -x +y -y +z -z",
        "column": "+x\n-x\n+y\n-y\n+z\n-z",
        "cross": ". +y . .\n-x +z +x -z\n. -y . .",
        "upright cross": ". +y .\n-x +z +x\n. -y .\n. z- .",
    }
    if name in table:
        rows = [np.concatenate([gl[face] for face in row.split()], 1) for row in table[name].splitlines()]
        return np.concatenate(rows)
    return angular() if name == "angular" else openexr_cube()


@pytest.mark.parametrize("name", ["row", "column", "cross", "upright cross", "angular", "OpenEXR"])
def test_layouts_agree_with_the_lat_long_map_of_the_same_place(
    name: str, tmp_path: Path, capsys: Captured
) -> None:
    """Also where Mitsuba looks the map up, and at no more rows than wanted."""
    path, picture = tmp_path / "a.exr", layout(name)
    header = {"type": OpenEXR.scanlineimage} | ({"envmap": OpenEXR.ENVMAP_CUBE} if name == "OpenEXR" else {})
    OpenEXR.File(header, {"RGB": np.ascontiguousarray(picture)}).write(str(path))
    found = read_radiance(path)
    assert found.shape == (2 * SIZE, 4 * SIZE, 3)
    np.testing.assert_allclose(found, marked(np.moveaxis(map_directions(2 * SIZE), -1, 0)), atol=0.01)
    assert len(read_radiance(path, 16)) == 16
    told = {"angular": "read as an angular map", "OpenEXR": ""}.get(name, "read as the faces of a cube")
    assert told in (said := capsys.readouterr().err) and bool(told) == bool(said)


def test_a_small_sun_on_a_cube_keeps_its_energy(tmp_path: Path) -> None:
    """A texel shines as much in a map of a quarter of the rows."""
    picture = np.zeros((64, 6 * 64, 3), np.float32)
    picture[40, 4 * 64 + 20] = 1000
    write_exr(tmp_path / "a.exr", picture)
    image = read_radiance(tmp_path / "a.exr", 32)[..., 0]
    texels = np.sin(np.linspace(0, np.pi, 32))[:, None] * (np.pi / 31) * (2 * np.pi / 64)
    solid_angle = (2 / 64) ** 2 / (1 + (20.5 / 32 - 1) ** 2 + (40.5 / 32 - 1) ** 2) ** 1.5
    assert (image * texels).sum() == pytest.approx(1000 * solid_angle, rel=0.1)


GREY = (0.5, 0.25, 0.125)
PLAIN = {channel: np.full((16, 32), value, HALF) for channel, value in zip("RGB", GREY, strict=True)}
HOT = np.where(np.arange(512).reshape(16, 32) == 101, np.inf, 0.5)  # at row 3, column 5
WINDOW = {"dataWindow": ((0, 4), (31, 19)), "displayWindow": ((0, 0), (31, 31))}
CHROMA = {"Y": PLAIN["R"], "RY": PLAIN["B"], "BY": -PLAIN["B"]}


def layer(name: str) -> dict[str, np.ndarray]:
    return {f"{name}.{channel}": plane for channel, plane in PLAIN.items()}


@pytest.mark.parametrize(
    ("header", "planes", "row", "value", "told"),
    [
        ({"preview": OpenEXR.PreviewImage(2, 1)}, PLAIN, 3, GREY, ""),
        (WINDOW, PLAIN, 4, GREY, "placed in the display window"),
        (WINDOW, PLAIN, 3, (0, 0, 0), "32 × 32 pixels are stretched"),
        ({}, {"Y": PLAIN["R"]}, 3, (0.5, 0.5, 0.5), ""),
        ({}, CHROMA, 3, (0.5625, 0.488, 0.4375), ""),
        ({}, layer("b.Combined") | layer("a"), 3, GREY, "layer 'b.Combined' are read"),
        ({}, layer("color") | {"a.Z": HOT.astype(HALF)}, 3, GREY, "layer 'color' are read"),
        ({}, dict.fromkeys("RGB", HOT.astype(HALF)), 3, (65504,) * 3, "1 infinite texel set to 65504"),
        ({}, dict.fromkeys("RGB", HOT.astype("f")), 3, (0.5,) * 3, "1 infinite texel set to 0.5, the large"),
        ({}, dict.fromkeys("RGB", np.full((16, 32), 7, np.uint32)), 3, (7, 7, 7), ""),
        ({}, PLAIN | {"G": -PLAIN["G"]}, 3, (0.5, 0, 0.125), "512 texels below 0 set to 0"),
    ],
)
def test_exr_of_other_programs(
    header: Any, planes: Any, row: int, value: Any, told: str, tmp_path: Path, capsys: Captured
) -> None:
    OpenEXR.File({"type": OpenEXR.scanlineimage} | header, planes).write(str(tmp_path / "a.exr"))
    np.testing.assert_allclose(read_radiance(tmp_path / "a.exr")[row, 5], value, rtol=2e-3)
    assert told in (said := capsys.readouterr().err) and bool(told) == bool(said)


def test_samples_of_coarser_channels_are_repeated() -> None:
    stored = np.arange(6, dtype=HALF).reshape(2, 3)
    part = Part(True, {"RY": ("<f2", (2, 3), stored.tobytes())}, (0, 0, 4, 3), (1, 1, 4, 3), "", None, None)
    np.testing.assert_array_equal(part.plane("RY"), [[0, 1, 1, 2], [3, 4, 4, 5], [3, 4, 4, 5]])


def test_a_crash_of_the_exr_library_is_an_error_of_the_file(tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", np.ones((4, 8, 3)))
    exr._end()
    command = [sys.executable, "-c", "import os, sys; sys.stdin.readline(); os.kill(os.getpid(), 11)"]
    exr._processes[os.getpid()] = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    refused(lambda: read_radiance(tmp_path / "a.exr"), "a.exr: header:", "(status -11); export it again")
    assert read_radiance(tmp_path / "a.exr").shape == (4, 8, 3)


PIXEL, RED = bytes((128, 64, 32, 129)), bytes((128, 0, 0, 129))  # (1, 1/2, 1/4) and (1, 0, 0)
WIDE, BRIGHT = "-Y 16 +X 32", "EXPOSURE=2\nEXPOSURE= 2.0\nCOLORCORR=1 2 1"
RUNS = (bytes((2, 2, 0, 32)) + b"".join(bytes((160, value)) for value in PIXEL)) * 16
LONG = PIXEL + bytes((1, 1, 1, 87, 1, 1, 1, 2))  # 1 + 87 + 2 · 256 pixels


@pytest.mark.parametrize(
    ("header", "size", "data", "value", "told"),
    [
        ("", WIDE, PIXEL * 512, (1, 0.5, 0.25), ""),
        ("", WIDE, RUNS, (1, 0.5, 0.25), ""),
        ("", WIDE, (PIXEL + bytes((1, 1, 1, 31))) * 16, (1, 0.5, 0.25), ""),
        ("", "-Y 2 +X 600", LONG * 2, (1, 0.5, 0.25), "stretched"),
        ("\r", WIDE, PIXEL * 512, (1, 0.5, 0.25), ""),
        (BRIGHT, WIDE, PIXEL * 512, (1 / 4, 1 / 16, 1 / 16), "divided by [4. 8. 4.]"),
        ("FORMAT=32-bit_rle_xyze", WIDE, PIXEL * 512, (2.3477, 0, 0.2178), "XYZ is converted"),
        ("", "+Y 16 +X 32", PIXEL * 480 + RED + PIXEL * 31, (1, 0, 0), ""),
        ("", "-Y 16 -X 32", PIXEL * 31 + RED + PIXEL * 480, (1, 0, 0), ""),
        ("", "+X 32 -Y 16", RED + PIXEL * 511, (1, 0, 0), ""),
        ("", "-X 32 +Y 16", PIXEL * 511 + RED, (1, 0, 0), ""),
    ],
)
def test_radiance_images_of_other_programs(
    header: str, size: str, data: bytes, value: Any, told: str, tmp_path: Path, capsys: Captured
) -> None:
    """The pixel at the top left; every line of a header ends in CR LF if one does."""
    lines = ["#?RADIANCE", *header.strip().splitlines(), "", size, ""]
    (tmp_path / "a.hdr").write_bytes(("\r\n" if "\r" in header else "\n").join(lines).encode() + data)
    np.testing.assert_allclose(read_radiance(tmp_path / "a.hdr")[0, 0], value, rtol=1e-3)
    assert told in (said := capsys.readouterr().err) and bool(told) == bool(said)


def test_what_contradicts_itself_is_refused(tmp_path: Path) -> None:
    cube, outside = {"envmap": OpenEXR.ENVMAP_CUBE}, {"displayWindow": ((40, 0), (71, 15))}
    window = {"dataWindow": ((0, 0), (31, 15))} | outside
    path = tmp_path / "a"
    for header, words in ((cube, "a cube, but of 32 × 16"), (window, "no pixel is in the display window")):
        OpenEXR.File({"type": OpenEXR.scanlineimage} | header, PLAIN).write(str(path))
        refused(lambda: read_radiance(path), words)
    for line in ("EXPOSURE=0", "EXPOSURE=x", "COLORCORR=1 2"):
        path.write_bytes(f"#?RADIANCE\n{line}\n\n{WIDE}\n".encode() + PIXEL * 512)
        refused(lambda: read_radiance(path), "EXPOSURE, COLORCORR: no numbers")


def test_scenes_read_their_maps_so(tmp_path: Path, capsys: Captured, monkeypatch: pytest.MonkeyPatch) -> None:
    """Emitter and texture of a Mitsuba scene, in a folder that it names; a broken file is named."""
    monkeypatch.chdir(tmp_path)
    path = Path("scenes/a.xml")
    (image := Path("scenes/maps/a.exr")).parent.mkdir(parents=True)
    OpenEXR.File({"type": OpenEXR.scanlineimage} | WINDOW, PLAIN).write(str(image))
    file = '<string name="filename" value="a.exr"/>'
    texture = f'<bsdf type="diffuse"><texture type="bitmap" name="reflectance">{file}</texture></bsdf>'
    scene = f'<emitter type="envmap">{file}</emitter><shape type="sphere">{texture}</shape>'
    path.write_text(f'<scene version="3.0.0"><path value="maps"/>{scene}</scene>')
    loaded = load_scene(path)
    assert "a.exr: pixels" in capsys.readouterr().err
    np.testing.assert_allclose(environment_image(loaded, 16)[[0, 8], 0], [(0, 0, 0), GREY], atol=1e-3)
    (reflectance,) = (v for k, v in mi.traverse(loaded).items() if k.endswith("reflectance.data"))
    assert np.array(reflectance).shape[:2] == (32, 32)
    image.write_bytes(image.read_bytes()[:300])
    refused(lambda: load_scene(path), "a.exr: header: not a readable EXR file")


@pytest.mark.parametrize("kind", ["float.exr", "half.exr", "8_bits.png"])
def test_finer_map_is_averaged(kind: str, tmp_path: Path, rng: np.random.Generator) -> None:
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
