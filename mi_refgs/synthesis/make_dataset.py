"""Path tracing of a multi-view data set of a Mitsuba scene: images, maps, environment, surface and cameras.

A data set folder contains

    transforms_train.json, transforms_test.json   cameras in the Blender / NeRF convention, written after
                                                  the views
    train/r_000.png    RGBA, 8 bit: straight alpha, colour = sRGB(radiance / alpha), clipped
    train/r_000.exr    RGBA, float32, linear: premultiplied radiance and alpha
    train/r_000_normal.exr     X, Y, Z: unit shading normal at the pixel centre, world space, towards the
                               camera
    train/r_000_depth.exr      Y: distance at the pixel centre, along the viewing axis (not along the ray)
    train/r_000_albedo.exr     R, G, B: diffuse reflectance, or F0 of a metal, at the pixel centre
                               (see `synthesis.ground_truth`)
    train/r_000_roughness.exr  Y: √α of GGX; like albedo and metallic with A = 1 where the BSDF defines it,
                               else 0
    train/r_000_metallic.exr   Y: 0 … 1
    environment.exr    lat-long radiance of the environment for a Mitsuba `envmap` without `to_world`
    surface.ply        triangles of all shapes, world space
    region.json        only for an open scene: a sphere around the object
    relight/NAME/      the test views under another environment map, a data set with a test split:
                       test/r_000.png and .exr, environment.exr, transforms_test.json
    dataset.json       the settings, which decide whether a folder may be resumed; and other environment maps

Maps are 0 off the object. An open scene is an object in its surroundings: images are RGB without alpha, maps,
materials and surface are those of the object only, and there is no environment.exr, because not only distant
light arrives at the object.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.data.poses import MITSUBA_FROM_OPENGL, pinhole
from mi_refgs.data.region import REGION_FILE, Region, write_region
from mi_refgs.errors import InputError
from mi_refgs.io.exr import read_exr, read_exr_image, write_exr
from mi_refgs.io.files import write_json
from mi_refgs.io.images import read_png, srgb_from_linear, straight_srgb, write_png
from mi_refgs.io.ownership import OutputFolder
from mi_refgs.occlusion.mesh import Mesh, write_mesh
from mi_refgs.progress import with_bar
from mi_refgs.synthesis.ground_truth import surface_mesh
from mi_refgs.synthesis.pathtrace import MAPS, Cameras, Tracer, bounding_sphere, environment_image, reach
from mi_refgs.synthesis.settings import (
    RELIGHT,
    SURFACE,
    LightFile,
    Settings,
    load_scene,
    prepare_folder,
    scene_hash,
    under_light,
)
from mi_refgs.synthesis.write_colmap import colmap_output, write_colmap

SURFACE_VOXELS = 2048
"""Voxels along the diameter of `surface.ply`, which decide how far from it rays start: 2 voxels are 0.1 % of
the size, ten times the error of a tessellated sphere."""
REGION_MARGIN = 1.2
"""Radius of the region over that of the object's bounding sphere, which includes adjacent surfaces."""


