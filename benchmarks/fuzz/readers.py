"""The readers, each with files that it accepts, to be mutated, and a call that reads one."""

from __future__ import annotations

import hashlib
import io
import json
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from PIL import Image

import mi_refgs  # noqa: F401  (chooses the LLVM before Dr.Jit loads)

import mitsuba as mi  # isort: skip
import trimesh

from benchmarks.common.colmap_files import ColmapCamera, ColmapImage, colmap_binary, colmap_text
from mi_refgs import methods
from mi_refgs.data.array_pickle import read_arrays
from mi_refgs.data.dataset import read_dataset
from mi_refgs.data.llff import read_poses
from mi_refgs.data.transforms import read_points
from mi_refgs.errors import InputError
from mi_refgs.io.exr import read_exr_image, write_exr
from mi_refgs.io.images import read_png, read_tiff, write_png
from mi_refgs.io.resources import resource_dir
from mi_refgs.occlusion.mesh import Mesh, read_mesh, write_mesh
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.runs import checkpoint
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.runs.views import views_of_run
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.surfels.attributes import ATTRIBUTES
from mi_refgs.surfels.ply import read_ply, write_ply
from mi_refgs.surfels.table import Surfels
from mi_refgs.synthesis.settings import prepare_folder

VIEWS = 3
SIZE = (8, 6)
NAMES = {"cam": "cameras", "ima": "images", "poi": "points3D"}
"""What the first three bytes of a mutated file say it is; the fourth says text or binary."""
CAMERAS = {
    0: ColmapCamera("PINHOLE", SIZE, (9.0, 9.5, 4.2, 3.1)),
    1: ColmapCamera("OPENCV", SIZE, (9.0, 9.5, 4.2, 3.1, 0.03, -0.01, 1e-3, -1e-3)),
    2: ColmapCamera("SIMPLE_RADIAL_FISHEYE", SIZE, (9.0, 4.0, 3.0, 0.1)),
}
POSES = [ColmapImage(f"{i}.png", i, (1, 0.1 * i, 0, 0), (0, 0, 3)) for i in range(VIEWS)]
WRITERS = {b"b": colmap_binary, b"t": colmap_text}


def _model(kind: bytes) -> dict[str, bytes]:
    """Files of a model by name, text for b"t"."""
    points = 0.1 * np.arange(VIEWS)[:, None] * np.eye(3)[0]
    return WRITERS[kind]((CAMERAS, POSES, points, np.tile([1, 2, 3], (VIEWS, 1))))


def colmap_files(folder: Path) -> list[bytes]:
    """All files of a model as text and binary, with their kind before them, and images in the folder."""
    (folder / "images").mkdir(exist_ok=True)
    for i in range(VIEWS):
        write_png(folder / f"images/{i}.png", np.random.default_rng(i).random((SIZE[1], SIZE[0], 3)))
    files = [(kind, name, data) for kind in WRITERS for name, data in _model(kind).items()]
    return [name[:3].encode() + kind + data for kind, name, data in files]


def read_colmap(folder: Path, data: bytes) -> None:
    """A model of whole files with the mutated one among them."""
    kind, text = NAMES.get(data[:3].decode("latin-1"), "images"), data[3:4] == b"t"
    model = folder / "sparse"
    model.mkdir(exist_ok=True)
    for old in model.iterdir():
        old.unlink()
    for name, whole in _model(b"t" if text else b"b").items():
        (model / f"{name}.{'txt' if text else 'bin'}").write_bytes(data[4:] if name == kind else whole)
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


SEED = 0
"""Seed of the numbers in the files to start from."""
DIGITS = 64
"""Hexadecimal digits of the checksum at the end of a checkpoint."""


@dataclass(frozen=True)
class Reader:
    """One way into the package."""

    name: str
    kind: str  # how `mutate` may change the files: "json", "toml", "xml", or "" for bytes alone
    samples: Callable[[Path], list[bytes]]  # to start from; may put files that these name in the folder
    read: Callable[[Path, bytes], None]  # writes the file into the folder and reads it
    inside: bool = True  # whether it may open files in the folder only
    finish: Callable[[bytes], bytes] = lambda data: data  # after the mutation, every second time


