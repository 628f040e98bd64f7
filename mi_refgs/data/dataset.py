"""Data sets: the interface and registry of readers, and one split of views with what is known of their scene.
Colour: PNG targets stay sRGB-encoded and are composited in that space, as such data are made: A·rgb + (1 −
A)·background. EXR targets are linear and premultiplied: radiance + (1 − A)·background."""

import contextlib
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.data.images import MASKS, ImageCache, ImageFile, ImageSource, is_copy
from mi_refgs.data.lens import Lens, Undistortion, undistortion
from mi_refgs.data.region import Region, read_region, region_of
from mi_refgs.data.view import FileCamera, View, evenly_spread
from mi_refgs.errors import InputError, within
from mi_refgs.io.images import image_header
from mi_refgs.io.ownership import MARK
from mi_refgs.registry import Registry

HOLDOUT = 8  # every eighth image is a test view where a data set names none (LLFF, 3DGS, 2DGS)
NEAR_EXTENTS = 2e-3  # depth of the near plane in scene extents, about 0.01 units of Blender's data sets
FAR = 1e3  # distance of the cameras' mean from the origin, in extents, from which positions are shifted
DISTINCT = 1e-11  # extent over that distance below which all cameras are at one place; nothing is shifted
OPAQUE_CHECKED = 8  # images whose alpha is examined: if none has a transparent pixel, alpha is ignored
MAX_SIZES = 4  # image sizes in a data set, such as portrait and landscape: a fit compiles kernels for each
BACKGROUNDS = {"white": 1.0, "black": 0.0}

Item = TypeVar("Item")


