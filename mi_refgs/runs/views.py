"""The views of a run: a split of its data set, read as its method says, with its region of interest."""

import contextlib
import hashlib
import os
import sys
import warnings
import zlib
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.data.dataset import Dataset, read_dataset, require_own_names
from mi_refgs.data.images import Pixels
from mi_refgs.data.region import Region
from mi_refgs.errors import InputError
from mi_refgs.io.progress import Tell
from mi_refgs.methods.method import Method
from mi_refgs.methods.read import PRESETS
from mi_refgs.runs.run import DATASET, Run

CROPPED = 4  # times a preset's pixels may have an image of which steps render parts: they take no longer
MEASURED = 640  # pixels along the longer side of scored photographs: larger ones differ in noise and focus


def sized(method: Method, path: Path | Dataset, tell: Tell = lambda _: None) -> tuple[Method, Dataset]:
    """The method with its image size decided, and training views without ground truth: `data.downscale`, or
    the least for its preset's pixels, which calls `tell`. Raises InputError as `read_dataset` does."""
    pixels = PRESETS[method.preset].pixels if method.preset in PRESETS else sys.maxsize
    pixels *= 1 if method.data.crop is None else CROPPED
    views = read_views(method, path, "train", truth=False, pixels=pixels)
    if method.data.downscale is None and views.downscale > 1 and not isinstance(path, Dataset):
        large = max(views.views, key=lambda one: one.width * one.height)
        file = large.file or large
        tell(
            f"{views.path}: images of {file.width} × {file.height} pixels are read as {large.width} × "
            f"{large.height}; preset {method.preset} takes {pixels:,} pixels at most, --set "
            f"data.downscale=1 reads them whole"
        )
    return as_read(method, path, views), views


def options_of(views: Dataset) -> dict[str, Any]:
    """The options of `[data]` with which views were read."""
    background = "white" if views.background.any() else "black"
    images = "exr" if views.is_linear_radiance else "png"
    return {"downscale": views.downscale, "background": background, "images": images}


def as_read(method: Method, path: Path | Dataset, views: Dataset) -> Method:
    """The method with the options by which these views of `path` were read."""
    data = replace(method.data, downscale=views.downscale)
    if isinstance(path, Dataset):
        data = replace(data, **options_of(views))
        if not views.folder:  # commands that follow may be given a folder of other images
            data = replace(data, images="png")
    return replace(method, data=data)


def read_views(method: Method, path: Path | Dataset, split: str, truth: bool = True, **size: Any) -> Dataset:
    """A split of a data set, read as a method says, but for `size`, options of `read_dataset`; one in memory
    as it is. Raises InputError as `read_dataset` does, and for another split."""
    if isinstance(path, Dataset):
        if path.split != split or not path.views:
            what = f"it has {len(path.views)} {path.split} views"
            raise InputError(what, path.path, "split", f"give {split} views")
        require_own_names((view.name for view in path.views), path.path)
        for view in path.views:
            numbers = (view.fx, view.fy, view.cx, view.cy, *view.to_world.ravel())
            if not (min(numbers[:2]) > 0 and np.isfinite(numbers).all()):
                raise InputError("not finite, or not positive", view.name, "fx … to_world", "correct it")
            if (view.has_alpha, view.is_linear_radiance) != (path.has_alpha, path.is_linear_radiance):
                raise InputError("not as in others", view.name, "alpha, radiance", "make all views alike")
        return path
    options, size = method.data, {"downscale": method.data.downscale, "truth": truth} | size
    return read_dataset(path, split, background=options.background, images=options.images, **size)


def measured_views(method: Method, path: Path | Dataset, truth: bool = True) -> Dataset:
    """Test views as they are scored: images with alpha as the method reads them, others of equal size for
    every method, with MEASURED pixels along the longer side or all of the file's."""
    views = read_views(method, path, "test", truth)
    sides = [max(view.file.width, view.file.height) for view in views.views if view.file is not None]
    if views.has_alpha or not sides:
        return views
    return read_views(method, path, "test", truth, downscale=max(max(sides) / MEASURED, 1))


