"""Path tracing of views of a Mitsuba scene: in memory, or the files of a data set (docs/formats.md).

Of an object among other shapes, images are RGB without alpha, and maps and surface are those of the object.
The transforms are written last. dataset.json has the settings, which decide whether a folder is continued."""

from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.data.dataset import NEAR_EXTENTS, Dataset
from mi_refgs.data.images import Pixels, compose
from mi_refgs.data.poses import MITSUBA_FROM_OPENGL, pinhole
from mi_refgs.data.region import Region, read_region, write_region
from mi_refgs.data.view import View
from mi_refgs.errors import InputError, require_between, within
from mi_refgs.io.exr import write_exr
from mi_refgs.io.files import write_json
from mi_refgs.io.images import srgb_from_linear, straight_srgb, write_png
from mi_refgs.io.progress import say, with_bar
from mi_refgs.occlusion.mesh import Mesh, write_mesh
from mi_refgs.shade.light.latlong import environment_image
from mi_refgs.splat.camera import Camera
from mi_refgs.synthesis.ground_truth import surface_mesh
from mi_refgs.synthesis.options import DatasetOptions, LightFile
from mi_refgs.synthesis.pathtrace import MAPS, Cameras, Tracer, bounding_sphere, incident, object_of, reach
from mi_refgs.synthesis.settings import RELIGHT, SURFACE, load_scene, prepare_folder, under_light, without
from mi_refgs.types import Scene

SURFACE_VOXELS = 2048  # along the diameter of surface.ply: rays start 2 off, ten times a sphere's error
REGION_MARGIN = 1.2  # radius of the region over that of the object's bounding sphere: adjacent surfaces
WHITE = 1.0  # behind images with alpha in memory, as `read_dataset` has it
BLANK = Pixels(np.zeros((0, 0, 3), np.float32))


def make_dataset(
    scene: str | Path,
    out: str | Path,
    *,
    relight: str | Path | Sequence[str | Path] = (),
    overwrite: bool = False,
    progress: bool = True,
    **options: Any,
) -> Path:
    """Path-trace a data set of a Mitsuba scene into the folder `out`, which is returned.

    Cameras are on a sphere around the scene's bounding sphere and look at its centre, z up, evenly spread
    over the band of elevations. `options`: those of `DatasetOptions`, such as `views`, `size`, `spp`.
    `relight`: maps (or one) under which the test views are traced again, each in a folder of its name.
    `overwrite`: remove the views in the folder; else one that the same settings left unfinished is continued.
    A Dr.Jit variant must be set. Raises InputError for unusable options, scenes, lights and files."""
    # Settings.
    scene, out = Path(scene), Path(out)
    given = options_of("make_dataset", scene, options)
    lights = [relight] if isinstance(relight, str | Path) else relight
    settings, others = given.record(scene), [LightFile.of(Path(path)) for path in lights]
    # The scene under each light, and its surface.
    loaded = load_scene(scene, given.define)
    cameras, shapes, region = around_object(loaded, given, scene, progress)
    vertices, faces = surface_mesh(shapes)
    relit = [under_light(loaded, other.path, cameras.objects) for other in others]
    prepare_folder(out, settings, overwrite, others)
    drawn = read_region(out)
    if region is not None and (drawn is None or drawn.estimated):  # else a user's
        write_region(out, region)
    if not (out / SURFACE).exists():
        write_mesh(out / SURFACE, Mesh(vertices, faces, 2 * cameras.radius / SURFACE_VOXELS))
    write_views(out, ("train", "test"), Tracer(loaded, cameras), MAPS, progress)
    for other, scene_there in zip(others, relit, strict=True):
        alone = Tracer(scene_there, replace(cameras, objects=()))
        write_views(out / RELIGHT / other.name, ("test",), alone, {}, progress)
    return out