@dataclass(frozen=True)
class ReadOptions:
    downscale: float = 1  # side of the blocks of pixels that are averaged
    background: float = 1.0  # 0 … 1, in the colour space of the images, where they have alpha
    images: str = "png"  # "png": sRGB-encoded, or "exr": linear radiance
    truth: bool = True  # read ground-truth normals, depth and materials
    cache: ImageCache = field(default_factory=ImageCache, compare=False)
    said: dict[str, dict[str, str]] = field(default_factory=dict, compare=False)
    """What was changed or not used, for the user: by image, an example; empty if it is about no image."""

    def say(self, what: str, image: str, example: object) -> None:
        self.said.setdefault(what, {})[image] = str(example)

    def notes(self) -> tuple[str, ...]:
        """What was said."""
        examples = [(what, len(of), next(iter(of.values()), "")) for what, of in self.said.items()]
        return tuple(f"{n} images: {what}, such as {one}" if n else what for what, n, one in examples)


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points on surfaces, as structure from motion finds them."""

    position: np.ndarray  # (P, 3) float64, world
    colour: np.ndarray | None = None  # (P, 3) linear, 0 … 1

    def followed_by(self, other: "PointCloud") -> "PointCloud":
        """These points, then others; with colours only if both have some."""
        position = np.concatenate([self.position, other.position])
        if self.colour is None or other.colour is None:
            return PointCloud(position)
        return PointCloud(position, np.concatenate([self.colour, other.colour]))


@dataclass(frozen=True)
class PixelRays:
    """Pixels of unknown depth, with their colours."""

    origin: np.ndarray  # (P, 3) float64, world
    direction: np.ndarray  # (P, 3) float64, world, to depth 1
    colour: np.ndarray  # (P, 3) linear


@dataclass(frozen=True, eq=False)
class Recording:
    """What a reader returns: the views of one split, and what is known of their scene."""

    views: tuple[View, ...]
    points: PointCloud | None = None
    environment: Path | None = None  # ground-truth environment map: lat-long EXR in Mitsuba's orientation
    source: Path | None = None  # the file that lists the views, for messages
    notes: tuple[str, ...] = ()  # what the user may want to correct, such as images without a camera


class Reader(Protocol):
    """Reader of one layout of data sets."""

    name: str
    looks_for: str  # the files by which it recognises a folder, for messages

    def recognises(self, folder: Path) -> bool: ...

    def read(self, folder: Path, split: str, options: ReadOptions) -> Recording:
        """Read the views of "train" or "test"; raises InputError that names file, field and remedy."""


READERS: Registry[Reader] = Registry("reader of data sets", newest_first=True)
"""All readers, in the order in which `recognises` is called."""
register_reader = READERS.register  # add a reader, whose `recognises` is called before those of all others


def reader_of(folder: Path, options: ReadOptions | None = None) -> Reader:
    """The reader of a folder: of several layouts that it has, the first whose training views can be read.
    Raises InputError if there is no such folder, or no such layout."""
    options = options or ReadOptions()
    if not folder.is_dir():
        raise InputError("no such folder", folder, "data set", "give one that contains images and cameras")
    readers = [*READERS.values()]
    found, failed = [reader for reader in readers if reader.recognises(folder)], list[str]()
    for reader in found:
        try:
            if len(found) > 1:
                reader.read(folder, "train", replace(options, truth=False, said={}))
        except InputError as error:
            failed.append(f"{reader.name}: {error}")
        else:
            options.said.update({f"not read as {reason}": {} for reason in failed})
            return reader
    if failed:
        what = f"none of its layouts is whole: {'; '.join(failed)}"
        raise InputError(what, folder, "data set", "mend or remove one of them")
    known = "; ".join(f"{reader.name}: {reader.looks_for}" for reader in readers)
    raise InputError("no layout is recognised", folder, "data set", f"complete it ({known})")


def held_out(ordered: Sequence[Item], split: str, source: Path | None = None) -> list[Item]:
    """The items of a split, every eighth from the first being a test view; InputError names the `source`."""
    items = [item for i, item in enumerate(ordered) if (i % HOLDOUT == 0) == (split == "test")]
    if source is not None and not items:
        raise InputError(f"zero {split} views", file=source, remedy="add images")
    return items


def require_few_sizes(file: Path, field: str, sizes: dict[tuple[int, int], str], remedy: str) -> None:
    """Raise InputError for more than MAX_SIZES image sizes; `sizes`: the name of an image of each."""
    if len(sizes) > MAX_SIZES:
        some = ", ".join(f"{width} × {height} ('{name}')" for (width, height), name in [*sizes.items()][:3])
        raise InputError(f"{len(sizes)} different sizes, such as {some}", file, field, remedy)


def require_own_names(names: Iterable[str], file: Path) -> None:
    """Raise InputError if two views have one name, by which files of a run know them."""
    for name, count in Counter(names).items():
        if count > 1:
            raise InputError(f"{count} views have this name", file, name, "list images once, or rename some")


def make_view(
    image: ImageFile,
    options: ReadOptions,
    where: str,
    name: str,
    size: tuple[float, float],  # of the image, of which the file may be a smaller copy
    pinhole: tuple[float, ...],  # fx, fy, cx, cy, pixels of an image of that size
    to_world: np.ndarray,
    lens: Lens | None = None,
) -> tuple[View, Undistortion | None]:
    """Make the view of an image; also returns how maps of the averaged image's size are undistorted. Raises
    InputError, which names `where`, for another aspect ratio, an impossible focal length or lens."""
    own, said = (image.width, image.height), f"{size[0]:g} × {size[1]:g}"
    if not is_copy(own, size):
        remedy = "turn it, as its EXIF data may say" if is_copy(own[::-1], size) else "restore the image"
        what = f"{own[0]} × {own[1]} pixels are no copy of {said}, the size in {where}"
        raise InputError(what, image.path, "size", remedy)
    if own != size:
        what = "focal length and principal point are of a larger or smaller copy, and scaled"
        options.say(what, name, f"{said} for the {own[0]} × {own[1]} pixels of {image.path.name}")
    intrinsics = (np.array(pinhole) * np.tile(np.divide(own, size), 2)).tolist()
    for focal in intrinsics[:2]:
        if not 1 / MAX_NUMBER <= focal <= MAX_NUMBER:
            raise InputError(f"{focal:.3g} pixels is out of range", where, "focal length", "correct it")
    fx, fy, cx, cy = intrinsics
    file = FileCamera(image.path, *own, (fx, fy, cx, cy), lens, image.mask)
    if (mask := image.mask) is not None and mask.below is None:
        if (masked := image_header(mask.path)[:2]) != own:
            what = f"{mask.path} of {masked[0]} × {masked[1]} for {own[0]} × {own[1]} pixels"
            options.say("the mask is of another size, and resized", name, what)
        elif mask.path.parent.name not in (MASKS, image.path.parent.name):
            options.say("a mask was found", name, mask.path)
    fx, fy, cx, cy = (value / image.downscale for value in intrinsics)
    straight = None
    if lens is not None:
        with within(where, "k1 … p2"):
            straight = undistortion(lens, *image.size, fx, fy, cx, cy)
        fx, fy = fx * straight.zoom, fy * straight.zoom
        image = replace(image, undistortion=straight)
    source = ImageSource(image, options.background, options.cache, image.has_alpha())
    view = View(name, *image.size, fx, fy, cx, cy, to_world, source, file=file)
    return replace(view, is_linear_radiance=image.is_linear_radiance), straight


@dataclass(frozen=True, eq=False)
class Dataset:
    """The views of one split."""

    path: Path  # its folder; of one in memory only a name
    split: str
    views: tuple[View, ...]
    background: np.ndarray  # (3,) float32, in the colour space of the images
    is_linear_radiance: bool  # as in `View`
    environment: Path | None  # ground-truth environment map: lat-long EXR in Mitsuba's orientation
    points: PointCloud | None = None  # on surfaces, where the data set has some
    region: Region | None = None  # of interest, for all splits; None where alpha segments the object
    notes: tuple[str, ...] = ()  # as in `Recording`
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)  # subtracted from all positions of the files
    unknown: PixelRays | None = None  # pixels whose depth stereo has not found; None: it has not been tried
    downscale: float = 1  # side of the blocks of pixels that are averaged
    source: Path | None = None  # the file that lists the views

    @staticmethod
    def from_mitsuba(scene: Any, sensors: Any = None, **options: Any) -> "Dataset":
        """Path-trace views of a Mitsuba scene in memory: what `make_dataset` writes, and a fit takes.

        scene: an `mi.Scene` or its file. sensors: Mitsuba sensors or `Camera`s, a number of views around the
        object, or None for those of the scene. Images are linear radiance (H, W, 3) over white with alpha.
        options: split ("train", or "test" for other cameras and seeds), maps (True: normals, depth and
        materials at pixel centres), and those of `DatasetOptions`, of which a sensor has its own lens and
        size. Raises InputError as `make_dataset` does, and for a sensor that is no pinhole."""
        # By name, as registries import what is registered: `synthesis` imports this module.
        made: Dataset = import_module("mi_refgs.synthesis.make_dataset").traced(scene, sensors, **options)
        return made

    @property
    def folder(self) -> str | None:
        """The folder that a run records, from which commands read views again; None in memory."""
        return str(self.path.resolve()) if self.path.is_dir() else None

    @property
    def has_alpha(self) -> bool:
        """Whether all images have alpha; views need not be loaded."""
        return all(view.has_alpha for view in self.views)

    def held_out(self, every: int) -> "tuple[Dataset, Dataset]":
        """Two data sets: without every so many views, the first included, and of these validation views."""
        kept = tuple(view for i, view in enumerate(self.views) if i % every)
        return replace(self, views=kept), replace(self, views=self.views[::every])

    def relative_to(self, offset: Sequence[float] | None) -> "Dataset":
        """The same data set with positions relative to another `offset`, that of a run if it is known."""
        if offset is None or not (shift := np.subtract(offset, self.offset)).any():
            return self
        points = self.points and replace(self.points, position=self.points.position - shift)
        views, region = tuple(_moved(view, shift) for view in self.views), self.region
        x, y, z = map(float, offset)
        moved = replace(self, views=views, points=points, offset=(x, y, z))
        return moved if region is None else replace(moved, region=region.moved(-shift))

    @cached_property
    def scene_extent(self) -> float:
        """1.1 × the largest distance of a camera to their mean (3DGS); of a single one, to the origin."""
        return _extent(self.views)


def read_dataset(
    path: str | Path,
    split: str,
    *,
    downscale: float | None = None,
    pixels: int = sys.maxsize,
    background: str = "white",
    images: str = "png",
    truth: bool = True,
) -> Dataset:
    """Read one split ("train" or "test") of the data set in folder `path`.

    `downscale`: side of the blocks of pixels that are averaged, by default the smallest whole one for which
        the largest image has at most `pixels`; incomplete blocks are left out.
    `background`: "white" or "black", behind images with alpha.
    `images`: "png" (sRGB-encoded 8-bit files; EXR files if there are no others) or "exr" (linear radiance).
    `truth`: read ground-truth normals, depth and materials where there are any.

    Images are decoded by `View.load`. The region of interest is that of region.json, or without alpha the one
    that the training cameras look at. Positions far from the world's origin, as in UTM coordinates, are
    relative to `Dataset.offset`. Raises InputError for anything missing, unreadable or inconsistent."""
    path = Path(path)
    if background not in BACKGROUNDS:
        raise InputError(f"unknown value '{background}'", path, "background", "give white or black")
    if images not in ("png", "exr"):
        raise InputError(f"unknown value '{images}'", path, "images", "give png or exr")
    options = ReadOptions(1 if downscale is None else downscale, BACKGROUNDS[background], images, truth)
    if options.downscale < 1:
        raise InputError(f"{downscale} is out of range", path, "downscale", "give a number from 1")
    reader = reader_of(path, options)
    found = reader.read(path, split, options)
    if downscale is None:
        size = max((v.file or v for v in found.views), key=lambda one: one.width * one.height)
        most = min(size.width, size.height)
        fitting = (k for k in range(1, most) if (size.width // k) * (size.height // k) <= pixels)
        if (factor := next(fitting, most)) > 1:
            options = replace(options, downscale=factor)
            found = reader.read(path, split, options)
    views, points = found.views, found.points
    notes = found.notes + options.notes()
    linear = {view.is_linear_radiance: view for view in reversed(views)}  # the first of each
    if len(linear) > 1 or (images == "exr" and False in linear):
        file, remedy = linear[False].file, "save all images alike, or give data.images=png"
        raise InputError("no EXR file", file.path if file else path, "images", remedy)
    if True in linear and images == "png":
        notes = (*notes, "the images are EXR files: they are read as linear radiance")
    sizes = {(view.width, view.height): view.name for view in views}
    remedy = f"bring all images to one size, or to {MAX_SIZES} at most"
    require_few_sizes(found.source or path, "images", sizes, remedy)
    require_own_names((view.name for view in views), found.source or path)
    # Region and offset are derived from the training cameras for every split.
    training = views
    if split != "train":
        with contextlib.suppress(InputError):  # a relit data set has none
            training = reader.read(path, "train", replace(options, truth=False, said={})).views
    # Alpha without a transparent pixel, as of photographs saved as RGBA, is ignored, but not that of masks.
    if _opaque(views) and (split == "train" or _opaque(training) or not any(map(_own_alpha, training))):
        which = f"{sum(map(_own_alpha, views))} of {len(views)} images have alpha"
        notes = (*notes, f"{which}, but no pixel is transparent: alpha is ignored")
        views = tuple(replace(v, pixels=v.pixels.without_alpha()) if _own_alpha(v) else v for v in views)
    without = [view.name for view in views if not view.has_alpha]
    if 0 < len(without) < len(views):
        which = f"{len(without)} of {len(views)} images, such as '{without[0]}'"
        what, remedy = f"no alpha and no mask for {which}", "give all images masks, or none"
        if split == "train":
            raise InputError(what, path, "images", remedy)
        notes = (*notes, f"{what}; {remedy}")
    # Positions are shifted near the origin, and clip planes derived.
    offset = _offset(training)
    extent = _extent(views if len(views) > 1 else training)
    views = tuple(replace(view, near=NEAR_EXTENTS * extent) for view in views)
    if (region := read_region(path)) is None and without:
        with contextlib.suppress(InputError):  # views that share no point have none
            region = region_of([_moved(view, offset) for view in training]).moved(offset)
    if offset.any():
        position = ", ".join(f"{x:.12g}" for x in offset)
        notes = (*notes, f"cameras are far from the origin: positions are relative to ({position})")
    colour = np.full(3, options.background, dtype=np.float32)
    known = (colour, True in linear, found.environment, points, region, notes)
    read = Dataset(path, split, views, *known, downscale=options.downscale, source=found.source)
    return read.relative_to(offset.tolist())


def require_no_data(path: Path) -> None:
    """Raise InputError if a file that the user names as output is one of a data set."""
    for folder in path.resolve().parents if path.exists() else ():
        if any(reader.recognises(folder) for reader in READERS.values()):
            what = "belongs to a data set, which is never overwritten"
            raise InputError(what, path, "output", "choose another output")
        if (folder / MARK).is_file():  # of a run in the folder of a data set
            return


def _own_alpha(view: View) -> bool:
    """Whether a view has alpha that is not from a mask."""
    return view.has_alpha and (view.file is None or view.file.mask is None)


def _opaque(views: tuple[View, ...]) -> bool:
    """Whether images with alpha have no transparent pixel; some of them are examined."""
    own = [view for view in views if _own_alpha(view)]
    loaded = (own[i].load().alpha for i in evenly_spread(len(own), OPAQUE_CHECKED))
    return bool(own) and all(alpha is None or alpha.min() >= 1 for alpha in loaded)


def _extent(views: tuple[View, ...]) -> float:
    origins = np.array([view.to_world[:3, 3] for view in views])
    middle = origins.mean(axis=0) if len(np.unique(origins, axis=0)) > 1 else 0
    return 1.1 * float(np.linalg.norm(origins - middle, axis=1).max()) or 1.0


def _offset(views: tuple[View, ...]) -> np.ndarray:
    """What to subtract from all positions, (3,): the rounded mean of cameras that are FAR away, else 0."""
    middle = np.mean([view.to_world[:3, 3] for view in views], axis=0)
    distance, extent = float(np.linalg.norm(middle)), _extent(views)
    if not FAR * extent < distance < extent / DISTINCT:
        return np.zeros(3)
    step = 10.0 ** np.ceil(np.log10(extent))
    return np.asarray(np.round(middle / step) * step)


def _moved(view: View, offset: np.ndarray) -> View:
    to_world = view.to_world.copy()
    to_world[:3, 3] -= offset
    tracks = None if view.tracks is None else view.tracks - [0, 0, *offset]
    return replace(view, to_world=to_world, tracks=tracks)
