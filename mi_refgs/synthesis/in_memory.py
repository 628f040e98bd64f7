"""Path-traced views of a Mitsuba scene in memory: `Dataset.from_mitsuba`."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.data.dataset import NEAR_EXTENTS, Dataset
from mi_refgs.data.images import Pixels, compose
from mi_refgs.data.view import View
from mi_refgs.errors import InputError
from mi_refgs.io.progress import with_bar
from mi_refgs.splat.camera import Camera
from mi_refgs.synthesis.make_dataset import around_object, options_of
from mi_refgs.synthesis.pathtrace import Tracer
from mi_refgs.synthesis.settings import load_scene

WHITE = 1.0  # behind images with alpha, as `read_dataset` has it
BLANK = Pixels(np.zeros((0, 0, 3), np.float32))


def traced(
    scene: Any,
    sensors: int | Sequence[Any] | None = None,
    *,
    split: str = "train",
    maps: bool = True,
    progress: bool = False,
    **options: Any,
) -> Dataset:
    """The views; see `Dataset.from_mitsuba`."""
    path = Path(scene) if isinstance(scene, str | Path) else Path("scene in memory")
    given = options_of("from_mitsuba", path, options)
    loaded = load_scene(path, given.define) if isinstance(scene, str | Path) else scene
    cameras, _, region = around_object(loaded, given, path)
    jobs: list[tuple[Tracer, View, int]] = []
    if isinstance(sensors, int):
        tracer, (width, height), focal = Tracer(loaded, cameras), given.resolution, given.focal
        numbered = replace(cameras, options=replace(given, views=sensors, test_views=sensors))
        for pose, seed in numbered.of(split):
            view = View("", width, height, focal, focal, width / 2, height / 2, pose, BLANK)
            jobs.append((tracer, view, seed))
    else:
        for index, sensor in enumerate(loaded.sensors() if sensors is None else sensors):
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