def options_of(who: str, scene: Path, options: dict[str, Any]) -> DatasetOptions:
    """The options of a function; raises InputError for an unknown name or a value out of range."""
    known = [field.name for field in fields(DatasetOptions)]
    for name in options.keys() - known:
        raise InputError("unknown option", who, name, f"use some of {', '.join(known)}")
    given = DatasetOptions(**options)
    given.check(scene)
    return given


def around_object(
    loaded: Scene, given: DatasetOptions, scene: Path, tell: bool = False
) -> tuple[Cameras, list[Any], Region | None]:
    """Cameras around the object of a scene, its shapes, and in an open scene the region around it."""
    for kind, there in (("shapes", loaded.shapes()), ("emitters", loaded.emitters())):
        if not there:
            raise InputError("the scene has none", scene, kind, "add an object and a light")
    named = {shape.id(): shape for shape in loaded.shapes() if shape.id()}
    for name in {*given.objects} - {*named}:
        remedy = f"give one of {', '.join(sorted(named)) or 'none'}"
        raise InputError(f"no shape has the id '{name}'", scene, "--object", remedy)
    about = [named[name] for name in dict.fromkeys(given.objects)]
    with within(scene):
        shapes, around = (about, []) if about else object_of(loaded.shapes(), given)
        centre, radius = bounding_sphere(shapes)
        farthest = reach(loaded.shapes(), centre)
    if tell and not about and len(shapes) < len(loaded.shapes()):
        what = f"the object is {_names(shapes)}; around it: {_names(around)}; lamps do not count"
        say(f"{scene.name}: {what}; `--object ID …` decides")
    about = about or (shapes if around else [])
    cameras = Cameras(given, centre, radius, farthest, about)
    if not about:
        return cameras, shapes, None
    region = Region(tuple(map(float, centre)), REGION_MARGIN * radius, estimated=True)  # fits seek a support
    if cameras.distance[0] <= region.radius:
        what = f"{cameras.distance[0]:.4g} is inside of the region around the object"
        raise InputError(f"{what}, whose radius is {region.radius:.4g}", scene, "--distance", "give more")
    return cameras, shapes, region


def _names(shapes: Sequence[Any]) -> str:
    return ", ".join(sorted({shape.id() or shape.class_name() for shape in shapes})) or "nothing"


def write_views(out: Path, splits: Sequence[str], tracer: Tracer, maps: dict[str, str], tell: bool) -> None:
    """Write the environment map, the views with `maps`, and then the transforms of some splits."""
    cameras = tracer.cameras
    views = {s: [(f"{s}/r_{i:03d}", *job) for i, job in enumerate(cameras.of(s))] for s in splits}
    light, height = out / "environment.exr", cameras.options.environment_height
    if height and cameras.objects and not light.exists():
        write_exr(light, incident(without(tracer.scene, cameras.objects), cameras.centre, cameras.options))
    elif height and tracer.scene.environment() is not None and not light.exists():
        if not maps or len(tracer.scene.emitters()) == 1:  # a relit scene is lit by its map
            write_exr(light, environment_image(tracer.scene, height))
        elif tell:
            say(f"{light}: not written, since the scene has lamps beside its map: no light is scored")
    jobs = [job for split in splits for job in views[split]]
    for name, pose, seed in with_bar(jobs, f"dataset {out.name}", unit="view", disable=not tell):
        _trace_view(tracer, out / name, pose, seed, maps)
    intrinsics = pinhole(*cameras.options.resolution, cameras.options.focal)
    for split in splits:
        frames = []
        for name, pose, _ in views[split]:
            files = {"file_path": f"./{name}", "exr_path": f"./{name}.exr"}
            files |= {f"{kind}_path": f"./{name}_{kind}.exr" for kind in maps}
            frames.append({**files, "transform_matrix": (pose @ MITSUBA_FROM_OPENGL).tolist()})
        write_json(out / f"transforms_{split}.json", {**intrinsics, "frames": frames})