def views_of_run(
    run: Run, method: Method, split: str, path: Path | Dataset | None = None, measured: bool = False
) -> Dataset:
    """A split of the data set of a run (or at `path`), with the run's region of interest; test views may be
    those of `measured_views`. Raises InputError as `read_dataset` and `Run.region` do, and if the run records
    no data set or it is gone."""
    known = run.images() if path is None else {}  # a data set that is named is taken as it is
    if path is None:
        record, path = run.path / DATASET, run.dataset()
        if path is None:
            raise InputError("the run records no data set", record, "path", "name one with --data")
        if not os.path.isdir(path):  # False for impossible names too
            raise InputError(f"{path} is gone", record, "path", "name the data set's folder with --data")
    views = measured_views(method, path) if measured else read_views(method, path, split)
    warn_of_changes(views, method, known)
    return with_region(views.relative_to(run.offset()), run.region())


@lru_cache(maxsize=1 << 14)
def _checksum(path: Path, size: int, modified: int) -> int:
    """Of a file of this size and time of change, read once in a process."""
    return zlib.crc32(path.read_bytes())


def digests(views: Dataset) -> dict[str, str]:
    """A digest of each view by name: camera, files of image and mask, presence of alpha, mean in memory."""
    found = {}
    for view in views.relative_to((0, 0, 0)).views:  # rounded twice, since files end with ties of a digit
        paths = [one.path for one in (view.file, view.file and view.file.mask) if one and one.path.is_file()]
        stats = ((path, path.stat()) for path in paths)
        files: list[Any] = [_checksum(path, stat.st_size, stat.st_mtime_ns) for path, stat in stats]
        if isinstance(view.pixels, Pixels):  # in memory: as far as paths traced again are the same
            files.append(np.round(view.image.mean(axis=(0, 1)), 3).tolist())
        camera = np.round(np.round([view.fx, view.fy, view.cx, view.cy, *view.to_world.ravel()], 8), 5)
        text = repr((files, view.has_alpha, view.width, view.height, (camera + 0.0).tolist()))
        found[view.name] = hashlib.sha256(text.encode()).hexdigest()[:16]
    return found


def changed(views: Dataset, known: Mapping[str, str]) -> list[str]:
    """The images whose digests are not those that a run recorded (`Run.images`), if it did."""
    now = digests(views) if known else {}
    return [name for name in {**known, **now} if known.get(name) != now.get(name)]


def warn_of_changes(views: Dataset, method: Method, known: Mapping[str, str]) -> None:
    """Warn if the training images of the data set of these views are not those that a run began with."""
    if not known:
        return
    with contextlib.suppress(InputError):  # of images that are gone, readers of the split tell
        train = views if views.split == "train" else read_views(method, views.path, "train", truth=False)
        if other := changed(train, known):
            what = f"{len(other)} images or cameras are not as when the fit began, such as {other[0]}"
            warnings.warn(f"{views.path}: {what}; fit again, or restore them", RuntimeWarning, stacklevel=3)


def with_poses(views: Dataset, cameras: Mapping[str, Any]) -> Dataset:
    """Replace the poses by those that a fit corrected (cameras.json), if these are its training views."""
    poses = cameras.get("to_world", {})
    if views.split != "train" or [*poses] != [view.name for view in views.views]:
        return views
    corrected = (replace(view, to_world=np.array(poses[view.name], np.float64)) for view in views.views)
    return replace(views, views=tuple(corrected))


def with_region(views: Dataset, region: Region | None, tell: Tell = lambda _: None) -> Dataset:
    """Replace the region of interest by a run's, if it has one; `tell` is called if they differ."""
    if region is None:
        return views
    now = views.region
    if now is None or not ((now.estimated and region.estimated) or now.is_close(region)):
        tell(f"{views.path}: region: it has changed since the run was started, which keeps its own")
    return replace(views, region=region)
