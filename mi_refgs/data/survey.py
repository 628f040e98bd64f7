"""Survey of a data set for `refgs doctor FOLDER`: what was recognised, what it contains, what is missing."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.data.dataset import Dataset, read_dataset, reader_of
from mi_refgs.data.hull import view_focus
from mi_refgs.data.view import View
from mi_refgs.errors import InputError

SMALL_SIDE = 48  # pixels of the shorter side at which images are read
FEW_VIEWS = 20  # number of training views below which surfels overfit; published scenes have 100 and more
ONE_PLACE = 1e-4
"""Largest distance of cameras in one place from their mean, over their distance from the origin or the
points."""


@dataclass(frozen=True)
class Survey:
    """State of a data set; lengths in scene units, angles in degrees."""

    folder: str
    layout: str
    views: dict[str, int]  # number by split
    size: tuple[int, int]  # width and height of the first training image in its file
    sizes: int  # number of different ones
    field_of_view: tuple[float, float]  # horizontal, smallest and largest
    centre: tuple[float, float, float] | None  # the point that all cameras look at
    camera_distance: tuple[float, float] | None  # from that point, smallest and largest
    extent: float
    alpha: str  # "all", "some" or "none" of the images
    points: int  # initial ones
    region: dict[str, Any] | None  # of interest
    environment: bool  # whether there is a ground-truth environment map
    truth: tuple[str, ...]  # ground-truth maps of the test views
    missing: tuple[str, ...]  # and what is unusual

    def to_dict(self) -> dict[str, object]:
        """The survey as `--json` prints it."""
        return asdict(self)

    def to_text(self) -> str:
        """The survey as text, one line per item, notes last."""
        width, height = self.size
        narrow, wide = (f"{angle:.1f}°" for angle in self.field_of_view)
        cameras, region = "they look at no common point", "none"
        if self.camera_distance is not None and self.centre is not None:
            near, far = self.camera_distance
            cameras = f"{near:.3g} to {far:.3g} units from {_triple(self.centre)}"
        if self.region is not None:
            region = f"radius {self.region['radius']:.3g} around {_triple(self.region['centre'])}"
        truth = [*self.truth, "environment map"] if self.environment else self.truth
        items = {
            "data set": self.folder,
            "layout": self.layout,
            "views": ", ".join(f"{count} {split}" for split, count in self.views.items()),
            "images": f"{width} × {height}" + (f", of {self.sizes} sizes" if self.sizes > 1 else ""),
            "alpha": {"all": "yes", "some": "some images only", "none": "no"}[self.alpha],
            "lenses": f"{narrow} across" if narrow == wide else f"{narrow} to {wide} across",
            "cameras": cameras,
            "points": f"{self.points} to start from" if self.points else "none",
            "region": region,
            "ground truth": ", ".join(truth) or "none",
        }
        lines = [f"{name:<13}{value}" for name, value in items.items()]
        return "\n".join([*lines, *(f"NOTE: {note}" for note in self.missing)])


def survey(folder: Path) -> Survey:
    """Survey a data set, reading small images; raises InputError as `read_dataset` does."""
    reader = reader_of(folder)
    size = reader.size(folder, "png")
    factor = max(min(size) // SMALL_SIDE, 1)
    train = read_dataset(folder, "train", downscale=factor, truth=False)
    missing = [*train.notes]
    try:
        test_views = read_dataset(folder, "test", downscale=factor).views
    except InputError as error:
        test_views = ()
        missing.append(f"no test views ({error})")
    views = (*train.views, *test_views)
    angles = [_across(view) for view in views]
    centre = distance = None
    try:
        (x, y, z), far = view_focus(views)
        centre, distance = (float(x), float(y), float(z)), (float(far.min()), float(far.max()))
    except InputError:
        missing.append("the cameras look at no common point")
    with_alpha = sum(view.has_alpha for view in views)
    truth = {name for view in test_views for name in view.materials}
    truth |= {n for view in test_views for n in ("normal", "depth") if getattr(view, n) is not None}
    found = Survey(
        folder=str(folder),
        layout=reader.name,
        views={"train": len(train.views), "test": len(test_views)},
        size=size,
        sizes=len({(view.width, view.height) for view in views}),
        field_of_view=(min(angles), max(angles)),
        centre=centre,
        camera_distance=distance,
        extent=train.scene_extent,
        alpha={0: "none", len(views): "all"}.get(with_alpha, "some"),
        points=len(train.points.position) if train.points else 0,
        region=None if train.region is None else train.region.content,
        environment=train.environment is not None,
        truth=tuple(sorted(truth)),
        missing=(),
    )
    return replace(found, missing=(*missing, *_unusual(found, train)))


def few_views(count: int) -> str | None:
    """A note if there are few training views, else None."""
    if count >= FEW_VIEWS:
        return None
    views = "view" if count == 1 else "views"
    return f"only {count} training {views}; other views may look wrong"


def require_several_sides(data: Dataset) -> None:
    """Raise InputError if all views are in one place, which leaves the shape undetermined."""
    origins = np.array([view.to_world[:3, 3] for view in data.views])
    middle = origins.mean(axis=0)
    spread = np.linalg.norm(origins - middle, axis=1).max()
    scale = float(np.abs(origins).max())
    if data.points is not None:
        scale = max(scale, float(np.median(np.linalg.norm(data.points.position - middle, axis=1))))
    if spread <= ONE_PLACE * scale:
        views = "a single training view shows" if len(origins) == 1 else "training views in one place show"
        raise InputError(f"{views} no shape", data.path, "cameras", "add images from other sides")


def _unusual(found: Survey, train: Dataset) -> list[str]:
    notes = []
    try:
        require_several_sides(train)
    except InputError as error:
        notes.append(error.advice)
    if found.views["train"] > 1 and (few := few_views(found.views["train"])):
        notes.append(few)
    if found.alpha == "none":
        notes.append("no alpha: the background is fitted, too; masks would leave it out")
        if found.region is None:
            notes.append("no region of interest: give one in region.json")
        if not found.points:
            notes.append("no points to start from: the fit searches them in the images")
    if found.alpha == "some" and len({view.has_alpha for view in train.views}) == 1:  # else noted already
        notes.append("only images of one split have alpha; give all images masks, or none")
    return notes


def _across(view: View) -> float:
    """Horizontal field of view (degrees) of the whole file: downscaled views leave out a border."""
    width, fx = (view.width, view.fx) if view.file is None else (view.file.width, view.file.intrinsics[0])
    return float(2 * np.degrees(np.arctan(width / (2 * fx))))


def _triple(values: tuple[float, float, float]) -> str:
    return "(" + ", ".join(f"{round(value, 3) + 0.0:g}" for value in values) + ")"