def _trace_view(tracer: Tracer, stem: Path, pose: np.ndarray, seed: int, maps: dict[str, str]) -> None:
    """Trace a view, unless all of its files are there."""
    shown, linear = (stem.with_name(f"{stem.name}{ending}") for ending in (".png", ".exr"))
    files = {name: stem.with_name(f"{stem.name}_{name}.exr") for name in maps}
    if all(file.exists() for file in (shown, linear, *files.values())):
        return
    rgba = tracer.image(pose, seed)
    write_exr(linear, rgba)
    write_png(shown, straight_srgb(rgba) if rgba.shape[-1] == 4 else srgb_from_linear(rgba))
    if maps:
        found = tracer.maps(pose, rgba)
        for name, file in files.items():
            write_exr(file, found[name], names=maps[name])


def traced(
    scene: Any,
    sensors: int | Sequence[Any] | None = None,
    *,
    split: str = "train",
    maps: bool = True,
    progress: bool = False,
    **options: Any,
) -> Dataset:
    """The views in memory; see `Dataset.from_mitsuba`."""
    path = Path(scene) if isinstance(scene, str | Path) else Path("scene in memory")
    given = options_of("from_mitsuba", path, options)
    loaded = load_scene(path, given.define) if isinstance(scene, str | Path) else scene
    cameras, _, region = around_object(loaded, given, path)
    jobs: list[tuple[Tracer, View, int]] = []
    if not isinstance(sensors, int):
        sensors = [*(loaded.sensors() if sensors is None else sensors)]
    require_between(sensors if isinstance(sensors, int) else len(sensors), "sensors", 1)
    if isinstance(sensors, int):
        tracer, (width, height), focal = Tracer(loaded, cameras), given.resolution, given.focal
        numbered = replace(cameras, options=replace(given, views=sensors, test_views=sensors))
        for pose, seed in numbered.of(split):
            view = View("", width, height, focal, focal, width / 2, height / 2, pose, BLANK)
            jobs.append((tracer, view, seed))
    else:
        for index, sensor in enumerate(sensors):
            camera = sensor if isinstance(sensor, Camera) else Camera.from_sensor(sensor)
            sized = replace(given, size=(camera.width, camera.height))
            tracer = Tracer(loaded, replace(cameras, options=sized), camera)
            jobs.append((tracer, _view_of(camera), given.seed + index))
    views: list[View] = []
    for tracer, view, seed in with_bar(jobs, "views", unit="view", disable=not progress):
        image = tracer.image(view.to_world, seed).astype(np.float32)
        found = tracer.maps(view.to_world, image) if maps else {}
        found = {name: values.astype(np.float32) for name, values in found.items()}
        normal, depth = found.pop("normal", None), found.pop("depth", None)
        view = replace(view, name=f"r_{len(views):03d}", pixels=compose(image, WHITE), normal=normal)
        depth = None if depth is None else depth[..., 0]
        views.append(replace(view, depth=depth, materials=found, is_linear_radiance=True))
    data = Dataset(path, split, tuple(views), np.full(3, WHITE, np.float32), True, None, region=region)
    near = NEAR_EXTENTS * data.scene_extent
    return replace(data, views=tuple(replace(view, near=near) for view in views))


def _view_of(camera: Camera) -> View:
    """A camera as a view, without its image; InputError unless Mitsuba has such a sensor."""
    fx, fy, cx, cy = (float(x[0]) for x in (camera.fx, camera.fy, camera.cx, camera.cy))
    pose = camera.pose()
    pose[:3, :2] *= -np.sign(fx)  # in Mitsuba's frame focal lengths are negative
    if not np.isclose(fx, fy, rtol=1e-3) or np.linalg.det(pose[:3, :3]) < 0:
        what = f"focal lengths {fx:g} and {fy:g} pixels, or a mirrored pose"
        raise InputError(what, "from_mitsuba", "sensors", "give cameras of square pixels, not mirrored")
    return View("", camera.width, camera.height, abs(fx), abs(fx), cx, cy, pose, BLANK)
