"""Files made to harm: each once ended in another exception than an InputError, a hang, or much memory."""

import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from trimesh.resolvers import FilePathResolver

from mi_refgs.errors import abbreviated
from mi_refgs.io.exr import read_exr_image, write_exr
from mi_refgs.io.files import read_json
from mi_refgs.io.images import image_header, read_png
from mi_refgs.occlusion.mesh import read_mesh
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.surfels.ply import read_ply
from tests.helpers import refused

XYZ = "property float x\nproperty float y\nproperty float z\n"
TRIANGLE = "0 0 0\n1 0 0\n0 1 0\n"
LIST = "property list uchar int vertex_indices\n"
MUCH = 10**12


def ply(kind: str, body: str, data: str = "") -> bytes:
    return f"ply\nformat {kind} 1.0\n{body}end_header\n{data}".encode()


def refuse_file(read: Callable[[Path], Any], path: Path, data: bytes, *words: str) -> None:
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


def test_mesh_reader_opens_no_other_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither materials nor textures are opened."""
    (tmp_path / "in").mkdir()
    (tmp_path / "secret.mtl").write_text("newmtl a\nmap_Kd secret.png\n")
    text = "mtllib ../secret.mtl\nusemtl a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    (tmp_path / "in" / "a.obj").write_text(text)
    opened: list[str] = []
    monkeypatch.setattr(FilePathResolver, "get", lambda _, name: opened.append(name))
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
    for read in (read_png, image_header):
        refuse_file(read, tmp_path / "a.png", png(12_000, 12_000), "12000 × 12000", "hold")
    write_exr(tmp_path / "b.exr", np.ones((4, 6, 3)))
    good = (tmp_path / "b.exr").read_bytes()
    window = struct.pack("<4i", 0, 0, 5, 3)
    assert window in good and image_header(tmp_path / "b.exr") == (6, 4, False)
    large = "a.exr: size: 32768 × 8193 pixels are more than 268 million"
    for corner, words in (((2**15 - 1, 2**13), large), ((-5, 3), ""), ((2**31 - 1, 2**31 - 1), "")):
        other = good.replace(window, struct.pack("<4i", 0, 0, *corner)) + bytes(2**22)
        for reader in (read_exr_image, image_header, EnvironmentLight.from_file):
            refuse_file(reader, tmp_path / "a.exr", other, words)


@pytest.mark.parametrize("first", [b"#?RADIANCE\n\n-Y 100000 +X 100000\n", b"PF\n100000 100000\n-1.0\n"])
def test_lights_with_huge_sizes_are_refused(first: bytes, tmp_path: Path) -> None:
    refuse_file(EnvironmentLight.from_file, tmp_path / "a.hdr", first + b"\0" * 100)


@pytest.mark.parametrize(
    "text", ["[" * 10**5, '{"a":' * 10**5, "[]", "", "\ud800", '{"a": ' + "9" * 5000 + "}"]
)
def test_json_other_than_objects_is_refused(text: str, tmp_path: Path) -> None:
    refuse_file(read_json, tmp_path / "a.json", text.encode(errors="surrogatepass"), "JSON")


def test_messages_abbreviate_values() -> None:
    assert abbreviated("a") == "'a'" and len(abbreviated("a" * 500)) == 81
    assert "int" in abbreviated(16**6000)