def make_dataset(
    scene: str | Path,
    out: str | Path,
    *,
    views: int = 80,
    size: int | tuple[int, int] = 160,
    spp: int = 128,
    seed: int = 0,
    test_views: int | None = None,
    max_depth: int = 6,
    elevation: tuple[float, float] = (-30.0, 80.0),
    fov: float = 40.0,
    fill: float = 0.95,
    environment_height: int = 256,
    light: str | Path | None = None,
    relight: Sequence[str | Path] = (),
    objects: Sequence[str] = (),
    distance: tuple[float, float] | None = None,
    colmap: str | Path | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> Path:
    """Path-trace a data set of a Mitsuba scene into the folder `out`, which is returned.

    Cameras are on a sphere around the scene's bounding sphere and look at its centre, z up; training and test
    views are two lattices, evenly spread over the band of `elevation`, rotated and jittered by the seed. The
    pixel filter is a box, and emitters are hidden from the camera (alpha 0).

    `test_views`: by default a quarter of `views`.
    `size`: width and height in pixels, or one number for both; `fov`: degrees, of the shorter side.
    `fill`: fraction of the shorter side that the bounding sphere fills, which sets the cameras' distance.
    `distance`: instead of `fill`, two distances between which those of cameras are random, scene units.
    `light`: lat-long map (EXR, HDR) that replaces the scene's environment, rotated as that is.
    `relight`: maps under which the test views are traced again, each in a folder of its name without suffix.
    `objects`: ids of shapes that cameras look at among all others: an open scene.
    `colmap`: folder for the same data set as COLMAP's text files (`write_colmap`).
    `overwrite`: remove the views in the folder.

    A folder that the same settings left unfinished is continued. Files are written atomically. A Dr.Jit
    variant must be set.

    Raises InputError if the scene or a light cannot be loaded, a shape cannot be tessellated, a setting is
    out of range, a camera does not see the object, the folder cannot be written, or it contains a data set of
    other settings or foreign files and `overwrite` is false.
    """
    # Settings.
    scene, out = Path(scene), Path(out)
    width, height = (size, 0) if isinstance(size, int) else size
    main = None if light is None else LightFile.of(Path(light))
    others = [LightFile.of(Path(path)) for path in relight]
    settings = Settings(
        scene=scene.name,
        scene_sha256=scene_hash(scene),
        views=views,
        test_views=max(1, views // 4) if test_views is None else test_views,
        size=width,
        height=0 if height == width else height,
        spp=spp,
        seed=seed,
        max_depth=max_depth,
        elevation=(float(elevation[0]), float(elevation[1])),
        fov=float(fov),
        fill=float(fill),
        environment_height=environment_height,
        light="" if main is None else main.path.name,
        light_sha256="" if main is None else main.sha256,
        objects=tuple(objects),
        distance=(0.0, 0.0) if distance is None else (float(distance[0]), float(distance[1])),
    )
    settings.require_valid()
    if objects and others:
        raise InputError(f"{scene}: --relight: an open scene keeps its emitters; leave it out, or --shapes")

    # The scene under each light, and its surface; all input is read before anything is written.
    loaded = load_scene(scene, whole=bool(objects))
    about = named_shapes(loaded, objects, scene) if objects else []
    shapes = about or loaded.shapes()
    lit = loaded if main is None else under_light(loaded, main.path)
    try:
        vertices, faces = surface_mesh(shapes)
    except InputError as error:
        raise InputError(f"{scene}: {error}") from error
    relit = [under_light(loaded, other.path) for other in others]

    # Cameras.
    centre, radius = bounding_sphere(shapes)
    cameras = Cameras(settings, centre, radius, reach(loaded.shapes(), centre) if about else radius, about)
    x, y, z = (float(c) for c in centre)
    region = Region((x, y, z), REGION_MARGIN * radius)
    if about:
        poses = np.stack([pose for split in ("train", "test") for pose, _ in cameras.of(split)])
        require_clear_view(loaded, about, region, poses, scene)

    # Output.
    points = None if colmap is None else colmap_output(Path(colmap), out, cameras)
    output = prepare_folder(out, settings, overwrite, others)
    if about:
        output.claim(REGION_FILE)
        write_region(out, region)
    output.claim(SURFACE)
    if not (out / SURFACE).exists():
        voxel = 2 * radius / SURFACE_VOXELS
        write_mesh(out / SURFACE, Mesh(vertices.astype(np.float32), faces.astype(np.uint32), voxel))
    tracer = cameras.tracer(lit)
    write_views(output, "", ("train", "test"), cameras, tracer, True, progress)
    if points is not None:
        write_colmap(points, out, cameras, tracer)
    for other, scene_there in zip(others, relit, strict=True):
        part = f"{RELIGHT}/{other.name}/"
        write_views(output, part, ("test",), cameras, cameras.tracer(scene_there), False, progress)
    return out


def named_shapes(scene: Any, ids: Sequence[str], file: Path) -> list[Any]:
    """The shapes of a scene with these ids; raises InputError for an id that none has."""
    found = {shape.id(): shape for shape in scene.shapes()}
    missing = [name for name in ids if not name or name not in found]
    if missing:
        known = ", ".join(sorted(name for name in found if name)) or "none"
        raise InputError(
            f"{file}: --shapes: no shape has the id '{missing[0]}'; give one of those there: {known}"
        )
    return [found[name] for name in dict.fromkeys(ids)]


def require_clear_view(
    scene: Any, objects: Sequence[Any], region: Region, poses: np.ndarray, file: Path
) -> None:
    """Raise InputError if a camera (poses (N, 4, 4)) is in the region, or something hides its centre."""
    import drjit as dr
    import mitsuba as mi

    origin = np.asarray(poses)[:, :3, 3]
    toward = np.array(region.centre) - origin
    distance = np.linalg.norm(toward, axis=1)
    if distance.min() <= region.radius:
        raise InputError(
            f"{file}: --distance: {distance.min():.4g} is inside of the region around the object, whose "
            f"radius is {region.radius:.4g}; give more"
        )
    with dr.suspend_grad():
        start, along = (np.ascontiguousarray(a.T, np.float32) for a in (origin, toward / distance[:, None]))
        hit = scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(start), mi.Vector3f(along)))
        own = mi.Bool(False)
        for shape in objects:
            own |= hit.shape == mi.ShapePtr(shape)
        hidden = np.array(hit.is_valid() & ~own) & (np.array(hit.t) < distance - region.radius)
    if hidden.any():
        raise InputError(
            f"{file}: --distance: something is between {int(hidden.sum())} of {len(poses)} cameras and "
            f"the object, at {distance[hidden].min():.4g} … {distance[hidden].max():.4g}; give a shorter "
            "distance, or another --elevation"
        )


