"""Data sets of dots in the layouts of other programs: COLMAP, nerfstudio, LLFF, NeRO."""

import json
import pickle
import struct
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from mi_refgs.data.colmap_model import MODELS
from tests.scenes.dots import COLOURS, POINTS, Shot

SHOTS = [Shot(f"{'abcdefghi'[i]}.png", i) for i in range(9)]
MODEL, VALUES = "PINHOLE", (110.0, 104.0, 50.3, 34.6)


def _pose(shot: Shot) -> list[float]:
    """COLMAP's: w, x, y, z of the rotation, and the translation."""
    x, y, z, w = Rotation.from_matrix(shot.rotation).as_quat().tolist()
    return [w, x, y, z, *shot.translation.tolist()]


def write_text(model: Path, shots: list[Shot], camera: str = MODEL, values: Sequence[float] = VALUES) -> None:
    """The dots and these cameras as a COLMAP model; every second image has a point and a free keypoint."""
    size = (shots[0].width, shots[0].height)
    files: dict[str, list[tuple[object, ...]]] = {
        "cameras": [("# comment",), (7, camera, *size, *values)],
        "images": [("# Image list with two lines of data per image:",)],
        "points3D": [("# points\n",)],
    }
    for i, shot in enumerate(shots):
        files["images"].append((i + 1, *_pose(shot), 7, shot.name))
        files["images"].append((1.5, 2.5, 3, 10.0, 20.0, -1) if i % 2 else ())
    for i, (point, colour) in enumerate(zip(POINTS.tolist(), COLOURS.tolist(), strict=True)):
        files["points3D"].append((i, *point, *colour, 0.5, 1, 0, 2, 0, 3, i))
    model.mkdir(parents=True, exist_ok=True)
    for name, lines in files.items():
        text = "".join(" ".join(map(str, line)) + "\n" for line in lines)
        (model / f"{name}.txt").write_bytes(text.encode())


def write_binary(
    model: Path, shots: list[Shot], camera: str = MODEL, values: Sequence[float] = VALUES
) -> None:
    """The same contents in binary records."""
    kind, size = MODELS[camera][0] if camera in MODELS else 7, (shots[0].width, shots[0].height)
    cameras = struct.pack(f"<QiiQQ{len(values)}d", 1, 7, kind, *size, *values)
    images, points = struct.pack("<Q", len(shots)), struct.pack("<Q", len(POINTS))
    for i, shot in enumerate(shots):
        images += struct.pack("<i7di", i + 1, *_pose(shot), 7) + shot.name.encode() + b"\0"
        images += struct.pack("<Qddqddq", 2, 1.5, 2.5, 3, 10, 20, -1) if i % 2 else struct.pack("<Q", 0)
    for i, (point, colour) in enumerate(zip(POINTS, COLOURS.tolist(), strict=True)):
        points += struct.pack("<Q3d3BdQ6i", i, *point, *colour, 0.5, 3, 1, 0, 2, 0, 3, i)
    model.mkdir(parents=True, exist_ok=True)
    for name, content in {"cameras": cameras, "images": images, "points3D": points}.items():
        (model / f"{name}.bin").write_bytes(content)


WRITERS = {"txt": write_text, "bin": write_binary}


def write_colmap(
    folder: Path, kind: str = "bin", shots: list[Shot] = SHOTS, place: str = "sparse/0", **camera: object
) -> Path:
    for shot in shots:
        shot.write(folder / "images")
    WRITERS[kind](folder / place, shots, **camera)  # type: ignore[arg-type]
    return folder


OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # from OpenCV's axes


def write_nerfstudio(folder: Path, shots: list[Shot] = SHOTS, **content: Any) -> Path:
    """`transforms.json` with intrinsics for the whole file, but for those of one frame."""
    frames = []
    for shot in shots:
        shot.write(folder / "images")
        pose = (shot.camera_to_world @ OPENGL).tolist()
        frames.append({"file_path": f"images/{shot.name}", "transform_matrix": pose})
        frames[-1] |= {"colmap_im_id": shot.index, "fl_x": shot.focal[0], "fl_y": shot.focal[1]}
        frames[-1] |= {"cx": shot.centre[0], "cy": shot.centre[1], "w": shot.width, "h": shot.height}
    whole = {"camera_model": "OPENCV", "fl_x": 1.0, "fl_y": 1.0, "cx": 1.0, "cy": 1.0} | content
    (folder / "transforms.json").write_text(json.dumps(whole | {"frames": frames}))
    return folder


def write_transforms(folder: Path, frames: list[dict[str, Any]], **content: Any) -> Path:
    for split in ("train", "test"):
        (folder / f"transforms_{split}.json").write_text(json.dumps(content | {"frames": frames}))
    return folder


def change_transforms(data: Path, change: Callable[[dict[str, Any]], object], split: str = "") -> None:
    """Change the content of the transforms files, or of that of one split, in place."""
    for path in data.glob(f"transforms*{split}.json"):
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))


def ply_bytes(columns: dict[str, np.ndarray], kind: str = "binary_little_endian") -> bytes:
    """A PLY file by hand, as another program would write it; properties have the types of the columns."""
    names = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort"}
    count = len(next(iter(columns.values())))
    header = f"ply\nformat {kind} 1.0\ncomment by hand\nelement vertex {count}\n"
    header += "".join(f"property {names[c.dtype.str[1:]]} {name}\n" for name, c in columns.items())
    if kind == "ascii":
        rows = zip(*(c.tolist() for c in columns.values()), strict=True)
        body = "".join(" ".join(map(repr, row)) + "\n" for row in rows).encode()
    else:
        order = "<" if "little" in kind else ">"
        table = np.empty(count, dtype=[(name, order + c.dtype.str[1:]) for name, c in columns.items()])
        for name, values in columns.items():
            table[name] = values
        body = table.tobytes()
    return f"{header}end_header\n".encode() + body


def point_bytes(kind: str = "binary_little_endian") -> bytes:
    """The dots as a PLY file of coloured points."""
    names = ("x", "y", "z", "red", "green", "blue")
    return ply_bytes(dict(zip(names, [*POINTS.T, *COLOURS.T.astype(np.uint8)], strict=True)), kind)


def write_llff(folder: Path, factor: int = 1) -> Path:
    rows = []
    for shot in SHOTS:
        same = replace(shot, focal=(107.0, 107.0), centre=(48.0, 36.0))
        same.write(folder / "images")
        right, down, forward, position = same.camera_to_world[:3].T
        size = np.array([72 * factor, 96 * factor, 107.0 * factor])
        rows.append([*np.stack([down, right, -forward, position, size], axis=-1).ravel(), 1.0, 9.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder


def write_glossy(folder: Path, protocol: int = 4) -> Path:
    for shot in SHOTS:
        replace(shot, name=f"{shot.index}.png").write(folder)
        depth = np.full((72, 96), 65535, dtype=np.uint16)
        depth[:, 32:] = round(3.0 / 15 * 65535)
        depth[:, 64:] = round(14.6 / 15 * 65535)
        Image.fromarray(depth).save(folder / f"{shot.index}-depth.png")
        pose = np.concatenate([shot.rotation, shot.translation[:, None]], axis=1)
        matrix = np.array([[110.0, 0, 50.3], [0, 104.0, 34.6], [0, 0, 1]])
        content = [pose.astype(np.float32), np.asfortranarray(matrix)]
        (folder / f"{shot.index}-camera.pkl").write_bytes(pickle.dumps(content, protocol))
    return folder