def _read_file(read: Callable[[Path], Any], name: str) -> Callable[[Path, bytes], None]:
    """Fails for an answer that cannot be right: `read` gives the arrays that must be finite, or None."""

    def run(folder: Path, data: bytes) -> None:
        (folder / name).write_bytes(data)
        found = [array for array in read(folder / name) or () if array is not None]
        assert all(np.isfinite(array).all() for array in found), "a value that is not finite"

    return run


# ---------------- surfels and meshes ----------------


def _table(rows: int = 7) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(SEED)
    return {name: rng.normal(size=(rows, channel.width(1))) for name, channel in ATTRIBUTES.items()}


def _surfel_files(folder: Path) -> list[bytes]:
    write_ply(folder / "a.ply", Surfels.from_numpy(_table()))
    binary = (folder / "a.ply").read_bytes()
    names = ["x", "y", "z", "opacity", "scale_0", "scale_1", "rot_0", "rot_1", "rot_2", "rot_3", "metallic"]
    rows = np.random.default_rng(SEED).normal(size=(3, len(names)))
    header = "element vertex 3\n" + "".join(f"property double {name}\n" for name in names) + "end_header\n"
    text = "\n".join(" ".join(map(str, row)) for row in rows.tolist())
    return [
        binary,
        f"ply\nformat ascii 1.0\ncomment c\n{header}{text}\n".encode(),
        f"ply\nformat binary_big_endian 1.0\n{header}".encode() + rows.astype(">f8").tobytes(),
    ]


CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float32)
QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
TRIANGLES = np.array([quad[:3] for quad in QUADS], dtype=np.uint32)


def _meshes(folder: Path) -> list[bytes]:
    solid = trimesh.creation.icosphere(1)
    vertices, faces = np.asarray(solid.vertices, np.float32), np.asarray(solid.faces, np.uint32)
    write_mesh(folder / "a.ply", Mesh(vertices, faces, 0.1))
    corners = "\n".join(" ".join(map(str, corner)) for corner in CUBE)
    quads = "\n".join("4 " + " ".join(map(str, quad)) for quad in QUADS)
    header = "element vertex 8\nproperty float x\nproperty float y\nproperty float z\n"
    header += "comment TextureFile ../secret.png\nelement face 6\n"
    header += "property list uchar int vertex_indices\nend_header"
    return [
        (folder / "a.ply").read_bytes(),
        solid.export(file_type="ply", encoding="ascii"),
        f"ply\nformat ascii 1.0\n{header}\n{corners}\n{quads}\n".encode(),
    ]


def _foreign_meshes(folder: Path) -> list[bytes]:
    solid = trimesh.Trimesh(CUBE, TRIANGLES, process=False)
    obj, stl = "mtllib ../../etc/passwd\n" + str(solid.export(file_type="obj")), solid.export(file_type="stl")
    assert isinstance(stl, bytes)
    return [
        b"obj" + obj.encode(),
        b"stl" + stl,
        b"stl" + str(solid.export(file_type="stl_ascii")).encode(),
        b"off" + str(solid.export(file_type="off")).encode(),
    ]


def _read_mesh(path: Path) -> list[Any]:
    """Rays through the mesh as well: Embree reads what a wrong index names."""
    mesh = read_mesh(path)
    points = np.random.default_rng(SEED).normal(size=(3, 64)).astype(np.float32)
    Occluder(mesh).visible(mi.Point3f(points), mi.Vector3f(-points)).numpy()
    return [mesh.vertices, mesh.voxel]


def _read_foreign_mesh(folder: Path, data: bytes) -> None:
    """The first three bytes of the sample say what it is, and stay as they are told."""
    ending = data[:3].decode("latin-1")
    ending = ending if ending in ("obj", "stl", "off") else "obj"
    _read_file(_read_mesh, f"a.{ending}")(folder, data[3:])


# ---------------- images ----------------


