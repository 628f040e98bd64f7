"""What `refgs doctor FOLDER` says about a data set: what was recognised, what is there, what is missing."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.data.dataset import Dataset, read_dataset, reader_of
from mi_refgs.data.hull import view_focus
from mi_refgs.data.view import View
from mi_refgs.errors import InputError

SMALL_SIDE = 48
"""Pixels of the shorter side at which pictures are looked at."""
FEW_VIEWS = 20
"""Training views below which surfels overfit; published scenes have 100 and more."""
SAME_PLACE = 1e-4
"""Distance of all cameras from their mean, as part of their distance from the origin or from the points,
below which they stand in one place."""


@dataclass(frozen=True)
class Survey:
    """State of a data set; lengths in scene units, angles in degrees."""

    folder: str
    layout: str
    views: dict[str, int]  # by split
    size: tuple[int, int]  # width and height of the first training picture, as it lies in its file
    sizes: int  # different ones
    field_of_view: tuple[float, float]  # across, least and largest
    centre: tuple[float, float, float] | None  # what all cameras look at
    camera_distance: tuple[float, float] | None  # from there, least and largest
    extent: float
    alpha: str  # "all", "some" or "none" of the pictures
    points: int  # to start from
    region: dict[str, Any] | None  # of interest
    environment: bool  # whether the true light is there
    truth: tuple[str, ...]  # maps of the test views
    missing: tuple[str, ...]  # and what is unusual

    def to_dict(self) -> dict[str, object]:
        """The survey as `--json` prints it."""
        return asdict(self)

    def to_text(self) -> str:
        """The survey for people, one thing a line, what is missing last."""
        width, height = self.size
        narrow, wide = (f"{angle:.1f}°" for angle in self.field_of_view)
        found = {
            "data set": self.folder,
            "layout": self.layout,
            "views": ", ".join(f"{count} {split}" for split, count in self.views.items()),
            "pictures": f"{width} × {height}" + (f", of {self.sizes} sizes" if self.sizes > 1 else ""),
            "alpha": {"all": "yes", "some": "some pictures only", "none": "no"}[self.alpha],
            "lenses": f"{narrow} across" if narrow == wide else f"{narrow} to {wide} across",
            "cameras": "they look at no common point",
            "points": f"{self.points} to start from" if self.points else "none",
            "region": "none",
            "true light": "yes" if self.environment else "no",
            "true maps": ", ".join(self.truth) or "none",
        }
        if self.camera_distance is not None and self.centre is not None:
            near, far = self.camera_distance
            found["cameras"] = f"{near:.3g} to {far:.3g} units from {_triple(self.centre)}"
        if self.region is not None:
            found["region"] = f"{self.region['radius']:.3g} units around {_triple(self.region['centre'])}"
        lines = [f"{name:<13}{value}" for name, value in found.items()]
        return "\n".join([*lines, *(f"NOTE: {note}" for note in self.missing)])


def survey(folder: Path) -> Survey:
    """Look at a data set, at small pictures; raises InputError as `read_dataset` does."""
    reader = reader_of(folder)
    size = reader.size(folder, "png")
    factor = max(min(size) // SMALL_SIDE, 1)
    train = read_dataset(folder, "train", downscale=factor, truth=False)
    missing = [*train.notes]
    try:
        test: Dataset | None = read_dataset(folder, "test", downscale=factor)
    except InputError as error:
        test = None
        missing.append(f"no test views ({error})")
    views = (*train.views, *(test.views if test else ()))
    angles = [2 * np.degrees(np.arctan(view.width / (2 * view.fx))) for view in views]
    centre = distance = None
    try:
        focus, far = view_focus(views)
        centre, distance = _floats(focus), (float(far.min()), float(far.max()))
    except InputError:
        missing.append("the cameras look at no common point")
    opaque = sum(not view.has_alpha for view in views)
    found = Survey(
        str(folder),
        reader.name,
        {"train": len(train.views), "test": len(test.views) if test else 0},
        size,
        len({(view.width, view.height) for view in views}),
        (float(min(angles)), float(max(angles))),
        centre,
        distance,
        train.scene_extent,
        "all" if not opaque else "none" if opaque == len(views) else "some",
        len(train.points.position) if train.points else 0,
        None if train.region is None else asdict(train.region),
        train.environment is not None,
        _truth(test.views if test else ()),
        (),
    )
    return Survey(**{**vars(found), "missing": (*missing, *_unusual(found, train))})


def few_views(count: int) -> str | None:
    """What to say of so many training views, if they are few."""
    return f"only {count} training views; expect surfaces that fit no others" if count < FEW_VIEWS else None


def require_several_sides(data: Dataset) -> None:
    """Raise InputError for views that stand in one place: they show no shape."""
    origins = np.array([view.to_world[:3, 3] for view in data.views])
    middle = origins.mean(axis=0)
    spread = np.linalg.norm(origins - middle, axis=1).max()
    scale = float(np.abs(origins).max())
    if data.points is not None:
        scale = max(scale, float(np.median(np.linalg.norm(data.points.position - middle, axis=1))))
    if spread <= SAME_PLACE * scale:
        kind = (
            "a lone training view shows"
            if len(origins) == 1
            else "all training views stand in one place and show"
        )
        raise InputError(f"{data.path}: cameras: {kind} no shape; add pictures from other sides")


def _unusual(found: Survey, train: Dataset) -> list[str]:
    notes = []
    try:
        require_several_sides(train)
    except InputError as error:
        notes.append(str(error).partition(": cameras: ")[2])
    if found.views["train"] > 1 and (few := few_views(found.views["train"])):
        notes.append(few)
    if found.alpha == "none":
        notes.append("no alpha: what surrounds the object is fitted, too; masks would leave it out")
        if found.region is None:
            notes.append("no region of interest: region.json can say one")
        if not found.points:
            notes.append("no points to start from")
    if found.alpha == "some":
        notes.append("some pictures have alpha, others have none; give all of them masks, or none")
    return notes


def _truth(views: tuple[View, ...]) -> tuple[str, ...]:
    names = {name for view in views for name in view.materials}
    names |= {name for view in views for name in ("normal", "depth") if getattr(view, name) is not None}
    return tuple(sorted(names))


def _floats(vector: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in vector)
    return x, y, z


def _triple(values: tuple[float, float, float]) -> str:
    return "(" + ", ".join(f"{round(value, 3) + 0.0:g}" for value in values) + ")"
