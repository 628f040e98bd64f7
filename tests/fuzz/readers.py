"""The readers of the package, each with a folder of files that it accepts and a call that reads them."""

import json
from collections.abc import Callable, Iterable
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from shutil import copy, copytree
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np
import OpenEXR
import trimesh
from PIL import Image

from mi_refgs import methods
from mi_refgs.errors import InputError
from mi_refgs.formats.cameras import read_cameras
from mi_refgs.formats.splat_import import read_splats
from mi_refgs.io.exr import read_exr_image
from mi_refgs.io.files import resource_dir
from mi_refgs.io.images import read_mask, read_png, read_tiff
from mi_refgs.occlusion.mesh import Mesh, read_mesh, write_mesh
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.runs.views import views_of_run
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.light_file import read_radiance
from mi_refgs.surfels.ply import read_ply, write_ply
from mi_refgs.surfels.table import Surfels
from tests.helpers import read_loaded
from tests.scenes import layouts
from tests.scenes.splat_file import ball_columns
from tests.scenes.splats import random_raw
from tests.scenes.tiny import write_data

RGBA = np.random.default_rng(0).random((9, 11, 4))


class Reader(NamedTuple):
    """One way into the package."""

    make: Callable[[Path], object]  # writes files that are accepted into a folder
    mutated: str  # pattern of the files that are mutated
    read: Callable[[Path], Iterable[Any]]  # reads a file; returns the arrays that must be finite


def _data_set(path: Path) -> list[Any]:
    """The data set in whose folder a file is."""
    folder = next(p for p in path.parents if (p / "images").is_dir() or p.joinpath("0.png").is_file())
    data = read_loaded(folder, "train")
    cameras = [np.array([view.fx, view.fy, view.cx, view.cy]) for view in data.views]
    maps = [x for v in data.views for x in (v.image, v.alpha, v.depth, v.to_world) if x is not None]
    return [*cameras, *maps, *([] if data.points is None else [data.points.position])]


def _nerfstudio(folder: Path) -> None:
    (folder / "points.ply").write_bytes(layouts.point_bytes())
    lens: dict[str, Any] = {"k1": 0.03, "k2": -0.01, "p1": 1e-3, "p2": -1e-3}
    lens |= {"train_filenames": ["images/b.png"], "test_filenames": ["images/a.png"]}
    layouts.write_nerfstudio(folder, layouts.SHOTS[:3], ply_file_path="points.ply", **lens)


def _surfels(folder: Path) -> None:
    rng = np.random.default_rng(0)
    write_ply(folder / "a.ply", Surfels.from_numpy(random_raw(7, rng, 1)))
    columns = "x y z opacity scale_0 scale_1 rot_0 rot_1 rot_2 rot_3 metallic".split()
    for kind in ("ascii", "binary_big_endian"):
        content = layouts.ply_bytes({name: rng.normal(size=3) for name in columns}, kind)
        (folder / f"{kind}.ply").write_bytes(content)


def _meshes(folder: Path) -> None:
    ball = trimesh.creation.icosphere(1)
    mesh = Mesh(np.asarray(ball.vertices, np.float32), np.asarray(ball.faces, np.uint32), 0.1)
    write_mesh(folder / "a.ply", mesh)
    (folder / "b.ply").write_bytes(ball.export(file_type="ply", encoding="ascii"))
    for ending in ("obj", "stl", "off"):
        ball.export(folder / f"a.{ending}")


def _read_mesh(path: Path) -> list[Any]:
    """Rays as well: Embree reads what a wrong index names."""
    mesh = read_mesh(path)
    points = np.random.default_rng(0).normal(size=(3, 64)).astype(np.float32)
    Occluder(mesh).visible(mi.Point3f(points), mi.Vector3f(-points)).numpy()
    return [mesh.vertices, mesh.voxel]


def _images(folder: Path) -> None:
    for name in ("sky", "studio"):
        copy(resource_dir("scenes") / f"lights/{name}.exr", folder)
    for kind in ("NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB"):
        header = {"compression": getattr(OpenEXR, f"{kind}_COMPRESSION"), "type": OpenEXR.scanlineimage}
        planes = {name: RGBA[..., i].astype(np.float16) for i, name in enumerate("RGBA")}
        OpenEXR.File(header, planes).write(str(folder / f"{kind}.exr"))
    tiles = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
    OpenEXR.File(tiles, {"Y": RGBA[..., 0].astype(np.float32)}).write(str(folder / "tiled.exr"))
    planes = {f"a.Combined.{name}": np.ones((24, 4), np.float16) for name in "RGB"}
    header = {"type": OpenEXR.scanlineimage, "envmap": OpenEXR.ENVMAP_CUBE}
    OpenEXR.File(header | {"displayWindow": ((0, 0), (3, 23))}, planes).write(str(folder / "cube.exr"))
    parts = [OpenEXR.Part({"name": name, "type": OpenEXR.scanlineimage}, planes) for name in "ab"]
    OpenEXR.File(parts).write(str(folder / "parts.exr"))
    mi.Bitmap(np.ones((8, 16, 3), np.float32)).write(str(folder / "a.hdr"))
    head, pixels = "#?RADIANCE\nEXPOSURE=2\nFORMAT=32-bit_rle_xyze\n\n", bytes((128, 64, 32, 129))
    (folder / "b.hdr").write_bytes(f"{head}+X 8 -Y 16\n".encode() + pixels * 128)
    (folder / "c.hdr").write_bytes(f"{head}-Y 8 +X 16\n".encode() + (pixels + bytes((1, 1, 1, 15))) * 8)
    image = Image.fromarray((255 * RGBA).astype(np.uint8))
    for mode in ("RGBA", "RGB", "L", "LA", "P", "1"):
        image.convert(mode).save(folder / f"{mode}.png")
    image.convert("P").save(folder / "b.png", transparency=3)
    for mode in ("RGB", "L", "CMYK"):
        image.convert(mode).save(folder / f"{mode}.jpg", progressive=mode == "L")
    for kind in ("raw", "tiff_lzw", "tiff_adobe_deflate"):
        Image.fromarray(np.ones((6, 8), np.float32)).save(folder / f"{kind}.tiff", compression=kind)