def _exr_files(folder: Path) -> list[bytes]:
    image = np.random.default_rng(SEED).random((5, 7, 4))
    files = []
    for kind in ("NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "DWAA"):
        header = {"compression": getattr(OpenEXR, f"{kind}_COMPRESSION"), "type": OpenEXR.scanlineimage}
        for dtype in (np.float16, np.float32):
            planes = {name: image[..., i].astype(dtype) for i, name in enumerate("RGBA")}
            OpenEXR.File(header, planes).write(str(folder / "a.exr"))
            files.append((folder / "a.exr").read_bytes())
    tiles = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
    OpenEXR.File(tiles, {"Y": image[..., 0].astype(np.float32)}).write(str(folder / "a.exr"))
    write_exr(folder / "b.exr", image[..., :3], names="XYZ")
    return [*files, (folder / "a.exr").read_bytes(), (folder / "b.exr").read_bytes()]


def _image_files(folder: Path) -> list[bytes]:
    rgba = np.random.default_rng(SEED).integers(0, 256, (9, 11, 4), dtype=np.uint8)
    image, files = Image.fromarray(rgba), []
    for mode in ("RGBA", "RGB", "L", "LA", "P", "1", "I;16"):
        deep = Image.fromarray(rgba[..., 0].astype(np.uint16))
        files.append(_saved(deep if mode == "I;16" else image.convert(mode), "PNG"))
    files.append(_saved(image.convert("P"), "PNG", transparency=3, interlace=1))
    for mode, progressive in (("RGB", False), ("RGB", True), ("L", False), ("CMYK", False)):
        files.append(_saved(image.convert(mode), "JPEG", progressive=progressive))
    return [*files, _saved(image, "GIF"), _saved(image, "TIFF")]


def _saved(image: Any, kind: str, **options: Any) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, format=kind, **options)
    return buffer.getvalue()


def _read_image(path: Path) -> list[Any]:
    pixels = read_png(path)
    assert not (pixels < 0).any() and not (pixels > 1).any()
    return [pixels]


def _light_files(folder: Path) -> list[bytes]:
    bitmap = mi.Bitmap(np.random.default_rng(SEED).random((8, 16, 3)).astype(np.float32))
    files = []
    for ending in ("hdr", "exr", "pfm"):
        bitmap.write(str(folder / f"a.{ending}"))
        files.append((folder / f"a.{ending}").read_bytes())
    return files + _image_files(folder)[:2]


# ---------------- data sets and runs ----------------


def _transforms(folder: Path) -> list[bytes]:
    rng, frames = np.random.default_rng(SEED), []
    for i in range(3):
        write_png(folder / f"r_{i}.png", rng.random((6, 8, 4)))
        write_exr(folder / f"d_{i}.exr", rng.random((6, 8, 1)))
        pose = np.eye(4)
        pose[2, 3] = i
        frames.append(
            {"file_path": f"./r_{i}", "transform_matrix": pose.tolist(), "depth_path": f"d_{i}.exr"}
        )
    camera = {"fl_x": 9.0, "fl_y": 9.5, "cx": 4.2, "cy": 3.1, "w": 8, "h": 6, "aabb_scale": 4}
    lens = {"k1": 0.03, "k2": -0.01, "p1": 1e-3, "p2": -1e-3, "camera_model": "OPENCV"}
    (folder / "points.ply").write_bytes(point_files(folder)[1])
    named = {"ply_file_path": "points.ply", "train_filenames": ["./r_1"], "test_filenames": ["./r_0"]}
    contents = [
        {**camera, **lens, "frames": frames},
        {**camera, "k1": 0.1, "k4": 0.01, "is_fisheye": True, "frames": frames},
        {"camera_angle_x": 0.7, "camera_angle_y": 0.6, "frames": [{**frames[0], "fl_x": 7}, *frames[1:]]},
        {**camera, **named, "frames": [{**frame, "mask_path": "r_1.png"} for frame in frames]},
    ]
    return [json.dumps(content).encode() for content in contents]


def _read_transforms(path: Path) -> list[Any]:
    views = [view.load() for view in read_dataset(path.parent, "train").views]
    cameras = [np.array([view.fx, view.fy, view.cx, view.cy]) for view in views]
    return [*cameras, *(x for v in views for x in (v.image, v.alpha, v.depth, v.to_world))]


