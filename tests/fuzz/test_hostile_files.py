"""Files made to harm: each once ended in another exception than an InputError, a hang, or much memory."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mi_refgs import methods
from mi_refgs.errors import InputError, abbreviated
from mi_refgs.io.exr import read_exr, write_exr
from mi_refgs.io.files import read_json
from mi_refgs.io.images import image_size, read_png
from mi_refgs.occlusion.mesh import read_mesh
from mi_refgs.plugins.properties import read_background, read_light, read_shading, read_surfels
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.runs.views import views_of_run
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.ply import read_ply
from tests.helpers import refused

XYZ = "property float x\nproperty float y\nproperty float z\n"
TRIANGLE = "0 0 0\n1 0 0\n0 1 0\n"
LIST = "property list uchar int vertex_indices\n"
MUCH = 10**12


def ply(kind: str, body: str, data: str = "") -> bytes:
    return f"ply\nformat {kind} 1.0\n{body}end_header\n{data}".encode()


def refuse_file(read: Callable[[Path], Any], path: Path, data: bytes, *words: str) -> None:
    """Require that `read` refuses a file of these bytes, with its name."""
    path.write_bytes(data)
    refused(lambda: read(path), path, *words)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("read", [read_ply, read_mesh])
def test_ply_with_huge_counts_is_refused(read: Callable[[Path], Any], kind: str, tmp_path: Path) -> None:
    for body in (
        f"element vertex {MUCH}\n{XYZ}",
        f"element vertex 3\n{XYZ}element face {MUCH}\n{LIST}",
        f"element vertex {'9' * 400}\n{XYZ}",
        f"element vertex {MUCH}\n",
    ):
        refuse_file(read, tmp_path / "a.ply", ply(kind, body, TRIANGLE))


def test_mesh_faces_out_of_range_are_refused(tmp_path: Path) -> None:
    body = f"element vertex 3\n{XYZ}element face 1\n{LIST}"
    for face in ("3 0 1 3", "3 0 1 1000000000", "3 0 1 -1"):
        refuse_file(read_mesh, tmp_path / "a.ply", ply("ascii", body, f"{TRIANGLE}{face}\n"))
    refuse_file(read_mesh, tmp_path / "a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n")


def test_mesh_beyond_single_precision_is_refused(tmp_path: Path) -> None:
    body = f"element vertex 3\n{XYZ.replace('float', 'double')}element face 1\n{LIST}"
    data = ply("ascii", body, TRIANGLE.replace("1", "1e300") + "3 0 1 2\n")
    refuse_file(read_mesh, tmp_path / "a.ply", data)


def test_mesh_reader_opens_no_other_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither materials nor textures are opened."""
    (tmp_path / "in").mkdir()
    (tmp_path / "secret.mtl").write_text("newmtl a\nmap_Kd secret.png\n")
    (tmp_path / "in" / "a.obj").write_text(
        "mtllib ../secret.mtl\nusemtl a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    )
    opened: list[str] = []
    import trimesh.resolvers

    def get(self: Any, name: str) -> bytes:
        opened.append(name)
        return b""

    monkeypatch.setattr(trimesh.resolvers.FilePathResolver, "get", get)
    assert len(read_mesh(tmp_path / "in" / "a.obj").faces) == 1 and not opened
    refuse_file(read_mesh, tmp_path / "a.glb", b"glTF", "ply, obj, stl, off")


def png(width: int, height: int) -> bytes:
    chunk = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    data = b"IDAT" + zlib.compress(b"\0" * 1000)
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(part) - 4) + part + struct.pack(">I", zlib.crc32(part))
        for part in (chunk, data, b"IEND")
    )


def test_images_with_huge_sizes_are_refused(tmp_path: Path) -> None:
    for read in (read_png, image_size):
        refuse_file(read, tmp_path / "a.png", png(100_000, 100_000))
        refuse_file(read, tmp_path / "a.png", png(12_000, 12_000), "12000 × 12000", "hold")
    write_exr(tmp_path / "b.exr", np.ones((4, 6, 3)))
    good = (tmp_path / "b.exr").read_bytes()
    window = struct.pack("<4i", 0, 0, 5, 3)
    assert window in good and image_size(tmp_path / "b.exr") == (6, 4)
    for corner in ((99_999, 99_999), (-5, 3), (2**31 - 1, 2**31 - 1)):
        other = good.replace(window, struct.pack("<4i", 0, 0, *corner))
        refuse_file(read_exr, tmp_path / "a.exr", other)
        refuse_file(image_size, tmp_path / "a.exr", other)


@pytest.mark.parametrize("first", [b"#?RADIANCE\n\n-Y 100000 +X 100000\n", b"PF\n100000 100000\n-1.0\n"])
def test_lights_with_huge_sizes_are_refused(first: bytes, tmp_path: Path) -> None:
    refuse_file(EnvironmentLight.from_file, tmp_path / "a.hdr", first + b"\0" * 100)