def write_views(
    output: OutputFolder,
    part: str,
    splits: Sequence[str],
    cameras: Cameras,
    tracer: Tracer,
    maps: bool,
    progress: bool,
) -> None:
    """Write the environment map, the views, and then the transforms of some splits; `maps`: also the maps.

    `part` is the folder of the files, "" or "relight/NAME/".
    """
    out = output.path / part
    endings = (".png", ".exr", *(f"_{name}.exr" for name in MAPS if maps))
    views = [f"{split}/r_{i:03d}" for split in splits for i, _ in enumerate(cameras.of(split))]
    files = ["environment.exr", *(f"transforms_{split}.json" for split in splits)]
    output.claim(*(f"{part}{file}" for file in (*files, *(view + end for view in views for end in endings))))
    light, height = out / "environment.exr", cameras.settings.environment_height
    known = tracer.scene.environment() is not None and not cameras.objects  # see the head of this file
    if height and known and not light.exists():
        write_exr(light, environment_image(tracer.scene, height))
    jobs = [(f"{split}/r_{i:03d}", *job) for split in splits for i, job in enumerate(cameras.of(split))]
    for name, pose, seed in with_bar(jobs, f"dataset {out.name}", unit="view", disable=not progress):
        _trace_view(tracer, out / name, pose, seed, maps)
    for split in splits:
        frames = [_frame(split, i, pose, maps) for i, (pose, _) in enumerate(cameras.of(split))]
        intrinsics = pinhole(*cameras.settings.resolution, cameras.settings.focal)
        write_json(out / f"transforms_{split}.json", {**intrinsics, "frames": frames})


def _trace_view(tracer: Tracer, stem: Path, pose: np.ndarray, seed: int, maps: bool) -> None:
    """Trace the missing and broken files of a view."""
    if _whole(read_png, f"{stem}.png") and _whole(read_exr, f"{stem}.exr"):
        rgba = None
    else:
        rgba = tracer.image(pose, seed)
        write_exr(f"{stem}.exr", rgba)
        write_png(f"{stem}.png", straight_srgb(rgba) if rgba.shape[-1] == 4 else srgb_from_linear(rgba))
    files = {name: f"{stem}_{name}.exr" for name in MAPS} if maps else {}
    missing = [name for name, file in files.items() if not _whole(read_exr, file)]
    if missing:
        image = read_exr_image(f"{stem}.exr") if rgba is None else rgba
        found = tracer.maps(pose, image[..., -1] > 0 if image.shape[-1] == 4 else np.array(True))
        for name in missing:
            write_exr(files[name], found[name], names=MAPS[name])


def _whole(read: Callable[[str], object], file: str) -> bool:
    """Whether a file exists and can be read."""
    try:
        read(file)
    except InputError:
        return False
    return True


def _frame(split: str, index: int, pose: np.ndarray, maps: bool) -> dict[str, Any]:
    stem = f"./{split}/r_{index:03d}"
    return {
        "file_path": stem,
        "exr_path": f"{stem}.exr",
        **({f"{name}_path": f"{stem}_{name}.exr" for name in MAPS} if maps else {}),
        "transform_matrix": (pose @ MITSUBA_FROM_OPENGL).tolist(),
    }
