"""Path-traces a multi-view data set of a Mitsuba scene: pictures, normals, depth, environment, camera files.

A data set folder holds

    transforms_train.json, transforms_test.json   cameras in the Blender / NeRF convention, written last
    train/r_000.png    RGBA, 8 bit: straight alpha, colour = sRGB(radiance / alpha), clipped
    train/r_000.exr    RGBA, float32, linear: premultiplied radiance and alpha
    train/r_000_normal.exr   X, Y, Z: unit shading normal at the pixel centre, world space, towards the camera
    train/r_000_depth.exr    Y: distance at the pixel centre, along the viewing axis (not along the ray)
    environment.exr    lat-long radiance of the environment, as a Mitsuba `envmap` without `to_world` shows it
    dataset.json       the settings; they decide whether a folder may be resumed

Normals and depth are 0 off the object.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import sys
import xml.etree.ElementTree as ElementTree
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.files import read_json, write_bytes
from mi_refgs.data.frames import MITSUBA_FROM_OPENGL
from mi_refgs.data.pathtrace import Tracer, bounding_sphere, camera_poses, environment_image
from mi_refgs.exr import mitsuba_exr, read_exr, write_exr
from mi_refgs.images import read_png, srgb_from_linear, write_png

VIEW_FILES = (
    "transforms_*.json",
    "environment.exr",
    *(f"{split}/*.{ending}" for split in ("train", "test") for ending in ("png", "exr")),
)
"""What a data set consists of beside its settings, and what overwriting it removes."""


@dataclass(frozen=True)
class Settings:
    """What decides every pixel of a data set."""

    scene: str  # file name, without its folder
    scene_sha256: str  # of the XML and the files that it names
    views: int
    test_views: int
    size: int  # pixels, square
    spp: int
    seed: int
    max_depth: int
    elevation: tuple[float, float]  # degrees above the horizon, z up
    fov: float  # degrees
    fill: float  # radius of the bounding sphere / (distance · sin(fov / 2)); at 1 it touches the edge
    environment_height: int  # rows; 0 writes no environment


def make_dataset(
    scene: str | Path,
    out: str | Path,
    *,
    views: int = 80,
    size: int = 160,
    spp: int = 128,
    seed: int = 0,
    test_views: int | None = None,
    max_depth: int = 6,
    elevation: tuple[float, float] = (-30.0, 80.0),
    fov: float = 40.0,
    fill: float = 0.95,
    environment_height: int = 256,
    overwrite: bool = False,
    progress: bool = True,
) -> Path:
    """Path-trace a data set of a Mitsuba scene into the folder `out`, which is returned.

    Cameras sit on a sphere around the scene's bounding sphere and look at its centre, z up; training and test
    views are two lattices, evenly spread over the band of elevations, turned and jittered by the seed.
    `test_views` is a quarter of `views` by default. The pixel filter is a box, the light is hidden from the
    camera (alpha 0). A folder that the same settings left unfinished is continued; every file appears whole
    or not at all. `overwrite` removes the views that a folder holds. Needs a Dr.Jit variant to be set.

    Raises InputError if the scene cannot be loaded, a setting makes no sense, the folder cannot be written,
    or it holds a data set of other settings or from elsewhere and `overwrite` is false.
    """
    scene, out = Path(scene), Path(out)
    settings = Settings(
        scene=scene.name,
        scene_sha256=_scene_hash(scene),
        views=views,
        test_views=max(1, views // 4) if test_views is None else test_views,
        size=size,
        spp=spp,
        seed=seed,
        max_depth=max_depth,
        elevation=(float(elevation[0]), float(elevation[1])),
        fov=float(fov),
        fill=float(fill),
        environment_height=environment_height,
    )
    _check(settings)
    loaded = _load_scene(scene)
    _prepare_folder(out, settings, overwrite)
    centre, radius = bounding_sphere(loaded)
    distance = radius / (settings.fill * math.sin(math.radians(settings.fov) / 2))
    tracer = Tracer(
        loaded,
        size=size,
        fov=settings.fov,
        spp=spp,
        max_depth=max_depth,
        near=0.1 * (distance - radius),
        far=10 * (distance + radius),
    )
    light = out / "environment.exr"
    if environment_height and loaded.environment() is not None and not light.exists():
        write_exr(light, environment_image(loaded, environment_height))

    frames: dict[str, list[dict[str, Any]]] = {}
    jobs: list[tuple[str, np.ndarray, int]] = []
    for index, (split, count) in enumerate((("train", settings.views), ("test", settings.test_views))):
        # Independent streams: one per split for the cameras, one per view for its paths.
        rng = np.random.default_rng([seed, index])
        poses = camera_poses(count, centre, distance, settings.elevation, rng)
        frames[split] = [_frame(split, i, pose) for i, pose in enumerate(poses)]
        jobs += [
            (f"{split}/r_{i:03d}", pose, int(np.random.SeedSequence([seed, index, i]).generate_state(1)[0]))
            for i, pose in enumerate(poses)
        ]
    _trace_views(tracer, out, jobs, progress)
    for split, split_frames in frames.items():
        _write_json(out / f"transforms_{split}.json", _transforms(settings, split_frames))
    return out


def _trace_views(tracer: Tracer, out: Path, jobs: list[tuple[str, np.ndarray, int]], progress: bool) -> None:
    from tqdm import tqdm

    bar = tqdm(jobs, desc=f"dataset {out.name}", unit="view", file=sys.stderr, disable=not progress)
    for name, pose, seed in bar:
        stem = out / name
        if _complete(stem):
            continue
        rgba, normal, depth = tracer.trace(pose, seed)
        alpha = rgba[..., 3:]
        colour = srgb_from_linear(rgba[..., :3] / np.maximum(alpha, 1e-8))
        write_exr(f"{stem}.exr", rgba)
        write_exr(f"{stem}_normal.exr", normal, names="XYZ")
        write_exr(f"{stem}_depth.exr", depth)
        write_png(f"{stem}.png", np.concatenate([colour, alpha], axis=-1))


def _complete(stem: Path) -> bool:
    """Whether all files of a view exist and can be read; a broken one is traced again."""
    try:
        read_png(f"{stem}.png")
        for suffix in ("", "_normal", "_depth"):
            read_exr(f"{stem}{suffix}.exr")
    except InputError:
        return False
    return True


def _frame(split: str, index: int, pose: np.ndarray) -> dict[str, Any]:
    stem = f"./{split}/r_{index:03d}"
    return {
        "file_path": stem,
        "exr_path": f"{stem}.exr",
        "normal_path": f"{stem}_normal.exr",
        "depth_path": f"{stem}_depth.exr",
        "transform_matrix": (pose @ MITSUBA_FROM_OPENGL).tolist(),
    }


def _transforms(settings: Settings, frames: list[dict[str, Any]]) -> dict[str, Any]:
    angle = math.radians(settings.fov)
    focal = 0.5 * settings.size / math.tan(angle / 2)
    return {
        "camera_angle_x": angle,
        "w": settings.size,
        "h": settings.size,
        "fl_x": focal,
        "fl_y": focal,
        "cx": settings.size / 2,
        "cy": settings.size / 2,
        "frames": frames,
    }


def _write_json(path: Path, value: Any) -> None:
    write_bytes(path, f"{json.dumps(value, indent=1)}\n".encode())


def _scene_hash(scene: Path) -> str:
    if not scene.is_file():
        raise InputError(f"{scene}: scene: missing; give the path of a Mitsuba XML file")
    try:
        root = ElementTree.fromstring(scene.read_bytes())
    except ElementTree.ParseError as error:
        raise InputError(f"{scene}: scene: not XML ({error}); give a Mitsuba scene") from error
    digest = hashlib.sha256(scene.read_bytes())
    names = [e.get("value") for e in root.iter("string") if e.get("name") == "filename"]
    for name in [*names, *(e.get("filename") for e in root.iter("include"))]:
        file = scene.parent / (name or "")
        if file.is_file():
            digest.update(file.read_bytes())
    return digest.hexdigest()


def _load_scene(scene: Path) -> Any:
    import mitsuba as mi

    try:
        with mitsuba_exr():
            loaded = mi.load_file(str(scene))
    except (RuntimeError, UnicodeError) as error:  # Mitsuba quotes bytes of the file
        raise InputError(f"{scene}: scene: Mitsuba cannot load it: {error}; mend the scene") from error
    if not loaded.shapes():
        raise InputError(f"{scene}: shapes: the scene has none; add an object to look at")
    if not loaded.emitters():
        raise InputError(f"{scene}: emitters: the scene has none; add an environment emitter")
    return loaded


def _check(settings: Settings) -> None:
    def need(good: bool, field: str, remedy: str) -> None:
        if not good:
            value = getattr(settings, field)
            raise InputError(f"{settings.scene}: {field}: {value} is out of range; {remedy}")

    for field in ("views", "test_views", "size", "spp", "max_depth"):
        need(getattr(settings, field) >= 1, field, "give a number of at least 1")
    low, high = settings.elevation
    need(-90 < low < high < 90, "elevation", "give two angles in degrees, -90 < low < high < 90")
    need(0 < settings.fov < 170, "fov", "give degrees between 0 and 170")
    need(0 < settings.fill <= 1, "fill", "give a fraction between 0 and 1")
    need(settings.seed >= 0, "seed", "give a number of at least 0")


def _prepare_folder(out: Path, settings: Settings, overwrite: bool) -> None:
    """Make the folders and record the settings; stop at a folder that holds anything else, or empty it."""
    record = out / "dataset.json"
    wanted = json.loads(json.dumps(asdict(settings)))
    found: Any = None
    if record.is_file():
        with contextlib.suppress(InputError):
            found = read_json(record)
    stale = [f for pattern in VIEW_FILES for f in sorted(out.glob(pattern))] if found != wanted else []
    if stale and not overwrite:
        changed = [k for k in wanted if k not in found or found[k] != wanted[k]] if found else []
        raise InputError(
            f"{record if found else out}: {', '.join(changed) or 'output'}: the folder holds another "
            "data set; give another folder, the same settings, or --overwrite"
        )
    try:
        for split in ("train", "test"):
            (out / split).mkdir(parents=True, exist_ok=True)
        for file in stale:
            file.unlink()
    except OSError as error:
        raise InputError(f"{out}: output: cannot be written ({error}); choose a writable folder") from error
    _write_json(record, wanted)