@pytest.mark.parametrize(
    "text", ["[" * 10**5, '{"a":' * 10**5, "[]", "", "\ud800", '{"a": ' + "9" * 5000 + "}"]
)
def test_json_other_than_objects_is_refused(text: str, tmp_path: Path) -> None:
    refuse_file(read_json, tmp_path / "a.json", text.encode(errors="surrogatepass"), "JSON")


@pytest.mark.parametrize(
    "text",
    [
        f"a = {'[' * 10**5}",
        f"iterations = {'9' * 5000}",
        f"iterations = 0x{'f' * 6000}",
        f"iterations = 100\nseed = 0x{'f' * 6000}",
        f"iterations = 100\nvariant = 0x{'f' * 6000}",
        "iterations = 0",
        f"{'a.' * 50_000}a = 1",
        f"extends = 0x{'f' * 6000}",
        "iterations = 100\nloss.ssim = nan",
        "iterations = 100\nloss.ssim = 1e300",
        "extends = 'ref_gaussian'\ndrop = 3",
        "extends = 'ref_gaussian'\ndrop = [3]",
        "extends = 'ref_gaussian'\ndrop = ['iterations.every.one']",
        "iterations = 100\n[stage.a]\nuntil = 9\nat = ['pixel']",
    ],
)
def test_invalid_methods_are_refused(text: str, tmp_path: Path) -> None:
    refuse_file(lambda path: methods.load(str(path)), tmp_path / "a.toml", text.encode())


@pytest.mark.parametrize(
    "content",
    [
        {"iteration": float("inf")},
        {"iteration": float("nan")},
        {"iteration": [3]},
        {"iteration": -1},
        {"seconds": float("nan")},
        {"seconds": 10**400},
        {"shading": {"at": 5}},
        {"shading": {"at": ["pixel"]}},
        {"shading": {"no": 1}},
        {"shading": {"traced_bounces": 10**9}},
        {"shading": {"traced_bounces": 10**9}},
        {"shading": {"no": 1}},
        {"shading": [1]},
        {"files": 7},
        {"files": [["a"]]},
    ],
)
def test_invalid_models_are_refused(content: dict[str, Any], tmp_path: Path) -> None:
    whole = {"iteration": 1, "seconds": 1.0, "shading": {"reflectance": "radiance"}} | content
    refuse_file(
        lambda path: TrainedScene.read(path.parent), tmp_path / "model.json", json.dumps(whole).encode()
    )


@pytest.mark.parametrize("place", [3, None, "a" * 5000, "a\0b", "\ud800", ["a"]])
def test_runs_with_invalid_data_paths_are_refused(place: Any, tmp_path: Path) -> None:
    def read(path: Path) -> None:
        views_of_run(Run(path.parent), methods.load("ref_gaussian"), "train")

    refuse_file(read, tmp_path / "dataset.json", json.dumps({"path": place}).encode(), "path")


def test_invalid_meshes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_mesh(tmp_path / ("x" * 5000))


def test_log_with_invalid_lines_is_read(tmp_path: Path) -> None:
    lines = [
        '{"iteration": 1}',
        '{"iteration": 1e999}',
        '{"iteration": ' + "9" * 400 + "}",
        "[" * 10**5,
        "{}",
    ]
    Run(tmp_path).output.own("metrics.jsonl").write_text("\n".join(lines))
    Run(tmp_path).rewind(5)
    assert (tmp_path / "metrics.jsonl").read_text() == lines[0] + "\n"


class Properties(dict[str, Any]):
    """The interface of mi.Properties that the plugin uses."""

    def objects(self) -> list[Any]:
        return []


@pytest.mark.parametrize(
    ("name", "value", "read"),
    [
        ("opacity", "a", read_surfels),  # Dr.Jit looks for the numbers of a string without end
        ("position", 3.0, read_surfels),
        ("light", "a", read_light),
        ("light", 3, read_light),
        ("background", "white", read_background),
        ("background", [1, 2], read_background),
        ("occlusion", "false", lambda props: read_shading(props, read_surfels(props))),
        ("traced_bounces", 10**9, lambda props: read_shading(props, read_surfels(props))),
    ],
)
def test_properties_of_wrong_type_are_refused(
    name: str, value: Any, read: Callable[[Any], Any], tmp_path: Path
) -> None:
    props = Properties({"metallic": mi.TensorXf([0.0], (1, 1))}) | {name: value}
    with pytest.raises(InputError, match=f"{name}|shape"):
        read(Properties(props))


def test_shading_options_of_wrong_type_are_refused() -> None:
    assert Shading("surfel", "radiance", "sh").at == "surfel"
    with pytest.raises(InputError, match=r"shading: occlusion: 'yes'"):
        Shading(occlusion="yes")  # type: ignore[arg-type]


def test_messages_abbreviate_values() -> None:
    endless: list[Any] = []
    endless.append(endless)
    assert abbreviated("a") == "'a'" and len(abbreviated("a" * 500)) == 81
    assert "int" in abbreviated(16**6000) and abbreviated(endless) == "[[...]]"