def _methods(folder: Path) -> list[bytes]:
    shipped = [path.read_bytes() for path in sorted(resource_dir("variants").glob("*.toml"))]
    own = b'extends = "ref_gaussian"\ndrop = ["mesh"]\niterations = 100\n[loss]\nssim = 0.1\n'
    return [*shipped, methods.dump(methods.load("ref_gaussian")).encode(), own]


def _read_method(path: Path) -> None:
    method = methods.load(str(path), "quick", ["loss.ssim=0.3"])
    assert methods.dump(method)
    method.stage_at(1)


def _state() -> dict[str, np.ndarray]:
    """The arrays of a checkpoint, with arbitrary numbers."""
    state: dict[str, Any] = {f"params/{name}": np.float32(values) for name, values in _table().items()}
    state["params/light"] = np.float32(np.random.default_rng(SEED).random((8, 16, 3)))
    for name, values in list(state.items()):
        moments = f"optimiser/{name.removeprefix('params/')}"
        state |= {f"{moments}/first": np.zeros(values.size, np.float32), f"{moments}/steps": np.uint32(3)}
        state |= {f"{moments}/second": np.zeros(values.size, np.float32), f"{moments}/factor": np.float32(1)}
        state[f"{moments}/usual"] = 0.0
    state |= {"iteration": 3, "seconds": 1.5, "held_until": 0}
    state["error_sum"] = np.zeros(7, np.float32)
    state |= {"mesh/vertices": CUBE, "mesh/faces": TRIANGLES, "mesh/voxel": 0.1}
    return {name: np.asarray(value) for name, value in state.items()}


def _checkpoints(folder: Path) -> list[bytes]:
    buffer = io.BytesIO()
    np.savez(buffer, code=np.array([Code()], dtype=object), iteration=np.array(3))
    return [checkpoint.encode(_state()), buffer.getvalue() + b"sha256 " + b"0" * DIGITS]


def _sign(data: bytes) -> bytes:
    """With the right checksum, so that what is inside is read."""
    return data[:-DIGITS] + hashlib.sha256(data[:-DIGITS]).hexdigest().encode()


def _read_checkpoint(path: Path) -> None:
    (path.parent / "checkpoints").mkdir(exist_ok=True)
    path.replace(path.parent / "checkpoints" / "0000003.npz")
    state = Run(path.parent).load_checkpoint()
    assert state is not None
    TrainedScene.from_state(methods.load("ref_gaussian"), state)


def _models(folder: Path) -> list[bytes]:
    (folder / "surfels.ply").write_bytes(_surfel_files(folder)[0])
    write_mesh(folder / "mesh.ply", Mesh(CUBE, TRIANGLES, 0.1))
    shading = {"at": "pixel", "reflectance": "radiance", "diffuse": "sh", "occlusion": False}
    return [json.dumps({"iteration": 3, "seconds": 1.5, "surfels": 7, "shading": shading}).encode()]


def _read_model(path: Path) -> list[Any]:
    fitted = TrainedScene.read(path.parent)
    assert isinstance(fitted.iteration, int)
    return [fitted.seconds]


def _read_data_place(path: Path) -> None:
    """dataset.json of a run names a folder; only what lies there as a data set is read."""
    views_of_run(Run(path.parent), methods.load("ref_gaussian"), "train")


def _data_places(folder: Path) -> list[bytes]:
    (folder / "transforms_train.json").write_bytes(_transforms(folder)[2])
    return [json.dumps({"path": str(folder)}).encode()]


def _settings(folder: Path) -> list[bytes]:
    settings = {"scene": "a.xml", "scene_sha256": "0", "views": 3, "elevation": [-30.0, 80.0], "fov": 40.0}
    return [json.dumps(settings).encode()]


def _read_settings(path: Path) -> None:
    """dataset.json of a data set, before it is written anew."""
    (path.parent / "transforms_train.json").write_text("{}")
    settings = {"scene": "a.xml", "scene_sha256": "0", "views": 3, "elevation": [-30.0, 80.0], "fov": 40.0}
    prepare_folder(path.parent, settings, False)


