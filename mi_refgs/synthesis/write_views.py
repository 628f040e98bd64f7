"""Path-traces the views of a data set into its folder, whatever of them is missing there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.data.poses import MITSUBA_FROM_OPENGL, pinhole
from mi_refgs.errors import InputError
from mi_refgs.io.exr import read_exr, read_exr_image, write_exr
from mi_refgs.io.files import write_json
from mi_refgs.io.images import read_png, srgb_from_linear, straight_srgb, write_png
from mi_refgs.io.ownership import OutputFolder
from mi_refgs.progress import with_bar
from mi_refgs.synthesis.pathtrace import MAPS, Tracer, camera_poses, environment_image
from mi_refgs.synthesis.settings import Settings


@dataclass(frozen=True)
class Cameras:
    """The cameras of a data set around the bounding sphere of what it is about."""

    settings: Settings
    centre: np.ndarray
    radius: float
    reach: float  # around the centre, of all that is there
    objects: Sequence[Any] = ()  # shapes that an open scene is about

    @property
    def distance(self) -> tuple[float, float]:
        """From the centre to the nearest and the farthest camera."""
        filling = self.radius / (self.settings.fill * math.sin(math.radians(self.settings.fov) / 2))
        near, far = self.settings.distance
        return near or filling, far or filling

    def tracer(self, scene: Any) -> Tracer:
        """What traces views of a scene of this size."""
        s, (low, high) = self.settings, self.distance
        near, far = 0.1 * (low - self.radius), 10 * (high + self.reach)
        options: dict[str, Any] = {
            "fov": s.fov,
            "spp": s.spp,
            "max_depth": s.max_depth,
            "objects": self.objects,
        }
        return Tracer(scene, size=s.resolution, near=near, far=far, **options)

    def of(self, split: str) -> list[tuple[np.ndarray, int]]:
        """Pose and seed of each view of a split.

        Independent streams: one per split for the cameras, one per view for its paths.
        """
        s, index = self.settings, ("train", "test").index(split)
        rng = np.random.default_rng([s.seed, index])
        count = s.test_views if index else s.views
        poses = camera_poses(count, self.centre, self.distance, s.elevation, rng)
        streams = (np.random.SeedSequence([s.seed, index, i]) for i in range(count))
        return [(p, int(stream.generate_state(1)[0])) for p, stream in zip(poses, streams, strict=True)]


def write_views(
    output: OutputFolder,
    part: str,
    splits: Sequence[str],
    cameras: Cameras,
    tracer: Tracer,
    maps: bool,
    progress: bool,
) -> None:
    """The light, the views and then the transforms of some splits under one light; `maps`: with those.

    `part` is what the paths of the files begin with, "" or "relight/NAME/".
    """
    out = output.path / part
    endings = (".png", ".exr", *(f"_{name}.exr" for name in MAPS if maps))
    views = [f"{split}/r_{i:03d}" for split in splits for i, _ in enumerate(cameras.of(split))]
    files = ["environment.exr", *(f"transforms_{split}.json" for split in splits)]
    output.claim(*(f"{part}{file}" for file in (*files, *(view + end for view in views for end in endings))))
    light, height = out / "environment.exr", cameras.settings.environment_height
    known = tracer.scene.environment() is not None and not cameras.objects  # a room is lit by more than it
    if height and known and not light.exists():
        write_exr(light, environment_image(tracer.scene, height))
    jobs = [(f"{split}/r_{i:03d}", *job) for split in splits for i, job in enumerate(cameras.of(split))]
    for name, pose, seed in with_bar(jobs, f"dataset {out.name}", unit="view", disable=not progress):
        _trace_view(tracer, out / name, pose, seed, maps)
    for split in splits:
        frames = [_frame(split, i, pose, maps) for i, (pose, _) in enumerate(cameras.of(split))]
        write_json(out / f"transforms_{split}.json", _transforms(cameras.settings, frames))


def _trace_view(tracer: Tracer, stem: Path, pose: np.ndarray, seed: int, maps: bool) -> None:
    """Trace what a view lacks; a broken file is missing."""
    if _whole(read_png, f"{stem}.png") and _whole(read_exr, f"{stem}.exr"):
        rgba = None
    else:
        rgba = tracer.picture(pose, seed)
        write_exr(f"{stem}.exr", rgba)
        write_png(f"{stem}.png", straight_srgb(rgba) if rgba.shape[-1] == 4 else srgb_from_linear(rgba))
    files = {name: f"{stem}_{name}.exr" for name in MAPS} if maps else {}
    missing = [name for name, file in files.items() if not _whole(read_exr, file)]
    if missing:
        picture = read_exr_image(f"{stem}.exr") if rgba is None else rgba
        found = tracer.maps(pose, picture[..., -1] > 0 if picture.shape[-1] == 4 else np.array(True))
        for name in missing:
            write_exr(files[name], found[name], names=MAPS[name])


def _whole(read: Any, file: str) -> bool:
    """Whether a file is there and can be read."""
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


def _transforms(settings: Settings, frames: list[dict[str, Any]]) -> dict[str, Any]:
    width, height = settings.resolution
    return {**pinhole(width, height, settings.focal), "frames": frames}
