"""A data set: the views of one split, and what is known of their scene.

Colour: PNG targets stay as displayed, sRGB-encoded, composited in that space as such data was made:
A·rgb + (1 − A)·background. EXR targets are linear and premultiplied: radiance + (1 − A)·background.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path

import numpy as np

from mi_refgs.data.readers import PointCloud, ReadOptions, reader_of
from mi_refgs.data.region import Region, read_region, region_of
from mi_refgs.data.view import View
from mi_refgs.errors import InputError
from mi_refgs.io.exr import read_exr_image
from mi_refgs.io.images import is_opaque

EXTENT_MARGIN = 1.1
"""Scene extent over the largest distance of a training camera to their mean (3DGS)."""
NEAR_EXTENTS = 2e-3
"""Depth of the near plane in scene extents, about 0.01 in the units of Blender's data sets: what is nearer
stands in front of the lens."""
FAR = 1e3
"""Distance of the training cameras' mean from the world's origin, in scene extents, from which positions are
moved: from there float32 resolves less than a ten-thousandth of the extent."""
DISTINCT = 1e-11
"""Scene extent as part of that distance below which cameras stand in one place, and nothing is moved."""
OPAQUE = 8
"""Images whose alpha is looked at: an object that leaves no pixel free in any of them is not cut out."""
MAX_SIZES = 4
"""Sizes of pictures in a data set, such as upright and lying: a fit compiles every kernel for each."""
BACKGROUNDS = {"white": 1.0, "black": 0.0}
IMAGE_KINDS = ("png", "exr")


@dataclass(frozen=True, eq=False)
class Dataset:
    """The views of one split."""

    path: Path
    split: str
    views: tuple[View, ...]
    background: np.ndarray  # (3,) float32, in the space of the targets
    is_linear_radiance: bool  # as in View
    environment: Path | None  # ground truth of the light: lat-long EXR in Mitsuba's orientation
    points: PointCloud | None = None  # on what is seen, where the data set has some
    region: Region | None = None  # of interest, of all splits; absent where alpha says what is the object's
    notes: tuple[str, ...] = ()  # as in Recording
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """What was subtracted from all positions of the files, scene units; as `FAR` says."""

    @property
    def has_alpha(self) -> bool:
        """Whether all pictures have alpha that leaves something out; decodes nothing."""
        return all(view.has_alpha for view in self.views)

    @cached_property
    def scene_extent(self) -> float:
        """1.1 × the largest distance of a camera to their mean, scene units (3DGS).

        For a lone camera that to the world's origin; 1 if it stands there.
        """
        return _extent(self.views)


def read_dataset(
    path: str | Path,
    split: str,
    *,
    downscale: int | None = None,
    background: str = "white",
    images: str = "png",
    truth: bool = True,
    decode: bool = True,
) -> Dataset:
    """Read one split ("train" or "test") of the data set in folder `path`.

    `downscale` averages blocks of so many pixels squared, colour premultiplied by alpha; without it pictures
    are read whole. Pixels at the right and the bottom that fill no block are left out. Where the data set
    names no test views, every eighth picture, in the order of their paths, is one and no training view.
    `truth` reads normals, depth and materials where there are any. `decode` reads images now, while memory
    is granted (`picture_store`), so that a broken file is told here; without it `View.load` reads them. The
    region of interest is what region.json says; without it, and without alpha, what the training cameras look
    at, for every split. Positions far from the world's origin, as in UTM coordinates, come relative to
    `Dataset.offset`, the same in all splits.

    Raises InputError for anything missing, unreadable or inconsistent: file, field and remedy are named.
    """
    path = Path(path)
    if background not in BACKGROUNDS:
        raise InputError(f"{path}: background: unknown value '{background}'; give white or black")
    if images not in IMAGE_KINDS:
        raise InputError(f"{path}: images: unknown value '{images}'; give png or exr")
    downscale = 1 if downscale is None else downscale
    if downscale < 1:
        raise InputError(f"{path}: downscale: {downscale} is out of range; give a whole number from 1")
    options = ReadOptions(downscale, BACKGROUNDS[background], images, truth, decode)
    found = reader_of(path).read(path, split, options)
    views = found.views
    sizes = {(view.width, view.height): view.name for view in views}
    if len(sizes) > MAX_SIZES:
        shown = ", ".join(f"{width} × {height} ('{name}')" for (width, height), name in [*sizes.items()][:3])
        raise InputError(
            f"{found.source or path}: pictures: {len(sizes)} different sizes, such as {shown}; "
            f"bring all pictures to one size, or to {MAX_SIZES} at most"
        )

    # What depends on the cameras depends on the training cameras, for every split: a fit and its evaluation
    # mean the same sphere, and the same place.
    @cache
    def training() -> tuple[View, ...]:
        return views if split == "train" else _training_views(path, options)

    notes = found.notes
    if _opaque(views) and (split == "train" or _opaque(training())):
        views = tuple(view.changed(alpha=None) if _own_alpha(view) else view for view in views)
        notes = (*notes, "images have alpha, but no pixel is transparent: they count as images without")
    offset = _offset(training()) if split == "train" or _may_be_far(views) else np.zeros(3)
    near = NEAR_EXTENTS * _extent(views, offset)
    colour = np.full(3, BACKGROUNDS[background], dtype=np.float32)
    region = read_region(path)
    region = None if region is None else region.moved(-offset)
    if region is None and not all(view.has_alpha for view in views):
        with contextlib.suppress(InputError):  # views that share no point have none
            region = region_of([_moved(view, offset) for view in training()])
    views = tuple(_moved(view, offset).changed(near=near) for view in views)
    points = found.points
    if offset.any():
        points = None if points is None else replace(points, position=points.position - offset)
        x, y, z = (f"{value:.12g}" for value in offset)
        notes = (*notes, f"cameras stand far from the origin: positions are relative to ({x}, {y}, {z})")
    linear = images == "exr"
    return Dataset(
        path,
        split,
        views,
        colour,
        linear,
        found.environment,
        points,
        region,
        notes,
        (float(offset[0]), float(offset[1]), float(offset[2])),
    )


def fitting_downscale(path: str | Path, images: str, pixels: int) -> tuple[int, int, int]:
    """The smallest `downscale` with which the first training picture has at most so many pixels.

    Returns it with the picture's own width and height. Raises InputError as `read_dataset` does.
    """
    width, height = reader_of(Path(path)).size(Path(path), images)
    factor = 1
    while factor < min(width, height) and (width // factor) * (height // factor) > pixels:
        factor += 1
    return factor, width, height


def _training_views(path: Path, options: ReadOptions) -> tuple[View, ...]:
    return reader_of(path).read(path, "train", replace(options, truth=False, decode=False)).views


def _own_alpha(view: View) -> bool:
    """Whether a view has alpha, and not that of a mask."""
    return view.has_alpha and (view.file is None or view.file.mask is None)


def _opaque(views: tuple[View, ...]) -> bool:
    """Whether alpha says nothing: no pixel is transparent in OPAQUE images that have alpha, evenly chosen."""
    own = [view for view in views if _own_alpha(view)]
    chosen = np.unique(np.linspace(0, len(own) - 1, OPAQUE).astype(int)) if own else ()
    return bool(own) and all(_is_opaque(own[i]) for i in chosen)


def _is_opaque(view: View) -> bool:
    if view.file is None:
        return view.alpha is not None and bool(view.alpha.min() >= 1)
    if view.file.path.suffix.lower() == ".exr":
        return bool(read_exr_image(view.file.path)[..., 3].min() >= 1)
    return is_opaque(view.file.path)


def _extent(views: tuple[View, ...], offset: np.ndarray | float = 0.0) -> float:
    origins = np.array([view.to_world[:3, 3] for view in views]) - offset
    middle = origins.mean(axis=0) if len(np.unique(origins, axis=0)) > 1 else 0
    return EXTENT_MARGIN * float(np.linalg.norm(origins - middle, axis=1).max()) or 1.0


def _may_be_far(views: tuple[View, ...]) -> bool:
    """Whether it takes the training cameras to say if views stand far away: unless they are plainly near."""
    middle = np.mean([view.to_world[:3, 3] for view in views], axis=0)
    return len(views) == 1 or float(np.linalg.norm(middle)) > 0.01 * FAR * _extent(views)


def _offset(views: tuple[View, ...]) -> np.ndarray:
    """What to subtract from all positions, (3,) float64: the mean of cameras that stand FAR away, in round
    numbers; else 0."""
    middle = np.mean([view.to_world[:3, 3] for view in views], axis=0)
    distance, extent = float(np.linalg.norm(middle)), _extent(views)
    if not FAR * extent < distance < extent / DISTINCT:
        return np.zeros(3)
    step = 10.0 ** np.ceil(np.log10(extent))
    return np.asarray(np.round(middle / step) * step)


def _moved(view: View, offset: np.ndarray) -> View:
    """The view with positions relative to an offset (3,)."""
    if not offset.any():
        return view
    to_world = view.to_world.copy()
    to_world[:3, 3] -= offset
    return view.changed(to_world=to_world)