def _logs(folder: Path) -> list[bytes]:
    lines = [json.dumps({"iteration": i, "loss": 0.5 / i, "psnr": None}) for i in range(1, 9)]
    return ["\n".join(lines).encode(), lines[0].encode()]


# ---------------- Mitsuba ----------------


def _scenes(folder: Path) -> list[bytes]:
    (folder / "s.ply").write_bytes(_surfel_files(folder)[0])
    write_mesh(folder / "m.ply", Mesh(CUBE, TRIANGLES, 0.1))
    strings = {"filename": "s.ply", "mesh": "m.ply", "shade_at": "pixel", "aovs": "n:normal,d:depth",
               "terms": "diffuse,specular", "reflectance": "split_sum", "diffuse": "sh"}  # fmt: skip
    inner = "".join(f'<string name="{name}" value="{value}"/>' for name, value in strings.items())
    inner += '<integer name="traced_bounces" value="1"/><boolean name="dominant" value="true"/>'
    inner += '<rgb name="background" value="1, 0.5, 0"/>'
    light = '<emitter type="constant"><rgb name="radiance" value="1"/></emitter>'
    plain = '<string name="filename" value="s.ply"/><boolean name="occlusion" value="false"/>'
    return [
        f'<scene version="3.0.0"><integrator type="refgs">{text}</integrator></scene>'.encode()
        for text in (inner, inner + light, plain)
    ]


def _read_scene(path: Path) -> None:
    """Mitsuba wraps what a plugin raises in a RuntimeError with the traceback's text."""
    try:
        mi.load_file(str(path))
    except RuntimeError as error:
        if "Traceback" in str(error) and "InputError: " not in str(error):
            raise
        message = str(error).rpartition("InputError: ")[2].strip()
        raise InputError(message if "Traceback" in str(error) else f"{path}: Mitsuba: {message}") from error
    except UnicodeDecodeError as error:  # Mitsuba's sentence quotes bytes of the file
        raise InputError(f"{path}: Mitsuba: no UTF-8") from error


def _file(name: str, kind: str, samples: Any, read: Callable[[Path], Any], file: str, **more: Any) -> Reader:
    return Reader(name, kind, samples, _read_file(read, file), **more)


def _read_log(path: Path) -> None:
    (path.parent / "config.toml").touch()  # the log is that of a run
    Run(path.parent).rewind(5)


READERS = {
    reader.name: reader
    for reader in (
        _file("ply", "", _surfel_files, lambda path: read_ply(path).to_numpy().values(), "x.ply"),
        _file("mesh", "", _meshes, _read_mesh, "x.ply"),
        Reader("mesh-other", "", _foreign_meshes, _read_foreign_mesh),
        _file("transforms", "json", _transforms, _read_transforms, "transforms_train.json"),
        Reader("colmap", "", colmap_files, read_colmap),
        _file("pickle", "", pickles, read_pickle, "0-camera.pkl"),
        _file("llff", "", pose_tables, lambda path: [read_poses(path)], "poses_bounds.npy"),
        _file("points", "", point_files, read_point_file, "x.ply"),
        _file("disparity", "", disparities, lambda path: [read_tiff(path)], "x.tiff"),
        # A method may extend one elsewhere: it is the user's own file.
        _file("method", "toml", _methods, _read_method, "x.toml", inside=False),
        _file("exr", "", _exr_files, lambda path: [read_exr_image(path)], "x.exr"),
        _file("image", "", _image_files, _read_image, "x.png"),
        _file(
            "light",
            "",
            _light_files,
            lambda path: [EnvironmentLight.from_file(path).radiance().numpy()],
            "x.hdr",
        ),
        _file("checkpoint", "", _checkpoints, _read_checkpoint, "x.npz", finish=_sign),
        _file("model", "json", _models, _read_model, "model.json"),
        _file("run-data", "json", _data_places, _read_data_place, "dataset.json", inside=False),
        _file("dataset", "json", _settings, _read_settings, "dataset.json"),
        _file("log", "json", _logs, _read_log, "metrics.jsonl"),
        # A scene may name files anywhere, as every scene of Mitsuba's.
        _file("scene", "xml", _scenes, _read_scene, "x.xml", inside=False),
    )
}
