"""Path-traces a multi-view data set of a Mitsuba scene: pictures, maps, light, surface and cameras.

A data set folder holds

    transforms_train.json, transforms_test.json   cameras in the Blender / NeRF convention, written after the
                                                  views
    train/r_000.png    RGBA, 8 bit: straight alpha, colour = sRGB(radiance / alpha), clipped
    train/r_000.exr    RGBA, float32, linear: premultiplied radiance and alpha
    train/r_000_normal.exr     X, Y, Z: unit shading normal at the pixel centre, world space, towards the
                               camera
    train/r_000_depth.exr      Y: distance at the pixel centre, along the viewing axis (not along the ray)
    train/r_000_albedo.exr     R, G, B: diffuse reflectance, or F0 of a metal, at the pixel centre
                               (see `data.materials`)
    train/r_000_roughness.exr  Y: √α of GGX; like albedo and metallic with A = 1 where the BSDF defines it,
                               else 0
    train/r_000_metallic.exr   Y: 0 … 1
    environment.exr    lat-long radiance of the environment, as a Mitsuba `envmap` without `to_world` shows it
    surface.ply        triangles of all shapes, world space
    region.json        of an open scene: a sphere around the object
    relight/NAME/      the test views under another light, a data set with a test split: test/r_000.png and
                       .exr, environment.exr, transforms_test.json
    dataset.json       the settings, which decide whether a folder may be resumed; and further lights

Maps are 0 off the object. Of an open scene, an object in its surroundings, pictures are RGB without alpha,
and maps, materials and surface are those of the object alone; there is no environment.exr, because a room is
not lit by what is far away alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mi_refgs.data.region import REGION_FILE, write_region
from mi_refgs.errors import InputError
from mi_refgs.occlusion.mesh import Mesh, write_mesh
from mi_refgs.synthesis.open_scene import check_cameras, named_shapes, region_around
from mi_refgs.synthesis.pathtrace import bounding_sphere, reach
from mi_refgs.synthesis.scene_file import LightFile, load_scene, scene_hash, under_light
from mi_refgs.synthesis.settings import RELIGHT, SURFACE, Settings, prepare_folder
from mi_refgs.synthesis.surface import surface_mesh
from mi_refgs.synthesis.write_colmap import colmap_output, write_colmap
from mi_refgs.synthesis.write_views import Cameras, write_views

SURFACE_VOXELS = 2048
"""Voxels along the diameter of `surface.ply`, which decide how far from it rays start: 2 voxels are 0.1 % of
the size, ten times what the tessellation of a sphere is off."""


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

    Cameras sit on a sphere around the scene's bounding sphere and look at its centre, z up; training and test
    views are two lattices, evenly spread over the band of elevations, turned and jittered by the seed.
    `test_views` is a quarter of `views` by default; `size` is width and height, or both as one, in pixels;
    `fov` is that of the shorter side, degrees. Cameras stand so far away that the sphere fills the part
    `fill` of the shorter side, or at random distances between the two of `distance`, scene units. The pixel
    filter is a box, the light is hidden from the camera (alpha 0). With `objects`, ids of shapes, the scene
    is an open one: the cameras look at those shapes from among the others. `colmap` is a folder for the same
    as COLMAP's text files (`data.write_colmap`). `light` is a lat-long map (EXR, HDR) that takes the place of
    the scene's environment, turned as that is. The test views are traced once more under each map of
    `relight`, in a folder of its file's name without suffix. Needs a Dr.Jit variant to be set.

    A folder that the same settings left unfinished is continued: what is there is kept, what is missing is
    made, lights of `relight` among it. Every file appears whole or not at all. `overwrite` removes the views
    that a folder holds.

    Raises InputError if the scene or a light cannot be loaded, a shape has no triangles (`data.surface`), a
    setting makes no sense, a camera does not see the object, the folder cannot be written, or it holds a data
    set of other settings or from elsewhere and `overwrite` is false.
    """
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
    settings.check()
    if objects and others:
        raise InputError(f"{scene}: --relight: an open scene keeps its lamps; leave it out, or --shapes")
    loaded = load_scene(scene, whole=bool(objects))
    about = named_shapes(loaded, objects, scene) if objects else []
    shapes = about or loaded.shapes()
    lit = loaded if main is None else under_light(loaded, main.path)
    try:
        vertices, faces = surface_mesh(shapes)
    except InputError as error:
        raise InputError(f"{scene}: {error}") from error
    relit = [under_light(loaded, other.path) for other in others]  # read before anything is written
    centre, radius = bounding_sphere(shapes)
    cameras = Cameras(settings, centre, radius, reach(loaded.shapes(), centre) if about else radius, about)
    region = region_around(centre, radius)
    if about:
        poses = np.stack([pose for split in ("train", "test") for pose, _ in cameras.of(split)])
        check_cameras(loaded, about, region, poses, scene)
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
