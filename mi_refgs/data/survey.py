"""Survey of a data set for `refgs doctor FOLDER`: what was recognised, what it contains, what is missing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.data.dataset import Dataset, read_dataset, reader_of
from mi_refgs.errors import InputError, counted

SMALL = 64 * 64  # pixels of the first image as it is read
FEW_VIEWS = 20  # number of training views below which surfels overfit; published scenes have 100 and more
ONE_PLACE = 1e-4  # distance of cameras in one place from their mean, over that from the origin or the points


def survey(folder: Path) -> dict[str, Any]:
    """Survey a data set, reading small images."""
    train = read_dataset(folder, "train", pixels=SMALL, truth=False)
    first = train.views[0].file or train.views[0]
    notes, views = [*train.notes], [*train.views]
    try:
        views += read_dataset(folder, "test", downscale=train.downscale, truth=False).views
    except InputError as error:
        notes.append(f"no test views ({error})")
    for view in views:
        view.load()  # refuses broken files
    with_alpha = sum(view.has_alpha for view in views)
    try:
        require_several_sides(train)
    except InputError as error:
        notes.append(error.advice)
    if len(train.views) > 1 and (few := few_views(len(train.views))):
        notes.append(few)
    if not with_alpha:
        notes.append("no alpha: the background is fitted, too; masks would leave it out")
        if train.region is None:
            notes.append("no region of interest: give one in region.json")
        if train.points is None:
            notes.append("no points to start from: the fit searches them in the images")
    elif with_alpha < len(views) and len({view.has_alpha for view in train.views}) == 1:
        notes.append("only some images have alpha; give all images masks, or none")
    return {
        "data set": str(folder),
        "layout": reader_of(folder).name,
        "training views": len(train.views),
        "test views": len(views) - len(train.views),
        "size": [first.width, first.height],  # of the first training image in its file
        "sizes": len({(view.width, view.height) for view in views}),
        "with alpha": with_alpha,
        "points": len(train.points.position) if train.points else 0,  # to start from
        "environment map": train.environment is not None,
        "region": None if train.region is None else train.region.content,
        "notes": notes,
    }


def survey_text(found: dict[str, Any]) -> str:
    """A survey as text, one line per item, notes last."""
    lines = [f"{name:<16}{value}" for name, value in found.items() if name != "notes"]
    return "\n".join([*lines, *(f"NOTE: {note}" for note in found["notes"])])


def few_views(count: int) -> str | None:
    """A note if there are few training views, else None."""
    views = counted(count, "training view")
    return f"only {views}; other views may look wrong" if count < FEW_VIEWS else None


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
