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
    environment.exr    lat-long radiance of the environment for a Mitsuba `envmap` without `to_world`; in an
                       open scene the radiance that arrives at the object's centre without the object
    surface.ply        triangles of all shapes, world space
    region.json        only for an open scene: a sphere around the object
    relight/NAME/      the test views under another environment map, a data set with a test split:
                       test/r_000.png and .exr, environment.exr, transforms_test.json
    dataset.json       the settings, which decide whether a folder may be resumed; and other environment maps

Maps are 0 off the object. An open scene is an object in its surroundings: images are RGB without alpha, maps,
materials and surface are those of the object only, and so are relit views, which have alpha.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields, replace
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
from mi_refgs.synthesis.options import DatasetOptions, LightFile
from mi_refgs.synthesis.pathtrace import (
    MAPS,
    Cameras,
    Tracer,
    bounding_sphere,
    environment_image,
    incident_image,
    reach,
)
from mi_refgs.synthesis.settings import (
    RELIGHT,
    SURFACE,
    load_scene,
    prepare_folder,
    under_light,
    without,
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
    relight: str | Path | Sequence[str | Path] = (),
    colmap: str | Path | None = None,
    overwrite: bool = False,
    progress: bool = True,
    **options: Any,
) -> Path:
    """Path-trace a data set of a Mitsuba scene into the folder `out`, which is returned.

    Cameras are on a sphere around the scene's bounding sphere and look at its centre, z up; training and test
    views are two lattices, evenly spread over the band of elevations, rotated and jittered by the seed. The
    pixel filter is a box, and emitters are hidden from the camera (alpha 0).

    `options`: those of `DatasetOptions`, such as `views`, `size`, `spp`.
    `relight`: maps (or one) under which the test views are traced again, each in a folder of its name without
    suffix.
    `colmap`: folder for the same data set as COLMAP's text files (`write_colmap`).
    `overwrite`: remove the views in the folder.

    A folder that the same settings left unfinished is continued. Files are written atomically. A Dr.Jit
    variant must be set.

    Raises InputError if an option is unknown or out of range, the scene or a light cannot be loaded, a shape
    cannot be tessellated, a camera does not see the object, the folder cannot be written, or it contains a
    data set of other settings or foreign files and `overwrite` is false.
    """
    # Settings.
    scene, out = Path(scene), Path(out)
    known = [field.name for field in fields(DatasetOptions)]
    for name in options.keys() - known:
        raise InputError(f"make_dataset: {name}: unknown option; use some of {', '.join(known)}")
    given = DatasetOptions(**options).checked(scene)
    lights = [relight] if isinstance(relight, str | Path) else relight
    settings, others = given.record(scene), [LightFile.of(Path(path)) for path in lights]

    # The scene under each light, and its surface; all input is read before anything is written.
    loaded = load_scene(scene, whole=bool(given.objects))
    about = named_shapes(loaded, given.objects, scene)
    shapes = about or loaded.shapes()
    lit = loaded if given.light is None else under_light(loaded, Path(given.light))
    try:
        vertices, faces = surface_mesh(shapes)
    except InputError as error:
        raise InputError(f"{scene}: {error}") from error
    relit = [under_light(loaded, other.path, about) for other in others]

    # Cameras.
    centre, radius = bounding_sphere(shapes)
    cameras = Cameras(given, centre, radius, reach(loaded.shapes(), centre) if about else radius, about)
    x, y, z = (float(c) for c in centre)
    region = Region((x, y, z), REGION_MARGIN * radius, estimated=True)  # fits look for what supports it
    if about:
        require_clear_view(loaded, cameras, region, scene)

    # Output.
    points = None if colmap is None else colmap_output(Path(colmap), out, cameras)
    output = prepare_folder(out, settings, overwrite, others)
    if about:
        write_region(output.own(REGION_FILE).parent, region)
    if not output.own(SURFACE).exists():
        voxel = 2 * radius / SURFACE_VOXELS
        write_mesh(out / SURFACE, Mesh(vertices.astype(np.float32), faces.astype(np.uint32), voxel))
    tracer = Tracer(lit, cameras)
    write_views(output, "", ("train", "test"), tracer, progress)
    if points is not None:
        write_colmap(points, out, tracer)
    for other, scene_there in zip(others, relit, strict=True):
        alone = Tracer(scene_there, replace(cameras, objects=()))
        write_views(output, f"{RELIGHT}/{other.name}/", ("test",), alone, progress)
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


