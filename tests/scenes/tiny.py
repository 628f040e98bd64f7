"""A data set of a ball made by NumPy alone, and a method small enough to fit to it in seconds."""

import json
from pathlib import Path

import numpy as np

from mi_refgs.data.poses import MITSUBA_FROM_OPENGL
from mi_refgs.data.region import REGION_FILE, Region
from mi_refgs.io.exr import write_exr
from mi_refgs.io.images import read_png, write_png
from mi_refgs.methods.read import PRESETS
from mi_refgs.reference.camera import look_at

SIZE = 20
FOCAL = 24.0  # pixels
RADIUS, DISTANCE = 0.5, 1.5
REGION = Region((0.0, 0.0, 0.0), 0.7)
"""Region of interest that `write_open_data` writes."""

METHOD = f"""
iterations = {PRESETS["quick"].iterations}
checkpoint_every = 3
[surfels]
attributes = ["radiance_sh", "albedo", "metallic", "roughness", "indirect_sh"]
degree = {{ radiance_sh = 1 }}
[light]
height = 8
[stage.initial]
until = 3
at = "surfel"
diffuse = "irradiance"
[stage.deferred]
until = {PRESETS["quick"].iterations}
at = "pixel"
[event.mesh]
when = {{ start = 3, until = 6, every = 1 }}
resolution = 16
"""
"""Written for the preset `quick`, so that nothing is scaled."""
SETTINGS = ["iterations=6", "surfels.count=80", "surfels.max_count=100", "preview_every=4", "log_every=2"]


def write_method(folder: Path, text: str = METHOD) -> Path:
    path = folder / "tiny.toml"
    path.write_text(text)
    return path


def train_command(data: Path, run: Path, method: Path, *more: str) -> list[str]:
    options = ["--method", str(method), "--preset", "quick", *more]
    return ["train", str(data), "-o", str(run), *options, "--set", *SETTINGS]


def write_data(folder: Path, views: int = 3, truth: bool = True) -> Path:
    """Training and two test views of a ball coloured by its normals; `truth`: with normals and a light."""
    for split, count in (("train", views), ("test", 2)):
        (folder / split).mkdir(parents=True)
        frames = []
        for i in range(count):
            angle = 2 * np.pi * (i + 0.5 * (split == "test")) / max(count, 1)
            origin = DISTANCE * np.array([np.cos(angle), np.sin(angle), 0.5]) / np.sqrt(1.25)
            pose = look_at(origin, np.zeros(3)) @ MITSUBA_FROM_OPENGL
            alpha, normal = _ball(pose)
            image = np.concatenate([0.5 + 0.4 * normal, alpha[..., None]], axis=-1)
            write_png(folder / split / f"r_{i}.png", image)
            frame = {"file_path": f"./{split}/r_{i}", "transform_matrix": pose.tolist()}
            if truth:
                write_exr(folder / split / f"r_{i}_normal.exr", normal, names="XYZ")
                frame["normal_path"] = f"./{split}/r_{i}_normal.exr"
            frames.append(frame)
        content = {"fl_x": FOCAL, "fl_y": FOCAL, "w": SIZE, "h": SIZE, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(content))
    if truth:
        write_exr(folder / "environment.exr", np.linspace(0.1, 2, 8 * 16 * 3).reshape(8, 16, 3))
    return folder


def write_open_data(folder: Path) -> Path:
    """Eight views of the ball in front of a coloured sky, without alpha, with a region of interest."""
    write_data(folder, views=8, truth=False)
    for split in ("train", "test"):
        for frame in json.loads((folder / f"transforms_{split}.json").read_text())["frames"]:
            path = folder / f"{frame['file_path']}.png"
            rgba, sky = read_png(path), 0.5 + 0.3 * _rays(np.array(frame["transform_matrix"]))
            write_png(path, rgba[..., 3:] * rgba[..., :3] + (1 - rgba[..., 3:]) * sky)
    (folder / REGION_FILE).write_text(json.dumps({"centre": REGION.centre, "radius": REGION.radius}))
    return folder


def _rays(pose: np.ndarray) -> np.ndarray:
    """Directions (H, W, 3) through the pixel centres; `pose` has OpenGL axes."""
    offset = (np.arange(SIZE) + 0.5 - SIZE / 2) / FOCAL
    x, y = np.meshgrid(offset, -offset)
    ray = np.stack([x, y, -np.ones_like(x)], axis=-1) @ pose[:3, :3].T
    return np.asarray(ray / np.linalg.norm(ray, axis=-1, keepdims=True))


def _ball(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Alpha (H, W) and normals (H, W, 3) of the ball at the pixel centres; `pose` has OpenGL axes."""
    ray, origin = _rays(pose), pose[:3, 3]
    along = ray @ origin
    discriminant = along**2 - origin @ origin + RADIUS**2
    hit = discriminant > 0
    distance = -along - np.sqrt(np.maximum(discriminant, 0))
    return hit.astype(np.float64), np.where(hit[..., None], (origin + distance[..., None] * ray) / RADIUS, 0)
