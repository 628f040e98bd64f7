"""Survey of a data set for `refgs doctor FOLDER`: what was recognised, what it contains, what is missing."""

import contextlib
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from mi_refgs.data.checks import FINE, SAID, examine, off_backdrop
from mi_refgs.data.dataset import read_dataset, reader_of
from mi_refgs.data.images import FOLDERS, MASKS
from mi_refgs.data.view import View
from mi_refgs.errors import InputError
from mi_refgs.io.images import read_bytes, write_png

PIXELS = 400 * 400  # of the first image at most, as the preset "standard" reads it


def survey(folder: Path) -> dict[str, Any]:
    """Survey the views of a data set in images about as large as a fit reads them."""
    train = read_dataset(folder, "train", pixels=PIXELS, truth=False)
    if train.downscale > 1:  # JPEG files are decoded smaller by a power of two, in a tenth of the time
        power = 1 << (int(train.downscale) - 1).bit_length()
        train = read_dataset(folder, "train", downscale=power, truth=False)
    first = train.views[0].file or train.views[0]
    findings, notes, views = examine(train), [*train.notes], [*train.views]
    try:
        views += read_dataset(folder, "test", downscale=train.downscale, truth=False).views
    except InputError as error:
        notes.append(f"no test views ({error})")
    with ThreadPoolExecutor() as pool:
        deque(pool.map(View.load, views), 0)  # refuses broken files
    with_alpha = sum(view.has_alpha for view in views)
    notes += [finding.error.advice for finding in findings if finding.level != FINE]
    if not with_alpha:
        notes.append("no alpha: the background is fitted, too; masks would leave it out")
        if train.region is None:
            notes.append("no region of interest: give one in region.json")
        if train.points is None:
            notes.append("no points to start from: the fit searches them in the images")
    elif with_alpha < len(views):
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
        "checks": {finding.name: finding.numbers for finding in findings},
        "notes": notes,
    }


def write_masks(folder: Path) -> None:
    """Write masks of images with a plain backdrop, without the pixels that mix it with the object. Raises
    InputError for other images, and for a folder that has masks."""
    if survey(folder)["checks"].get("background", {}).get("result") != SAID:
        raise InputError("no plain background", folder, "--masks", "segment the object by another program")
    masks = dict[Path, tuple[Path, Path]]()  # folder and name, by image
    for split in ("train", "test"):
        with contextlib.suppress(InputError):
            data = read_dataset(folder, split, truth=False)
            for file in (view.file.path for view in data.views if view.file):
                parts = file.relative_to(folder).parts
                # COLMAP's are beside its folder of images, such as dense/0/images.
                deep = len(parts) if data.source and data.source.stem == "images" else 1
                at = next((i for i, part in enumerate(parts[:deep]) if part in FOLDERS), -1)
                name = Path(*parts[at + 1 : -1], f"{file.name}.png")  # a.jpg and a.png may be two
                masks[file] = folder.joinpath(*parts[: max(at, 0)], MASKS), name
    if found := [root for root, _ in masks.values() if root.exists()]:
        raise InputError("exists", found[0], "--masks", "remove it")
    for file, (root, name) in masks.items():
        alike = np.pad(off_backdrop(read_bytes(file)[0][..., :3] / np.float32(255)) <= 1, 1)
        alike[[0, -1]], alike[:, [0, -1]] = True, True
        label = ndimage.label(alike)[0]
        write_png(root / name, ~ndimage.binary_dilation(label == label[0, 0])[1:-1, 1:-1])


def survey_text(found: dict[str, Any]) -> str:
    """A survey as text, one line per item, notes last."""
    shown = {name: value for name, value in found.items() if name not in ("checks", "notes")}
    shown |= {name: ", ".join(f"{k} {x}" for k, x in of.items()) for name, of in found["checks"].items()}
    lines = [f"{name:<16}{value}" for name, value in shown.items()]
    return "\n".join([*lines, *(f"NOTE: {note}" for note in found["notes"])])
