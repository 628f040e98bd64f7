"""Files of data sets in other layouts than Blender's, to be mutated, and calls that read them."""

from __future__ import annotations

import io
import pickle
import struct
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from mi_refgs.data.array_pickle import read_arrays
from mi_refgs.data.colmap_model import MODELS
from mi_refgs.data.dataset import read_dataset
from mi_refgs.data.llff import read_poses
from mi_refgs.data.transforms import read_points
from mi_refgs.io.images import read_tiff, write_png

VIEWS = 3
SIZE = (8, 6)
NAMES = {"cam": "cameras", "ima": "images", "poi": "points3D"}
"""What the first three bytes of a mutated file say it is; the fourth says text or binary."""
CAMERAS = [
    ("PINHOLE", (9.0, 9.5, 4.2, 3.1)),
    ("OPENCV", (9.0, 9.5, 4.2, 3.1, 0.03, -0.01, 1e-3, -1e-3)),
    ("SIMPLE_RADIAL_FISHEYE", (9.0, 4.0, 3.0, 0.1)),
]


def _binary() -> dict[str, bytes]:
    cameras = b"".join(
        struct.pack("<iiQQ", i, MODELS[name][0], *SIZE) + struct.pack(f"<{len(values)}d", *values)
        for i, (name, values) in enumerate(CAMERAS)
    )
    images, points = b"", b""
    for i in range(VIEWS):
        images += struct.pack("<i8d", i, 1, 0.1 * i, 0, 0, 0, 0, 3, 0)[:-8] + struct.pack("<i", i)
        images += f"{i}.png".encode() + b"\0" + struct.pack("<Qddq", 1, 1.5, 2.5, 0)
        points += struct.pack("<Q3d3BdQ2i", i, 0.1 * i, 0, 0, 1, 2, 3, 0.5, 1, 0, 0)
    count = struct.pack("<Q", VIEWS)
    return {"cameras": count + cameras, "images": count + images, "points3D": count + points}


def _text() -> dict[str, bytes]:
    cameras = "\n".join(
        f"{i} {name} {SIZE[0]} {SIZE[1]} {' '.join(map(str, values))}"
        for i, (name, values) in enumerate(CAMERAS)
    )
    images = "\n".join(f"{i} 1 {0.1 * i} 0 0 0 0 3 {i} {i}.png\n1.5 2.5 0" for i in range(VIEWS))
    points = "# points\n" + "\n".join(f"{i} {0.1 * i} 0 0 1 2 3 0.5 0 0 1 1" for i in range(VIEWS))
    return {"cameras": cameras.encode(), "images": images.encode(), "points3D": points.encode()}


def colmap_files(folder: Path) -> list[bytes]:
    """All files of a model as text and binary, with their kind before them, and images in the folder."""
    (folder / "images").mkdir(exist_ok=True)
    for i in range(VIEWS):
        write_png(folder / f"images/{i}.png", np.random.default_rng(i).random((SIZE[1], SIZE[0], 3)))
    return [
        short.encode() + ending + files[name]
        for ending, files in ((b"b", _binary()), (b"t", _text()))
        for short, name in NAMES.items()
    ]


def read_colmap(folder: Path, data: bytes) -> None:
    """A model of whole files with the mutated one among them."""
    kind, ending = NAMES.get(data[:3].decode("latin-1"), "images"), "txt" if data[3:4] == b"t" else "bin"
    model = folder / "sparse"
    model.mkdir(exist_ok=True)
    for old in model.iterdir():
        old.unlink()
    for name, whole in (_text() if ending == "txt" else _binary()).items():
        (model / f"{name}.{ending}").write_bytes(data[4:] if name == kind else whole)
    found = read_dataset(folder, "train")
    values = [
        x for view in found.views for x in (view.load().image, view.to_world, np.array([view.fx, view.cy]))
    ]
    if found.points is not None:
        values.append(found.points.position)
    assert all(np.isfinite(value).all() for value in values), "a value that is not finite"


class Code:
    """Pickled, it runs code when it is read."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (exec, ("raise SystemExit('code was run')",))


def pickles(folder: Path) -> list[bytes]:
    """Cameras of Glossy Synthetic in every protocol, and one with code."""
    arrays = [np.eye(4)[:3], np.diag([9.0, 9.0, 1.0]).astype(np.float32)]
    return [*(pickle.dumps(arrays, protocol) for protocol in range(6)), pickle.dumps([*arrays, Code()])]


def read_pickle(path: Path) -> None:
    """Numbers may be anything; `glossy` checks them."""
    assert all(array.dtype == np.float64 for array in read_arrays(path))


def pose_tables(folder: Path) -> list[bytes]:
    """Tables of LLFF in several types, and one of objects."""
    files = []
    for table in (
        np.ones((3, 17)),
        np.ones((3, 17), np.float32, order="F"),
        np.array([Code()], dtype=object),
    ):
        buffer = io.BytesIO()
        np.save(buffer, table)
        files.append(buffer.getvalue())
    return files


def read_pose_table(path: Path) -> list[Any]:
    return [read_poses(path)]


def point_files(folder: Path) -> list[bytes]:
    """Points with colours of 8 bits and of floats, binary and text."""
    head = "element vertex 3\n" + "".join(f"property float {c}\n" for c in "xyz")
    colours = "".join(f"property {{}} {c}\n" for c in ("red", "green", "blue")) + "end_header\n"
    rows = np.zeros(3, dtype=[("p", "<f4", 3), ("c", "u1", 3)])
    binary = f"ply\nformat binary_little_endian 1.0\n{head}{colours.format(*['uchar'] * 3)}".encode()
    text = f"ply\nformat ascii 1.0\n{head}{colours.format(*['float'] * 3)}" + "0 1 2 0.5 0.5 1\n" * 3
    return [binary + rows.tobytes(), text.encode()]


def read_point_file(path: Path) -> list[Any]:
    found = read_points(path)
    return [] if found is None else [found.position, found.colour]


def disparities(folder: Path) -> list[bytes]:
    """TIFF files of floats and of 16 bits, packed and not."""
    files = []
    for dtype in (np.float32, np.uint16):
        for compression in ("raw", "tiff_lzw", "tiff_adobe_deflate"):
            buffer = io.BytesIO()
            Image.fromarray(np.ones((6, 8), dtype)).save(buffer, "TIFF", compression=compression)
            files.append(buffer.getvalue())
    return files


def read_disparity(path: Path) -> list[Any]:
    return [read_tiff(path)]