def _read_image(path: Path) -> list[Any]:
    return [{".exr": read_exr_image, ".tiff": read_tiff}.get(path.suffix, read_png)(path)]


def _splats(folder: Path) -> None:
    columns = {name: column[:9] for name, column in ball_columns().items()}
    for kind in ("ascii", "binary_little_endian", "binary_big_endian"):
        (folder / f"{kind}.ply").write_bytes(layouts.ply_bytes(columns | {"filter_3D": columns["x"]}, kind))
    (folder / "ours.ply").write_bytes(layouts.ply_bytes(columns))
    if find_spec("gaussforge"):
        made = import_module("gaussforge").GaussForge()
        for kind in ("spz", "splat", "ksplat", "sog"):
            data = made.convert((folder / "ours.ply").read_bytes(), "ply", kind)["data"]
            (folder / f"a.{kind}").write_bytes(data)


def _cameras(folder: Path) -> None:
    layouts.write_nerfstudio(folder, layouts.SHOTS[:3])
    one: dict[str, Any] = {"width": 64, "height": 48, "fx": 70, "fy": 70}
    one |= {"position": [0, 0, 4], "rotation": np.eye(3).tolist()}
    (folder / "a.json").write_text(json.dumps([one, one]))


def _read_method(path: Path) -> list[Any]:
    method = methods.load(str(path), "quick", ["loss.ssim=0.3"])
    assert methods.dump(method)
    method.stage_at(1)
    return []


def _run(folder: Path) -> None:
    _surfels(folder)
    (folder / "a.ply").rename(folder / "surfels.ply")
    shading = {"at": "pixel", "reflectance": "radiance", "diffuse": "sh", "occlusion": False}
    content = {"iteration": 3, "seconds": 1.5, "surfels": 7, "shading": shading}
    (folder / "model.json").write_text(json.dumps(content))
    (folder / "dataset.json").write_text(json.dumps({"path": str(write_data(folder / "data"))}))


def _read_run(path: Path) -> list[Any]:
    assert views_of_run(Run(path.parent), methods.load("ref_gaussian"), "train").views
    return []


def _scenes(folder: Path) -> None:
    _surfels(folder)
    inner = '<string name="filename" value="a.ply"/><string name="aovs" value="n:normal,d:depth"/>'
    inner += '<boolean name="dominant" value="true"/><rgb name="background" value="1, 0.5, 0"/>'
    scene = f'<scene version="3.0.0"><integrator type="refgs">{inner}</integrator></scene>'
    (folder / "a.xml").write_text(scene)


def _read_scene(path: Path) -> list[Any]:
    """Mitsuba wraps what a plugin raises in a RuntimeError with the traceback's text."""
    try:
        mi.load_file(str(path))
    except (RuntimeError, UnicodeDecodeError) as error:  # Mitsuba's sentence quotes bytes of the file
        if "Traceback" in str(error) and "InputError: " not in str(error):
            raise
        raise InputError(str(error), path) from error
    return []


def _colmap(kind: str) -> Callable[[Path], object]:
    values = (*layouts.VALUES, 0.03, -0.01, 1e-3, -1e-3)
    return partial(layouts.write_colmap, kind=kind, shots=layouts.SHOTS[:3], camera="OPENCV", values=values)


READERS = {
    "ply": Reader(_surfels, "*.ply", lambda path: read_ply(path).to_numpy().values()),
    "mesh": Reader(_meshes, "*.*", _read_mesh),
    "transforms": Reader(_nerfstudio, "transforms.json", _data_set),
    "points": Reader(_nerfstudio, "points.ply", _data_set),
    "colmap-binary": Reader(_colmap("bin"), "sparse/0/*", _data_set),
    "colmap-text": Reader(_colmap("txt"), "sparse/0/*", _data_set),
    "glossy": Reader(layouts.write_glossy, "1-camera.pkl", _data_set),
    "llff": Reader(layouts.write_llff, "*.npy", _data_set),
    "splats": Reader(_splats, "*.*", lambda path: read_splats(path).surfels.to_numpy().values()),
    "cameras": Reader(_cameras, "*.json", lambda path: [camera.pose() for camera in read_cameras(path)]),
    "exr": Reader(_images, "*.exr", _read_image),
    "image": Reader(_images, "*.[pj]*", _read_image),
    "mask": Reader(_images, "*.[pj]*", lambda path: [read_mask(path)]),
    "disparity": Reader(_images, "*.tiff", _read_image),
    "light": Reader(_images, "*.[eh]*", lambda path: [read_radiance(path)]),
    "hdr": Reader(_images, "*.hdr", lambda path: [EnvironmentLight.from_file(path).radiance().numpy()]),
    "method": Reader(partial(copytree, resource_dir("variants"), dirs_exist_ok=True), "*.toml", _read_method),
    "model": Reader(_run, "model.json", lambda path: [TrainedScene.read(path.parent).seconds]),
    "run-data": Reader(_run, "dataset.json", _read_run),
    "scene": Reader(_scenes, "*.xml", _read_scene),
}
