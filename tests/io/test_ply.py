"""PLY files: bit-exact round trip, 2DGS's layout, tolerance of other writers' files, and every refusal."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh

from mi_refgs.surfels.ply import read_ply, write_ply
from mi_refgs.surfels.table import Surfels
from tests.helpers import refused
from tests.scenes.layouts import ply_bytes
from tests.scenes.splats import random_raw

GEOMETRY = ["x", "y", "z", "opacity", "scale_0", "scale_1", "rot_0", "rot_1", "rot_2", "rot_3"]
COLOURS = ["nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(45))]


def write_file(
    path: Path, columns: dict[str, np.ndarray], kind: str = "binary_little_endian", dtype: str = "f4"
) -> Path:
    path.write_bytes(ply_bytes({name: np.asarray(values, dtype) for name, values in columns.items()}, kind))
    return path


def geometry(rng: np.random.Generator, count: int = 4) -> dict[str, np.ndarray]:
    return {name: rng.normal(size=count).astype(np.float32) for name in GEOMETRY}


@pytest.mark.parametrize("count", [0, 1, 100])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_round_trip_is_bit_exact(count: int, degree: int, tmp_path: Path, rng: np.random.Generator) -> None:
    surfels = Surfels.from_numpy(random_raw(count, rng, degree))
    write_ply(tmp_path / "a.ply", surfels)
    again = read_ply(tmp_path / "a.ply")
    assert list(again.raw) == list(surfels.raw)
    for name, values in surfels.to_numpy().items():
        assert values.tobytes() == again.to_numpy()[name].tobytes()
    write_ply(tmp_path / "b.ply", again)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.ply", "b.ply"]


def test_layout_is_that_of_2dgs(tmp_path: Path, rng: np.random.Generator) -> None:
    """Names, order, w-first quaternion and channel-major spherical harmonics, read by another library."""
    surfels = Surfels.from_numpy(random_raw(3, rng, 3))
    write_ply(tmp_path / "a.ply", surfels)
    header = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")[0].decode().splitlines()
    names = [line.split()[2] for line in header if line.startswith("property")]
    start = [*GEOMETRY[:3], *COLOURS, *GEOMETRY[3:]]
    assert names[: len(start)] == start
    assert names[len(start) :][:5] == ["albedo_0", "albedo_1", "albedo_2", "metallic", "roughness"]
    data = trimesh.load(tmp_path / "a.ply").metadata["_ply_raw"]["vertex"]["data"]
    raw = surfels.to_numpy()
    np.testing.assert_array_equal(data["rot_0"].ravel(), raw["rotation"][:, 3])
    np.testing.assert_array_equal(data["rot_1"].ravel(), raw["rotation"][:, 0])
    np.testing.assert_array_equal(data["f_dc_2"].ravel(), raw["radiance_sh"][:, 2])
    # Coefficient k = 1..15 of colour c is f_rest_{15 c + k - 1}; in the table it is column 3 k + c.
    np.testing.assert_array_equal(data["f_rest_17"].ravel(), raw["radiance_sh"][:, 3 * 3 + 1])
    np.testing.assert_array_equal(data["ind_rest_44"].ravel(), raw["indirect_sh"][:, 3 * 15 + 2])


@pytest.mark.parametrize("dtype", ["f4", "f8"])
@pytest.mark.parametrize("kind", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_ply_of_others_is_read(kind: str, dtype: str, tmp_path: Path, rng: np.random.Generator) -> None:
    """Other order, elements before and after the vertices, unknown properties, lists of different lengths."""
    columns = {"confidence": np.ones(2), **dict(reversed(geometry(rng, 2).items()))}
    written = ply_bytes({name: values.astype(dtype) for name, values in columns.items()}, kind)
    header, _, body = written.partition(b"end_header\n")
    faces = b"element face 2\nproperty list uchar int vertex_indices\nelement vertex"
    header = header.replace(b"element vertex", faces) + b"property list uchar short seen\n"
    header += b"element camera 1\nproperty double focal\nend_header\n"
    first, second = body[: len(body) // 2], body[len(body) // 2 :]
    content = b"\3" + bytes(12) + b"\0" + first + b"\2" + bytes(4) + second + b"\0" + bytes(8)
    if kind == "ascii":
        first, second = body.splitlines()
        content = b"3 0 1 0\n0\n" + first + b" 2 7 8\n" + second + b" 0\n1.5\n"
    (tmp_path / "a.ply").write_bytes(header + content)
    raw = read_ply(tmp_path / "a.ply").to_numpy()
    assert list(raw) == ["position", "rotation", "scale", "opacity"]
    np.testing.assert_array_equal(raw["scale"][:, 1], columns["scale_1"])
    np.testing.assert_array_equal(raw["rotation"][:, 3], columns["rot_0"])


def test_3dgs_file_round_trip(tmp_path: Path, rng: np.random.Generator) -> None:
    """Its properties, in its order; a third scale is what tells it from surfels."""
    order = [*GEOMETRY[:3], *COLOURS, *GEOMETRY[3:6], "scale_2", *GEOMETRY[6:]]
    columns = {name: rng.normal(size=4).astype(np.float32) for name in order}
    columns |= {name: np.zeros(4, np.float32) for name in ("nx", "ny", "nz")}
    gaussians = read_ply(write_file(tmp_path / "3dgs.ply", columns))
    assert gaussians.primitive.name == "gaussian" and gaussians.sh_degree() == 3
    np.testing.assert_array_equal(gaussians.to_numpy()["scale"][:, 2], columns["scale_2"])
    write_ply(tmp_path / "again.ply", gaussians)
    written, read = ((tmp_path / name).read_bytes() for name in ("again.ply", "3dgs.ply"))
    assert written[written.index(b"element") :] == read[read.index(b"element") :]
    del columns["scale_1"]
    refused(lambda: read_ply(write_file(tmp_path / "a.ply", columns)), "scale_1: the property is missing")


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ({"albedo_0": 0, "albedo_2": 0}, "albedo_1: the property is missing; export"),
        ({"ind_rest_0": 0}, "ind_rest_*: 1 properties; use 0, 9, 24 or 45"),
    ],
)
def test_partial_groups_are_refused(
    extra: dict[str, int], message: str, tmp_path: Path, rng: np.random.Generator
) -> None:
    columns = geometry(rng) | {name: np.zeros(4) for name in extra}
    refused(lambda: read_ply(write_file(tmp_path / "a.ply", columns)), f"a.ply: {message}")


def test_non_finite_values_are_counted(tmp_path: Path, rng: np.random.Generator) -> None:
    columns = geometry(rng)
    columns["opacity"][1:3] = np.nan, np.inf
    path = write_file(tmp_path / "a.ply", columns)
    refused(lambda: read_ply(path), "a.ply: opacity: 2 values are NaN or infinite; remove")
    columns["opacity"] = np.full(4, 1e300)
    refused(lambda: read_ply(write_file(tmp_path / "a.ply", columns, dtype="f8")), "opacity: 4 values")


def test_broken_files_are_refused(tmp_path: Path, rng: np.random.Generator) -> None:
    path = write_file(tmp_path / "a.ply", geometry(rng))
    whole = path.read_bytes()
    text = write_file(tmp_path / "t.ply", geometry(rng), "ascii").read_bytes()
    for data, message in [
        (whole[:-1], "vertex: 4 rows are more than the file contains; copy"),
        (whole[:60], "no end_header; the file is truncated or broken"),
        (b"\x89PNG\r\n", "not a PLY file"),
        (text.replace(text.split()[-1], b"zero"), "row 3 is broken"),
        (whole.replace(b"format binary_little_endian", b"format pdp_endian"), "no format or no element"),
        (whole.replace(b"element vertex", b"element vertices"), "vertex: the element is missing"),
        (text[: text.rindex(b" ")], "row 3 is broken or missing"),
        (whole.replace(b"float scale_1", b"float scale_0"), "a property of vertex occurs twice"),
    ]:
        path.write_bytes(data)
        refused(partial(read_ply, path), message)
    refused(lambda: read_ply(tmp_path / "gone.ply"), "gone.ply: file: missing")


def test_bad_values_are_not_written(tmp_path: Path, rng: np.random.Generator) -> None:
    surfels = Surfels.from_numpy(random_raw(3, rng, 3))
    write_ply(tmp_path / "a.ply", surfels)
    before = (tmp_path / "a.ply").read_bytes()
    raw = surfels.to_numpy() | {"albedo": np.full((3, 3), np.nan)}
    refused(lambda: write_ply(tmp_path / "a.ply", Surfels.from_numpy(raw)), "albedo: 9 values are NaN")
    assert (tmp_path / "a.ply").read_bytes() == before