def require_clear_view(scene: Any, cameras: Cameras, region: Region, file: Path) -> None:
    """Raise InputError if a camera is in the region, or something hides its centre."""
    import drjit as dr
    import mitsuba as mi

    origin = np.stack([pose[:3, 3] for split in ("train", "test") for pose, _ in cameras.of(split)])
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
        for shape in cameras.objects:
            own |= hit.shape == mi.ShapePtr(shape)
        hidden = np.array(hit.is_valid() & ~own) & (np.array(hit.t) < distance - region.radius)
    if hidden.any():
        raise InputError(
            f"{file}: --distance: something is between {int(hidden.sum())} of {len(origin)} cameras and "
            f"the object, at {distance[hidden].min():.4g} … {distance[hidden].max():.4g}; give a shorter "
            "distance, or another --elevation"
        )


def write_views(
    output: OutputFolder, part: str, splits: Sequence[str], tracer: Tracer, progress: bool
) -> None:
    """Write the environment map, the views, and then the transforms of some splits.

    `part` is the folder of the files: "" with maps, or "relight/NAME/" without.
    """
    # The files.
    out, cameras, maps = output.path / part, tracer.cameras, {} if part else MAPS
    endings = (".png", ".exr", *(f"_{name}.exr" for name in maps))
    views = {
        split: [(f"{split}/r_{i:03d}", *job) for i, job in enumerate(cameras.of(split))] for split in splits
    }
    files = ["environment.exr", *(f"transforms_{split}.json" for split in splits)]
    files += [f"{name}{ending}" for split in splits for name, *_ in views[split] for ending in endings]
    output.claim(*(f"{part}{file}" for file in files))

    # Their content.
    light, height = out / "environment.exr", cameras.options.environment_height
    if height and cameras.objects and not light.exists():
        room = without(tracer.scene, cameras.objects)
        write_exr(light, incident_image(room, cameras.centre, cameras.options))
    elif height and tracer.scene.environment() is not None and not light.exists():
        write_exr(light, environment_image(tracer.scene, height))
    jobs = [job for split in splits for job in views[split]]
    for name, pose, seed in with_bar(jobs, f"dataset {out.name}", unit="view", disable=not progress):
        _trace_view(tracer, out / name, pose, seed, maps)
    intrinsics = pinhole(*cameras.options.resolution, cameras.options.focal)
    for split in splits:
        frames = [
            {
                "file_path": f"./{name}",
                "exr_path": f"./{name}.exr",
                **{f"{kind}_path": f"./{name}_{kind}.exr" for kind in maps},
                "transform_matrix": (pose @ MITSUBA_FROM_OPENGL).tolist(),
            }
            for name, pose, _ in views[split]
        ]
        write_json(out / f"transforms_{split}.json", {**intrinsics, "frames": frames})


def _trace_view(tracer: Tracer, stem: Path, pose: np.ndarray, seed: int, maps: Iterable[str]) -> None:
    """Trace the missing and broken files of a view."""
    if _whole(read_png, f"{stem}.png") and _whole(read_exr, f"{stem}.exr"):
        rgba = None
    else:
        rgba = tracer.image(pose, seed)
        write_exr(f"{stem}.exr", rgba)
        write_png(f"{stem}.png", straight_srgb(rgba) if rgba.shape[-1] == 4 else srgb_from_linear(rgba))
    missing = [name for name in maps if not _whole(read_exr, f"{stem}_{name}.exr")]
    if missing:
        image = read_exr_image(f"{stem}.exr") if rgba is None else rgba
        found = tracer.maps(pose, image[..., -1] > 0 if image.shape[-1] == 4 else np.array(True))
        for name in missing:
            write_exr(f"{stem}_{name}.exr", found[name], names=MAPS[name])


def _whole(read: Callable[[str], object], file: str) -> bool:
    """Whether a file exists and can be read."""
    try:
        read(file)
    except InputError:
        return False
    return True
